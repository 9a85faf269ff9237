//! The commander as a process.

use clap::Parser;
use magex_commander::cli::{CommanderArgs, run};
use magex_runtime::exit;
use std::process::ExitCode;

/// Assigns goals, for the actors of a MAGE-X run and for external clients.
#[derive(Debug, Parser)]
#[command(name = "magex-commander", version)]
struct Command {
    #[command(flatten)]
    args: CommanderArgs,
}

fn main() -> ExitCode {
    exit::run(|command: Command| run(command.args))
}
