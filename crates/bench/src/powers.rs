//! `powers`: what the exponent of the distances does to a team that moves, with a trained executor.

use crate::report::Report;
use anyhow::Context as _;
use magex::folder;
use magex::settings;
use magex_actor::rollout::Roller;
use magex_commander::shard_goals::answer;
use magex_core::config::{Algorithm, CommanderPolicy, RunConfig};
use magex_core::ids::{Iteration, Mode, Shard, ShardKind, WeightsVersion};
use magex_core::metrics_table::{
    ALL_COVERED_RATE, ARRIVAL_STEP, COLLISION_RATE, COLLISIONS_PER_AGENT_STEP, COST_RATIO,
};
use magex_core::statics::LANDMARKS;
use magex_core::task::{Spawn, TaskName};
use magex_core::trajectory::{EvalOutcome, Recording, ShardResult};
use magex_nets::commander::Commander;
use magex_stats::{Scores, aggregate, bootstrap};
use serde_json::json;
use std::path::PathBuf;

/// Evaluation set of the starts.
const SET: u32 = 101;
/// Resamples of an interval.
const RESAMPLES: u32 = 2000;
/// How near an agent is to its goal when it has arrived.
const NEAR: f64 = 0.15;

/// Options of `powers`.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct PowersArgs {
    /// Run whose executor moves the agents.
    #[arg(long, value_name = "RUN")]
    run: PathBuf,
    /// Starts per row; the same ones in every row.
    #[arg(long, value_name = "K", default_value_t = 1000, value_parser = settings::count)]
    starts: u32,
    /// Kinds of starts.
    #[arg(long, value_name = "MODE,…", value_delimiter = ',', default_values_t = [Spawn::Uniform, Spawn::Lines(None)])]
    spawns: Vec<Spawn>,
    /// Exponents of the exact scheduler; the first one is what the others are compared with.
    #[arg(long, value_name = "P,…", value_delimiter = ',', default_values_t = [1.0, 1.5, 2.0, 4.0])]
    powers: Vec<f64>,
    /// Leave out the makespan and the learned schedulers.
    #[arg(long)]
    exact_only: bool,
}

/// What is measured of an episode, in the order of the columns: last arrival, mean arrival, contacts, all covered, distance over
/// the least. `None`: the task does not have it.
type Measured = [Option<f64>; 5];

const COLUMNS: [&str; 5] = ["last arrival", "mean arrival", "contacts", "all covered", "distance"];

pub(crate) fn powers(args: &PowersArgs) -> anyhow::Result<Report> {
    let trained = folder::load(&args.run, None)?;
    trained.notes.iter().for_each(|text| tracing::warn!("{text}"));
    let mut config = trained.config.clone();
    if config.run.algorithm == Algorithm::Mappo {
        config.mappo.chunk_length = 1;
    }
    let title = format!(
        "Goals by powers of distances: {}, {} agents, {} executor, {} paired starts per row, greedy actions; in brackets the \
         95 % interval of the paired difference, in % of the first row",
        config.task.name, config.task.agents, config.executor.kind, args.starts
    );
    let mut report = Report::new("powers", title, 2, &[&["spawn", "scheduler"][..], &COLUMNS].concat());
    for &spawn in &args.spawns {
        config.task.spawn = spawn;
        let mut first: Option<Vec<Measured>> = None;
        for (name, commander) in schedulers(args, &config, &trained.weights)? {
            let measured = episodes(&config, &trained.weights, &commander, args.starts)?;
            let base = first.get_or_insert_with(|| measured.clone());
            let columns: Vec<Option<Change>> = (0..COLUMNS.len()).map(|k| change(base, &measured, k)).collect();
            let cells = columns.iter().map(|change| change.as_ref().map_or_else(|| "-".to_owned(), Change::text));
            let cells = [spawn.to_string(), name.clone()].into_iter().chain(cells).collect();
            let numbers: Vec<_> =
                columns.iter().map(|c| c.as_ref().map(|c| json!([c.mean, c.of_first, c.low, c.high]))).collect();
            report.row(
                cells,
                json!({ "spawn": spawn, "scheduler": name, "columns": COLUMNS, "mean_ratio_low_high": numbers }),
            );
        }
    }
    Ok(report)
}

