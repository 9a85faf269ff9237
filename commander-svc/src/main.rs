//! The commander as a process.

use clap::Parser;
use magex_commander::cli::{CommanderArgs, run};
use magex_runtime::exit::{self, Failure};
use magex_runtime::process::ensure_environment;
use std::process::ExitCode;

/// Assigns goals, for the actors of a MAGE-X run and for external clients.
#[derive(Debug, Parser)]
#[command(name = "magex-commander", version)]
struct Command {
    #[command(flatten)]
    args: CommanderArgs,
}

fn main() -> ExitCode {
    if let Err(error) = ensure_environment() {
        return exit::report(Err(Failure::new(exit::INTERNAL, error)));
    }
    exit::run(|command: Command| run(command.args))
}
