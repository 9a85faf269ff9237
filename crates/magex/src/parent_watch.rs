//! Stops a service when the process that started it ends: the parent holds the other end of its standard input.

use magex_runtime::exit::{self, Failure};
use std::io::Read as _;
use std::time::Duration;

/// Name of the hidden option that turns the watch on.
pub(crate) const OPTION: &str = "stop-with-stdin";

/// A service that received the stop signal exits within this time.
const GRACE: Duration = Duration::from_secs(8);

#[derive(Debug, Clone, Copy, clap::Args)]
pub(crate) struct ParentWatch {
    /// Stop when standard input ends.
    #[arg(long = OPTION, hide = true)]
    enabled: bool,
}

impl ParentWatch {
    pub(crate) fn start(self) -> Result<(), Failure> {
        if !self.enabled {
            return Ok(());
        }
        let watch = || {
            let mut ignored = [0u8; 64];
            // The pipe ends with the parent, even if the parent was killed.
            while matches!(std::io::stdin().read(&mut ignored), Ok(1..)) {}
            // The same shutdown as after an operator's SIGTERM.
            let _ = rustix::process::kill_process(rustix::process::getpid(), rustix::process::Signal::TERM);
            std::thread::sleep(GRACE);
            std::process::exit(i32::from(exit::TEMPORARY));
        };
        let thread = std::thread::Builder::new().name("magex-parent".into()).spawn(watch);
        thread.map(drop).map_err(|error| Failure::new(exit::INTERNAL, error))
    }
}