fn schedulers(args: &PowersArgs, config: &RunConfig, weights: &[u8]) -> anyhow::Result<Vec<(String, Commander)>> {
    let of = |kind, power: f64| Commander::classical(kind).map(|commander| commander.with_power(power));
    let mut all = Vec::new();
    for &power in &args.powers {
        all.extend(of(CommanderPolicy::Exact, power).map(|commander| (format!("exact, p = {power}"), commander)));
    }
    if !args.exact_only {
        for power in [1.0, 2.0] {
            let name = format!("makespan, then p = {power}");
            all.extend(of(CommanderPolicy::Makespan, power).map(|commander| (name, commander)));
        }
        if config.commander.kind.learned() {
            all.push((format!("{}, trained", config.commander.kind), magex::local::commander(config, weights, None)?));
        }
    }
    Ok(all)
}

fn episodes(config: &RunConfig, weights: &[u8], commander: &Commander, count: u32) -> anyhow::Result<Vec<Measured>> {
    let roller = Roller::new(config, weights)?;
    (0..count)
        .map(|k| {
            let shard = Shard {
                kind: ShardKind::Eval,
                iteration: Iteration(0),
                index: k,
                episodes: 1,
                first_episode: k,
                version: WeightsVersion(0),
                mode: Mode::Greedy,
                eval_set: SET,
                record: true,
            };
            let result = roller.rollout(&shard, |request| answer(commander, 0.0, request, &|| true));
            match result.map_err(|error| anyhow::anyhow!("start {k}: {error}"))? {
                ShardResult::Eval(EvalOutcome { metrics, recording: Some(recording), .. }) => {
                    let metrics = metrics.first().context("no metrics")?;
                    let of = |metric| metrics.get(metric).map(f64::from);
                    let contacts = of(COLLISIONS_PER_AGENT_STEP).or(of(COLLISION_RATE));
                    let mean = mean_arrival(config, &recording);
                    Ok([of(ARRIVAL_STEP), mean, contacts, of(ALL_COVERED_RATE), of(COST_RATIO)])
                }
                _ => anyhow::bail!("start {k}: no recording"),
            }
        })
        .collect()
}

/// Mean over the agents of the first step at which each is at its goal; the horizon + 1 for one that never is. `None` where agents
/// do not go to their goals themselves.
fn mean_arrival(config: &RunConfig, recording: &Recording) -> Option<f64> {
    if config.task.name == TaskName::PushBall {
        return None;
    }
    let (shape, goals) = (&recording.shape, recording.statics.get(LANDMARKS));
    let (n, e, d, k) = (shape.agents, shape.bodies, shape.dims, shape.goals_per_agent);
    let near = |step: usize, agent: usize| {
        let from = (step * e + agent) * d;
        let to = recording.goals[agent * k] as usize * d;
        let pairs = recording.positions[from..from + d].iter().zip(&goals[to..to + d]);
        pairs.map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum::<f64>() <= NEAR * NEAR
    };
    let arrival = |agent| (0..=shape.steps).find(|&step| near(step, agent)).unwrap_or(shape.steps + 1) as f64;
    Some((0..n).map(arrival).sum::<f64>() / n as f64)
}

/// A column of a row against the first row.
struct Change {
    mean: f64,
    of_first: f64,
    low: f64,
    high: f64,
}

impl Change {
    fn text(&self) -> String {
        if self.of_first == 1.0 && self.low == 1.0 && self.high == 1.0 {
            return format!("{:.4}", self.mean);
        }
        let percent = |ratio: f64| 100.0 * (ratio - 1.0);
        let Self { mean, of_first, low, high } = *self;
        format!("{mean:.4} = {of_first:.3} x ({:+.1} to {:+.1})", percent(low), percent(high))
    }
}

fn change(first: &[Measured], own: &[Measured], column: usize) -> Option<Change> {
    let values = |all: &[Measured]| all.iter().map(|one| one[column]).collect::<Option<Vec<f64>>>();
    let (first, own) = (values(first)?, values(own)?);
    let (base, mean) = (aggregate::average(&first), aggregate::average(&own));
    let difference: Vec<f64> = own.iter().zip(&first).map(|(own, first)| own - first).collect();
    let interval = bootstrap::interval(&Scores::new(vec![difference]).ok()?, 1, RESAMPLES, aggregate::mean);
    let ratio = |difference: f64| if base == 0.0 { 1.0 } else { 1.0 + difference / base };
    let (low, high) = interval.map_or((1.0, 1.0), |interval| (ratio(interval.low), ratio(interval.high)));
    Some(Change { mean, of_first: ratio(mean - base), low, high })
}
