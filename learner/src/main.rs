//! The learner as a process of its own.

use clap::Parser;
use magex_learner::cli::{LearnerArgs, run};
use magex_runtime::exit;
use std::process::ExitCode;

/// Trains a team of agents with the episodes that MAGE-X actors roll out.
#[derive(Debug, Parser)]
#[command(name = "magex-learner", version)]
struct Command {
    #[command(flatten)]
    args: LearnerArgs,
}

fn main() -> ExitCode {
    exit::run(|command: Command| run(command.args))
}
