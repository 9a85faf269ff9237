//! Log lines on standard error that leave the live status line of a terminal alone.

use indicatif::ProgressBar;
use magex_runtime::telemetry::LogFormat;
use std::io::{IsTerminal as _, Write};
use std::sync::{Mutex, PoisonError};
use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt::MakeWriter;

/// The status line that is on the screen now.
static LIVE: Mutex<Option<ProgressBar>> = Mutex::new(None);

/// Puts a status line on the screen, or takes it away.
pub(crate) fn set_live_line(bar: Option<ProgressBar>) {
    *LIVE.lock().unwrap_or_else(PoisonError::into_inner) = bar;
}

/// Writes something to standard error with the status line out of the way.
pub(crate) fn around_live_line(write: impl FnOnce()) {
    let live = LIVE.lock().unwrap_or_else(PoisonError::into_inner).clone();
    match live {
        Some(bar) => bar.suspend(write),
        None => write(),
    }
}

/// Sends logs to standard error. `RUST_LOG` decides what is shown; without it `info`, or more with `-v` and `-vv`.
pub(crate) fn init(format: LogFormat, verbose: u8) {
    let default = match verbose {
        0 => "info",
        1 => "debug",
        _ => "trace",
    };
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(default));
    let builder = tracing_subscriber::fmt().with_env_filter(filter).with_writer(Lines);
    // A second call changes nothing.
    let _ = match format {
        LogFormat::Text => builder.with_ansi(std::io::stderr().is_terminal()).with_target(false).try_init(),
        LogFormat::Json => builder.json().flatten_event(true).try_init(),
    };
}

struct Lines;

impl<'a> MakeWriter<'a> for Lines {
    type Writer = Line;
    fn make_writer(&'a self) -> Line {
        Line
    }
}

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
