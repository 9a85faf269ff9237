//! `magex bench`: the tables of docs/results.md, measured on this machine.

mod assign;
mod cluster;
mod fleet;
mod goals;
mod runs;
mod soak;
mod speed;
mod tasks;
mod training;
mod vitals;

use crate::cli::Global;
use crate::output::{Output, Table};
use magex_runtime::exit;
use serde_json::{Map, Value, json};

const AFTER_HELP: &str = "\
Examples:
  magex bench                                       env, update, assign and commander: a few minutes
  magex bench update --json
  magex bench assign --run runs/mine --flood 60     solver, learned scheduler, service under load
  magex bench commander --run runs/mine
  magex bench train --agents 50 --seeds 1,2,3       trains and evaluates; the result table
  magex bench tasks --tasks drones-4                the same for Push Ball and the drones
  magex bench distributed                           services against one process
  magex bench cluster                               what the learner's wire carries

Timings are medians on one core (unless a table says otherwise) and as noisy as the machine is busy:
compare ratios taken in one go, not numbers from different days. What is not a time is the same on every
machine.

Exit codes: 0 done, 1 something failed, 64 wrong usage or configuration";

/// Measure: environment, update, solvers, commander, services, whole trainings.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = AFTER_HELP, subcommand_value_name = "WHAT", subcommand_help_heading = "What")]
pub(crate) struct BenchArgs {
    #[command(subcommand)]
    what: Option<What>,
}

#[derive(Debug, Clone, clap::Subcommand)]
enum What {
    /// Environment stepping alone: joint steps per second of one core.
    Env(speed::EnvArgs),
    /// One PPO minibatch on one core.
    Update(speed::UpdateArgs),
    /// Goal assignment: solver, learned scheduler, and the service with its clients.
    Assign(assign::AssignArgs),
    /// Cost of the commander's assignments over the exact ones.
    Commander(goals::CommanderArgs),
    /// Train the paper's ranking commander alone, on instances of each layout.
    Ranking(goals::RankingArgs),
    /// Services with two actor processes against the same work in one process.
    Distributed(runs::DistributedArgs),
    /// Train and evaluate every size, executor and seed.
    Train(training::TrainArgs),
    /// Train and evaluate Push Ball and the drones.
    Tasks(tasks::TasksArgs),
    /// Weights of one team size on other team sizes.
    Generalisation(runs::GeneralisationArgs),
    /// The learner's wire: throughput, many actors, weights to many subscribers, restart after a kill.
    Cluster(cluster::ClusterArgs),
    /// Memory and open files of a training cluster over an hour.
    Soak(soak::SoakArgs),
    /// The learner of `bench cluster`: only ingests.
    #[command(hide = true)]
    Ingest(cluster::IngestArgs),
    /// All of these but soak.
    All,
}

/// One table.
pub(super) struct Report {
    /// Key in the JSON object.
    name: &'static str,
    /// What is measured.
    title: String,
    table: Table,
    rows: Vec<Value>,
    /// What else is to be known.
    notes: Vec<String>,
    failed: bool,
}

impl Report {
    fn new(name: &'static str, title: impl Into<String>, left: usize, heading: &[&str]) -> Self {
        let table = Table::new(left, heading);
        Self { name, title: title.into(), table, rows: Vec::new(), notes: Vec::new(), failed: false }
    }

    fn row(&mut self, cells: Vec<String>, value: Value) {
        self.table.row(cells);
        self.rows.push(value);
    }
}

pub(crate) fn run(args: &BenchArgs, global: &Global) -> anyhow::Result<u8> {
    let quick = || {
        [
            What::Env(Default::default()),
            What::Update(Default::default()),
            What::Assign(Default::default()),
            What::Commander(Default::default()),
        ]
    };
    let parts = match &args.what {
        None => quick().to_vec(),
        Some(What::Ingest(args)) => return cluster::serve_ingest(args),
        Some(What::All) => {
            let long = [
                What::Ranking(Default::default()),
                What::Distributed(Default::default()),
                What::Cluster(Default::default()),
                What::Train(Default::default()),
                What::Tasks(Default::default()),
            ];
            let whole = |part| match part {
                What::Assign(_) => What::Assign(assign::AssignArgs::whole()),
                other => other,
            };
            quick().into_iter().map(whole).chain(long).collect()
        }
        Some(one) => vec![one.clone()],
    };
    let output = global.output();
    let (mut all, mut failed) = (Map::new(), false);
    for part in &parts {
        let report = measure(part)?;
        show(&report, output);
        failed |= report.failed;
        all.insert(report.name.into(), json!({ "rows": report.rows, "notes": report.notes }));
    }
    output.result(&Value::Object(all));
    Ok(if failed { exit::FAILURE } else { exit::OK })
}

fn measure(what: &What) -> anyhow::Result<Report> {
    match what {
        What::Env(args) => speed::env(args),
        What::Update(args) => speed::update(args),
        What::Assign(args) => assign::assign(args),
        What::Commander(args) => goals::commander(args),
        What::Ranking(args) => goals::ranking(args),
        What::Distributed(args) => runs::distributed(args),
        What::Train(args) => training::train(args),
        What::Tasks(args) => tasks::tasks(args),
        What::Generalisation(args) => runs::generalisation(args),
        What::Cluster(args) => cluster::cluster(args),
        What::Soak(args) => soak::soak(args),
        What::Ingest(_) | What::All => Err(anyhow::anyhow!("this is not a table")),
    }
}

fn show(report: &Report, output: Output) {
    output.say(format!("{}\n\n{}\n", report.title, report.table));
    for note in &report.notes {
        output.say(format!("  {note}\n"));
    }
}
