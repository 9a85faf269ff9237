//! Options that every command has.

use crate::logging;
use crate::output::Output;
use magex_runtime::telemetry::LogFormat;

/// Options of every command.
#[derive(Debug, Clone, Copy, clap::Args)]
#[command(next_help_heading = "Output")]
pub struct CommonOptions {
    /// Print one JSON object as the last line of standard output.
    #[arg(long, global = true)]
    pub json: bool,
    /// Format of standard error: text, or one JSON object per line.
    #[arg(
        long,
        global = true,
        env = "MAGEX_LOG_FORMAT",
        value_enum,
        ignore_case = true,
        value_name = "FORMAT",
        default_value_t
    )]
    pub log_format: LogFormat,
    /// Log more (-v, -vv); RUST_LOG takes precedence.
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub verbose: u8,
}

impl CommonOptions {
    /// Sends logs to standard error.
    ///
    /// # Errors
    /// RUST_LOG is wrong.
    pub fn init_logging(&self) -> anyhow::Result<()> {
        logging::init(self.log_format, self.verbose)
    }

    /// Where results go.
    pub fn output(&self) -> Output {
        Output::new(self.json)
    }
}
