//! `magex bench`
use crate::cli::Global;

const AFTER_HELP: &str = "Examples:\n\nExit codes:";

/// Measure.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct BenchArgs {}

pub(crate) fn run(_: &BenchArgs, _: &Global) -> anyhow::Result<u8> {
    Ok(0)
}
