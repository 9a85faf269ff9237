//! `magex bench`: a pointer to the program that measures.

use crate::options::CommonOptions;
use crate::output::fatal;
use magex_runtime::exit;

const AFTER_HELP: &str = "\
Examples:
  cargo run --release -p magex-bench -- --help

Exit codes: 64 always: the benchmarks are not part of this program";

/// Benchmarks: a separate program, cargo run --release -p magex-bench.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct BenchArgs {
    /// Arguments of magex-bench.
    #[arg(value_name = "ARGS", trailing_var_arg = true, allow_hyphen_values = true)]
    args: Vec<String>,
}

pub(crate) fn run(args: &BenchArgs, options: &CommonOptions) -> u8 {
    let args = if args.args.is_empty() { "--help".to_owned() } else { args.args.join(" ") };
    let message = format!("benchmarks live in their own program: cargo run --release -p magex-bench -- {args}");
    fatal(&message, exit::USAGE, options.json);
    exit::USAGE
}
