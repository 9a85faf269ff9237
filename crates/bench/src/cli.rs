//! The command line: the tables of docs/results.md, measured on this machine.

use crate::report::Report;
use crate::{act, assign, cluster, endless, env, goals, messages, powers, runs, soak, tasks, training, update};
use clap::{CommandFactory as _, Parser, Subcommand};
use magex::failure;
use magex::options::CommonOptions;
use magex::usage::{self, FromEnvironment};
use magex_runtime::exit;
use serde_json::{Map, Value, json};
use std::process::ExitCode;

const AFTER_HELP: &str = "\
Examples:
  magex-bench                                    the quick ones: a few minutes
  magex-bench update --json
  magex-bench assign --run runs/mine --flood 60
  magex-bench commander --run runs/mine
  magex-bench train --agents 50 --seeds 1,2,3    trains and evaluates
  magex-bench tasks --tasks drones-4             Push Ball and the drones
  magex-bench distributed                        services against one process
  magex-bench cluster                            the learner's wire

Times are medians on one core (unless a table says otherwise) and vary with the
load of the machine: compare ratios of one session, not numbers of different
days. Numbers that are not times are the same on every machine.

Exit codes: 0 success, 1 a measurement failed, 64 wrong usage or configuration";

/// Benchmarks of MAGE-X: environment, update, solvers, commander, services, whole trainings.
///
/// Without a subcommand: env, update, assign --solver and commander.
#[derive(Debug, Parser)]
#[command(name = "magex-bench", version, max_term_width = 100, after_help = AFTER_HELP)]
#[command(subcommand_value_name = "WHAT", subcommand_help_heading = "What")]
struct Cli {
    #[command(flatten)]
    options: CommonOptions,
    #[command(subcommand)]
    what: Option<What>,
}

#[derive(Debug, Clone, Subcommand)]
enum What {
    /// Environment stepping alone: joint steps per second of one core.
    Env(env::EnvArgs),
    /// One PPO minibatch on one core.
    Update(update::UpdateArgs),
    /// Goal assignment: solver, learned scheduler, and the service with its clients.
    Assign(assign::AssignArgs),
    /// Policies as a service: latency and calls per second.
    Act(act::ActArgs),
    /// Cost of the commander's assignments over the exact ones.
    Commander(goals::CommanderArgs),
    /// What powers of distances do to a team that moves, with a trained executor.
    Powers(powers::PowersArgs),
    /// Train the paper's ranking commander alone, on instances of each layout.
    Ranking(goals::RankingArgs),
    /// Services with two actor processes against the same work in one process.
    Distributed(runs::DistributedArgs),
    /// A mission on disk whose goals never end: memory and time of an update.
    Endless(endless::EndlessArgs),
    /// Train and evaluate every size, executor and seed.
    Train(training::TrainArgs),
    /// Train and evaluate Push Ball and the drones.
    Tasks(tasks::TasksArgs),
    /// Weights of one team size on other team sizes.
    Generalisation(runs::GeneralisationArgs),
    /// The learner's wire: throughput, many actors, weights to many subscribers, restart after a kill.
    Cluster(cluster::ClusterArgs),
    /// Health checks of a commander beside messages of 31 MiB.
    Messages(messages::MessagesArgs),
    /// Memory and open files of a training cluster over an hour.
    Soak(soak::SoakArgs),
    /// The learner process of `cluster`: only ingests.
    #[command(hide = true)]
    Ingest(cluster::IngestArgs),
    /// All of these but soak, powers and endless.
    All,
}

/// The command lines that run without a subcommand.
const QUICK: [&[&str]; 4] = [&["env"], &["update"], &["assign", "--solver"], &["commander"]];
/// The command lines of `all`.
const ALL: [&[&str]; 11] = [
    &["env"],
    &["update"],
    &["assign"],
    &["act"],
    &["commander"],
    &["ranking"],
    &["distributed"],
    &["cluster"],
    &["messages"],
    &["train"],
    &["tasks"],
];

/// Parses the arguments, measures, and prints the tables.
pub(crate) fn main() -> ExitCode {
    let arguments: Vec<_> = std::env::args_os().collect();
    match Cli::try_parse_from(&arguments) {
        Ok(cli) => {
            cli.options.log_format.apply();
            let result = cli.options.init_logging().and_then(|()| run(&cli));
            failure::exit_code(result, &cli.options, &FromEnvironment::default())
        }
        Err(error) => usage::report(&Cli::command(), &arguments, &error),
    }
}

fn run(cli: &Cli) -> anyhow::Result<u8> {
    let parts = match &cli.what {
        Some(What::Ingest(args)) => return cluster::serve_ingest(args),
        Some(What::All) => parse(&ALL)?,
        Some(one) => vec![one.clone()],
        None => parse(&QUICK)?,
    };
    let output = cli.options.output();
    let (mut all, mut failed) = (Map::new(), false);
    for part in &parts {
        let report = measure(part)?;
        report.show(output);
        failed |= report.failed;
        all.insert(report.name.into(), json!({ "rows": report.rows, "notes": report.notes }));
    }
    output.result(&Value::Object(all));
    Ok(if failed { exit::FAILURE } else { exit::OK })
}

fn parse(lines: &[&[&str]]) -> anyhow::Result<Vec<What>> {
    let parse = |line: &&[&str]| Ok(Cli::try_parse_from(["magex-bench"].iter().chain(*line))?.what);
    lines.iter().map(parse).filter_map(Result::transpose).collect()
}

fn measure(what: &What) -> anyhow::Result<Report> {
    match what {
        What::Env(args) => env::env(args),
        What::Update(args) => update::update(args),
        What::Assign(args) => assign::assign(args),
        What::Act(args) => act::act(args),
        What::Commander(args) => goals::commander(args),
        What::Powers(args) => powers::powers(args),
        What::Ranking(args) => goals::ranking(args),
        What::Endless(args) => endless::endless(args),
        What::Distributed(args) => runs::distributed(args),
        What::Train(args) => training::train(args),
        What::Tasks(args) => tasks::tasks(args),
        What::Generalisation(args) => runs::generalisation(args),
        What::Cluster(args) => cluster::cluster(args),
        What::Messages(args) => messages::messages(args),
        What::Soak(args) => soak::soak(args),
        What::Ingest(_) | What::All => Err(anyhow::anyhow!("this is not a table")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_consistent_and_every_preset_parses() {
        Cli::command().debug_assert();
        assert_eq!(parse(&QUICK).unwrap().len(), QUICK.len());
        assert_eq!(parse(&ALL).unwrap().len(), ALL.len());
    }
}
