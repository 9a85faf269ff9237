//! An actor as a process of its own.

use clap::Parser;
use magex_actor::cli::{ActorArgs, run};
use magex_runtime::exit;
use std::process::ExitCode;

/// Rolls out episodes for a MAGE-X learner.
#[derive(Debug, Parser)]
#[command(name = "magex-actor", version)]
struct Command {
    #[command(flatten)]
    args: ActorArgs,
}

fn main() -> ExitCode {
    exit::run(|command: Command| run(command.args))
}
