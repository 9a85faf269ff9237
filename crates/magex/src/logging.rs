//! Log lines on standard error, above the live status line of a terminal.

use indicatif::ProgressBar;
use magex_runtime::sync::lock;
use magex_runtime::telemetry::{self, LogFormat};
use std::io::{IsTerminal as _, Write};
use std::sync::Mutex;

static LIVE: Mutex<Option<ProgressBar>> = Mutex::new(None);

/// Sets or removes the status line.
pub(crate) fn set_live_line(bar: Option<ProgressBar>) {
    *lock(&LIVE) = bar;
}

/// Hides the status line while `write` prints to standard error.
pub(crate) fn around_live_line(write: impl FnOnce()) {
    let live = lock(&LIVE).clone();
    match live {
        Some(bar) => bar.suspend(write),
        None => write(),
    }
}

/// Sends logs to standard error. `RUST_LOG` decides what is shown; without it `info`, or more with `-v` and `-vv`.
pub(crate) fn init(format: LogFormat, verbose: u8) -> anyhow::Result<()> {
    let default = match verbose {
        0 => "info",
        1 => "debug",
        _ => "trace",
    };
    let filter = telemetry::filter(default)?;
    // An error would be printed where it occurred, and a thread that cannot print panics: a closed terminal, a full disk.
    let builder = tracing_subscriber::fmt().with_env_filter(filter).with_writer(|| Line).log_internal_errors(false);
    // A second call has no effect.
    let _ = match format {
        LogFormat::Text => builder.with_ansi(std::io::stderr().is_terminal()).with_target(false).try_init(),
        LogFormat::Json => builder.json().flatten_event(true).try_init(),
    };
    Ok(())
}

/// Standard error, above the status line.
struct Line;

impl Write for Line {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let mut result = Ok(());
        around_live_line(|| result = std::io::stderr().lock().write_all(bytes));
        result.map(|()| bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}
