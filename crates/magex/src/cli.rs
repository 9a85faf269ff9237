//! The command line: commands and exit codes.

use crate::commands::{
    act, assign, bench, check_environment, compare, eval, export, health, replay, reproduce, roles, trace, train,
    train_commander, verify,
};
use crate::failure;
use crate::options::CommonOptions;
use crate::output::note;
use crate::usage::{self, FromEnvironment, taking_negative_numbers};
use clap::{CommandFactory as _, FromArgMatches as _, Parser, Subcommand};
use magex_runtime::{exit, shutdown};
use std::process::ExitCode;

const AFTER_HELP: &str = "\
Exit codes:
    0  success
    1  the command failed
   64  wrong usage or configuration; nothing was started
   69  a required service cannot be reached
   70  internal error
   73  an output cannot be created (it exists, or the disk is full)
   75  stopped before the end; --resume continues
  130  interrupted twice

With --json the last line of standard output is one JSON object; progress and logs go to standard error, with --log-format json as one object per line.
RUST_LOG sets what is logged (for example RUST_LOG=magex_learner=debug); NO_COLOR turns colours off.
Whole numbers may be written as 1e6, 10_000 or 5M. An empty variable counts as not set.";

/// Trains teams of agents to navigate and assigns goals to them (MAGE-X).
///
/// `magex train` starts a learner, a goal commander and two actors on this machine, trains 50 agents on Simple Spread, and
/// leaves a run folder with weights, curves and a replay. `magex eval` evaluates it.
#[derive(Debug, Parser)]
#[command(name = "magex", version, max_term_width = 100, after_long_help = AFTER_HELP, after_help = "Exit codes and more: magex --help")]
struct Cli {
    #[command(flatten)]
    options: CommonOptions,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Train(Box<train::TrainArgs>),
    TrainCommander(train_commander::TrainCommanderArgs),
    Eval(eval::EvalArgs),
    Replay(replay::ReplayArgs),
    Trace(trace::TraceArgs),
    Compare(compare::CompareArgs),
    Reproduce(reproduce::ReproduceArgs),
    Act(act::ActArgs),
    Export(export::ExportArgs),
    Assign(assign::AssignArgs),
    CheckEnvironment(check_environment::CheckEnvironmentArgs),
    Bench(bench::BenchArgs),
    Verify(verify::VerifyArgs),
    Health(health::HealthArgs),
    Learner(Box<roles::LearnerRole>),
    Actor(roles::ActorRole),
    Commander(roles::CommanderRole),
}

/// The commands and their options.
pub fn definition() -> clap::Command {
    taking_negative_numbers(Cli::command())
}

/// Parses the arguments, runs the command, and reports the result.
pub fn main() -> ExitCode {
    let arguments = roles::by_name(std::env::args_os());
    let mut command = definition();
    let parsed = command.try_get_matches_from_mut(&arguments).and_then(|matches| Cli::from_arg_matches(&matches));
    let cli = match parsed {
        Ok(cli) => cli,
        Err(error) => return usage::report(&command, &arguments, &error),
    };
    let options = cli.options;
    shutdown::survive_file_size_limit();
    options.log_format.apply();
    if !matches!(cli.command, Command::Learner(_) | Command::Actor(_) | Command::Commander(_)) {
        // Services set up their own logging.
        if let Err(error) = options.init_logging() {
            return failure::exit_code(Err(error), &options, &FromEnvironment::default());
        }
    }
    let result = match &cli.command {
        Command::Train(args) => train::run(args, &options),
        Command::TrainCommander(args) => train_commander::run(args, &options),
        Command::Eval(args) => eval::run(args, &options),
        Command::Replay(args) => replay::run(args, &options),
        Command::Trace(args) => trace::run(args, &options),
        Command::Compare(args) => compare::run(args, &options),
        Command::Reproduce(args) => reproduce::run(args, &options),
        Command::Act(args) => act::run(args, &options),
        Command::Export(args) => export::run(args, &options),
        Command::Assign(args) => assign::run(args, &options),
        Command::CheckEnvironment(args) => check_environment::run(args, &options),
        Command::Bench(args) => Ok(bench::run(args, &options)),
        Command::Verify(args) => verify::run(args, &options),
        Command::Health(args) => health::run(args, &options),
        Command::Learner(role) => roles::learner(role),
        Command::Actor(role) => roles::actor(role),
        Command::Commander(role) => roles::commander(role),
    };
    failure::exit_code(result, &options, &FromEnvironment::of(&command, &arguments))
}

/// Reports that the process could not re-execute itself with the environment variables that it needs.
pub fn cannot_start(error: &std::io::Error) -> ExitCode {
    note(format!("error: cannot restart this process with its environment variables: {error}"));
    ExitCode::from(exit::INTERNAL)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_consistent_and_every_command_explains_itself() {
        let mut command = Cli::command();
        command.clone().debug_assert();
        command.build();
        for sub in command.get_subcommands().filter(|sub| sub.get_name() != "help") {
            let help = sub.clone().render_long_help().to_string();
            for word in ["Examples:", "Exit codes:"] {
                assert!(help.contains(word), "{}: {word}", sub.get_name());
            }
        }
    }
}
