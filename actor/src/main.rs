//! An actor as a process of its own.

use clap::Parser;
use magex_actor::cli::{ActorArgs, run};
use magex_runtime::exit::{self, Failure};
use magex_runtime::process::ensure_environment;
use std::process::ExitCode;

/// Rolls out episodes for a MAGE-X learner.
#[derive(Debug, Parser)]
#[command(name = "magex-actor", version)]
struct Command {
    #[command(flatten)]
    args: ActorArgs,
}

fn main() -> ExitCode {
    if let Err(error) = ensure_environment() {
        return exit::report(Err(Failure::new(exit::INTERNAL, error)));
    }
    exit::run(|command: Command| run(command.args))
}
