//! Shutdown by signal.

use std::time::{Duration, Instant};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

/// A signal so soon after another is the same request: `timeout` and batch systems signal a process and then its group.
const SAME: Duration = Duration::from_millis(500);

/// SIGXCPU: the limit of processor time, one signal per second until the hard limit.
const PROCESSOR_TIME: i32 = 24;
/// SIGXFSZ: the limit of file size. Its default kills; without it, the write fails as on a full disk.
const FILE_SIZE: i32 = 25;

/// A signal that stops a process, and whether its repetition stops it at once. Batch systems send the others, once or every
/// second, before they send SIGTERM.
type Request = (SignalKind, &'static str, bool);

const REQUESTS: [fn() -> Request; 4] = [
    || (SignalKind::interrupt(), "SIGINT", true),
    || (SignalKind::terminate(), "SIGTERM", true),
    || (SignalKind::user_defined1(), "SIGUSR1", false),
    || (SignalKind::from_raw(PROCESSOR_TIME), "SIGXCPU", false),
];

/// A token that SIGINT, SIGTERM, SIGUSR1 or SIGXCPU cancels. A second SIGINT or SIGTERM, later than half a second, ends the process
/// at once with code 130.
pub fn on_signal() -> std::io::Result<CancellationToken> {
    watch(REQUESTS.iter().map(|request| request()))
}

/// [`on_signal`] for a command in a terminal: SIGHUP, when the terminal closes, stops it too, unless `nohup` started it.
pub fn on_signal_or_hangup() -> std::io::Result<CancellationToken> {
    let hangup = (!ignores_hangup()).then(|| (SignalKind::hangup(), "SIGHUP", false));
    watch(REQUESTS.iter().map(|request| request()).chain(hangup))
}

fn ignores_hangup() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    ignored.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).is_some_and(|mask| mask & 1 == 1)
}

/// From now on a write beyond the limit of file size fails like one to a full disk, and does not kill the process.
pub fn survive_file_size_limit() {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build();
    let installed = runtime.and_then(|runtime| {
        let _entered = runtime.enter();
        signal(SignalKind::from_raw(FILE_SIZE)).map(drop)
    });
    if let Err(error) = installed {
        tracing::debug!(%error, "SIGXFSZ keeps its default");
    }
}

fn watch(requests: impl Iterator<Item = Request>) -> std::io::Result<CancellationToken> {
    let (sender, received) = mpsc::channel(8);
    for (kind, name, insists) in requests {
        let (mut signals, sender) = (signal(kind)?, sender.clone());
        tokio::spawn(
            async move { while signals.recv().await.is_some() && sender.send((name, insists)).await.is_ok() {} },
        );
    }
    let token = CancellationToken::new();
    tokio::spawn(obey(received, token.clone(), || std::process::exit(i32::from(crate::exit::INTERRUPTED))));
    Ok(token)
}

async fn obey(mut signals: mpsc::Receiver<(&'static str, bool)>, token: CancellationToken, at_once: impl Fn()) {
    let mut insisted: Option<Instant> = None;
    while let Some((name, insists)) = signals.recv().await {
        if !token.is_cancelled() {
            token.cancel();
            tracing::info!(signal = name, "stopping; a second SIGINT or SIGTERM stops at once");
        }
        match insisted {
            None if insists => insisted = Some(Instant::now()),
            Some(first) if insists && first.elapsed() >= SAME => {
                tracing::warn!(signal = name, "stopping at once");
                at_once();
            }
            _ => tracing::debug!(signal = name, "already stopping"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};

    #[tokio::test]
    async fn only_a_later_sigint_or_sigterm_stops_at_once() {
        let (token, ends) = (CancellationToken::new(), AtomicUsize::new(0));
        let (sender, received) = mpsc::channel(8);
        let send = async {
            // A batch system's warning, then `timeout`: the process, and at once its group.
            for signal in [("SIGUSR1", false), ("SIGTERM", true), ("SIGTERM", true), ("SIGXCPU", false)] {
                sender.send(signal).await.unwrap();
            }
            tokio::time::sleep(SAME + Duration::from_millis(10)).await;
            sender.send(("SIGXCPU", false)).await.unwrap();
            tokio::time::sleep(Duration::from_millis(10)).await;
            assert!(token.is_cancelled() && ends.load(Ordering::SeqCst) == 0);
            sender.send(("SIGINT", true)).await.unwrap();
            drop(sender);
        };
        let at_once = || {
            ends.fetch_add(1, Ordering::SeqCst);
        };
        tokio::join!(send, obey(received, token.clone(), at_once));
        assert_eq!(ends.load(Ordering::SeqCst), 1);
    }
}
