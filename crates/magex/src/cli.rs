//! The command line: what can be asked for, and how the process ends.

use crate::commands::{assign, bench, eval, health, replay, roles, train, train_commander, verify};
use crate::failure;
use crate::logging;
use crate::output::{Output, note};
use clap::{Parser, Subcommand};
use magex_runtime::exit;
use magex_runtime::telemetry::LogFormat;
use std::process::ExitCode;

const AFTER_HELP: &str = "\
Exit codes:
    0  done
    1  the work failed
   64  wrong usage or configuration; nothing was started
   69  a service that is needed cannot be reached
   70  a fault of this program
   73  an output cannot be created (it exists, or the disk refuses)
   75  stopped before the end; --resume continues
  130  interrupted twice

With --json the last line of standard output is one JSON object; progress and logs go to standard error.
RUST_LOG sets what is logged (for example RUST_LOG=magex_learner=debug); NO_COLOR turns colours off.";

/// Trains teams of agents to navigate, and hands out goals to them (MAGE-X).
///
/// `magex train` starts a learner, a goal commander and two actors on this machine, trains 50 agents on Simple Spread,
/// and leaves a run folder with weights, curves and a replay. `magex eval` measures it.
#[derive(Debug, Parser)]
#[command(name = "magex", version, max_term_width = 110, after_long_help = AFTER_HELP, after_help = "Exit codes and more: magex --help")]
struct Cli {
    #[command(flatten)]
    global: Global,
    #[command(subcommand)]
    command: Command,
}

/// Options of every command.
#[derive(Debug, Clone, Copy, clap::Args)]
#[command(next_help_heading = "Output")]
pub(crate) struct Global {
    /// Print one JSON object as the last line of standard output.
    #[arg(long, global = true)]
    pub(crate) json: bool,
    /// How log lines on standard error look.
    #[arg(long, global = true, value_enum, value_name = "FORMAT", default_value_t)]
    pub(crate) log_format: LogFormat,
    /// Log more (-v, -vv); RUST_LOG wins.
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub(crate) verbose: u8,
}

impl Global {
    /// Where results go.
    pub(crate) fn output(&self) -> Output {
        Output::new(self.json)
    }
}

#[derive(Debug, Subcommand)]
enum Command {
    Train(Box<train::TrainArgs>),
    TrainCommander(train_commander::TrainCommanderArgs),
    Eval(eval::EvalArgs),
    Replay(replay::ReplayArgs),
    Assign(assign::AssignArgs),
    Bench(bench::BenchArgs),
    Verify(verify::VerifyArgs),
    Health(health::HealthArgs),
    Learner(Box<roles::LearnerRole>),
    Actor(roles::ActorRole),
    Commander(roles::CommanderRole),
}

/// Parses the arguments, does what they ask for, and says how it went.
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse_from(roles::by_name(std::env::args_os())) {
        Ok(cli) => cli,
        Err(error) => {
            // Nobody left to tell if this fails.
            let _ = error.print();
            return ExitCode::from(if error.use_stderr() { exit::USAGE } else { exit::OK });
        }
    };
    let global = cli.global;
    if !matches!(cli.command, Command::Learner(_) | Command::Actor(_) | Command::Commander(_)) {
        // Services have their own say in how they log.
        logging::init(global.log_format, global.verbose);
    }
    let result = match &cli.command {
        Command::Train(args) => train::run(args, &global),
        Command::TrainCommander(args) => train_commander::run(args, &global),
        Command::Eval(args) => eval::run(args, &global),
        Command::Replay(args) => replay::run(args, &global),
        Command::Assign(args) => assign::run(args, &global),
        Command::Bench(args) => bench::run(args, &global),
        Command::Verify(args) => verify::run(args, &global),
        Command::Health(args) => health::run(args, &global),
        Command::Learner(role) => roles::learner(role),
        Command::Actor(role) => roles::actor(role),
        Command::Commander(role) => roles::commander(role),
    };
    ExitCode::from(result.unwrap_or_else(|error| {
        let code = failure::code_of(&error);
        note(format!("error: {error:#}"));
        global.output().result(&serde_json::json!({ "error": format!("{error:#}"), "exit_code": code }));
        code
    }))
}

/// The process could not be started the way it has to be.
pub fn cannot_start(error: &std::io::Error) -> ExitCode {
    note(format!("error: this process cannot be run again with its own environment: {error}"));
    ExitCode::from(exit::INTERNAL)
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory as _;

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
