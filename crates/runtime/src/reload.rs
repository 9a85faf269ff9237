//! Certificates, tokens and identities are read again on SIGHUP, and when their files change. What cannot be used changes
//! nothing: the service goes on with what it has, and the log says which file is wrong, and why.

use crate::exit::Failure;
use crate::metrics::Gauge;
use crate::tls::End;
use crate::tls::validity::time_of_day;
use std::fmt;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tokio::signal::unix::Signal;
use tokio::time::Instant;

/// How often the files are looked at.
const INTERVAL: Duration = Duration::from_secs(1);
/// A certificate that ends within this time is warned of, once a day.
const SOON: Duration = Duration::from_secs(30 * 86_400);
const DAY: Duration = Duration::from_secs(86_400);

type Reread = Box<dyn Fn() -> Result<(), Failure> + Send + Sync>;
type Ends = Box<dyn Fn() -> Vec<End> + Send + Sync>;

/// Files that belong together and can be read again while they are in use.
pub struct Source {
    what: &'static str,
    files: Vec<PathBuf>,
    read: Reread,
    ends: Ends,
}

impl fmt::Debug for Source {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Source").field("what", &self.what).field("files", &self.files).finish_non_exhaustive()
    }
}

impl Source {
    /// `read` reads the files again, and changes nothing if they cannot be used.
    pub(crate) fn new(
        what: &'static str,
        files: Vec<PathBuf>,
        read: impl Fn() -> Result<(), Failure> + Send + Sync + 'static,
    ) -> Self {
        Self { what, files, read: Box::new(read), ends: Box::new(Vec::new) }
    }

    /// With the ends of the certificates that are in use.
    pub(crate) fn ending(self, ends: impl Fn() -> Vec<End> + Send + Sync + 'static) -> Self {
        Self { ends: Box::new(ends), ..self }
    }

    fn stamps(&self) -> Stamps {
        self.files.iter().map(|path| stamp(path)).collect()
    }

    fn reread(&self) {
        match (self.read)() {
            Ok(()) => tracing::info!(files = ?self.files, "read {} again", self.what),
            Err(error) => tracing::warn!(%error, "{} cannot be read again; the previous state stays in use", self.what),
        }
    }
}

/// Time of change, size and number of a file; `None` while it is missing.
type Stamp = Option<(i64, i64, u64, u64)>;
type Stamps = Vec<Stamp>;

fn stamp(path: &Path) -> Stamp {
    let meta = std::fs::metadata(path).ok()?;
    Some((meta.mtime(), meta.mtime_nsec(), meta.len(), meta.ino()))
}

/// Reads `sources` again whenever a SIGHUP arrives or their files have changed. `first_end` is the gauge of the first end of a
/// certificate. Never returns.
pub(crate) async fn follow(sources: Vec<Source>, mut hangup: Signal, first_end: Gauge) {
    // What was read last, and what was there at the last look: files that are still being replaced are left alone.
    let mut read: Vec<Stamps> = sources.iter().map(Source::stamps).collect();
    let mut seen = read.clone();
    let mut warn_at = Instant::now();
    loop {
        if Instant::now() >= warn_at {
            warn_at = Instant::now() + DAY;
            sources.iter().flat_map(|source| (source.ends)()).for_each(|end| warn(&end, time_of_day()));
        }
        let ends = sources.iter().flat_map(|source| (source.ends)());
        first_end.set(ends.map(|(_, end)| end.as_secs_f64()).fold(f64::INFINITY, f64::min));
        let asked = tokio::select! {
            _ = hangup.recv() => true,
            () = tokio::time::sleep(INTERVAL) => false,
        };
        if asked && sources.is_empty() {
            tracing::info!("SIGHUP: this service has no certificates, tokens or identities to read again");
        }
        for ((source, read), seen) in sources.iter().zip(&mut read).zip(&mut seen) {
            let now = source.stamps();
            let settled = now == *seen;
            seen.clone_from(&now);
            if asked || (settled && now != *read) {
                *read = now;
                source.reread();
                warn_at = Instant::now();
            }
        }
    }
}

/// Warns of a certificate that has ended, or ends soon.
fn warn((path, end): &End, now: Duration) {
    let file = path.display();
    match end.checked_sub(now) {
        None => tracing::error!(%file, "this certificate ended {} ago; peers refuse it: renew it", span(now - *end)),
        Some(left) if left < SOON => tracing::warn!(%file, "this certificate ends in {}; renew it", span(left)),
        Some(_) => {}
    }
}

/// A time for people, in its largest unit.
pub(crate) fn span(time: Duration) -> String {
    let units = [(86_400, "days"), (3600, "hours"), (60, "minutes"), (1, "seconds")];
    let (unit, name) = units.into_iter().find(|(unit, _)| time.as_secs() >= 2 * unit).unwrap_or((1, "seconds"));
    format!("{} {name}", time.as_secs() / unit)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
    use tokio::signal::unix::{SignalKind, signal};

    #[tokio::test]
    async fn files_are_read_again_when_they_have_changed_and_settled() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("token");
        std::fs::write(&path, "one").unwrap();
        let (reads, bad) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicBool::new(false)));
        let (counted, wrong) = (reads.clone(), bad.clone());
        let read = move || {
            counted.fetch_add(1, Ordering::Relaxed);
            if wrong.load(Ordering::Relaxed) { Err(Failure::usage("bad")) } else { Ok(()) }
        };
        let source = Source::new("the token", vec![path.clone()], read).ending(|| vec![("c".into(), DAY)]);
        let gauge = crate::metrics::Metrics::new().gauge("magex_test_end", "End.");
        let hangup = signal(SignalKind::hangup()).unwrap();
        let following = tokio::spawn(follow(vec![source], hangup, gauge.clone()));
        let until = async |count| {
            while reads.load(Ordering::Relaxed) < count {
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
        };
        tokio::time::sleep(Duration::from_millis(10)).await;
        bad.store(true, Ordering::Relaxed);
        std::fs::write(&path, "two, longer").unwrap();
        until(1).await;
        bad.store(false, Ordering::Relaxed);
        std::fs::write(&path, "three, longer still").unwrap();
        until(2).await;
        assert_eq!(gauge.get(), DAY.as_secs_f64());
        assert!(!following.is_finished());
        following.abort();
    }

    #[test]
    fn times_are_told_in_their_largest_unit() {
        let told = [1, 119, 130, 7300, 200_000].map(|seconds| span(Duration::from_secs(seconds)));
        assert_eq!(told, ["1 seconds", "119 seconds", "2 minutes", "2 hours", "2 days"]);
    }
}
