//! `update`: one PPO minibatch on one core.

use crate::report::Report;
use crate::stats::quantile;
use magex::settings;
use magex_core::about::About;
use magex_core::config::{ExecutorKind, RunConfig};
use magex_core::ids::{Iteration, Mode, Shard, ShardKind, WeightsVersion};
use magex_core::rng::{Key, Purpose};
use magex_core::statics::Statics;
use magex_core::task::{Spawn, TaskConfig};
use magex_core::trajectory::Trajectory;
use magex_learner::train::batch::Batch;
use magex_learner::train::learned::Learned;
use magex_learner::train::mappo::Mappo;
use magex_learner::trainer::TrainError;
use magex_nets::params::Entry;
use serde_json::json;
use std::hint::black_box;
use std::time::Instant;
use wide::f32x16;

/// Agent samples of the minibatch that is timed.
const MINIBATCH: usize = 4096;

/// Options of `update`.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct UpdateArgs {
    /// Updates that the median is taken of.
    #[arg(long, value_name = "K", default_value_t = 9, value_parser = settings::count)]
    rounds: u32,
    /// Time an agent sample takes as teams grow, in place of the executors.
    #[arg(long)]
    growth: bool,
}

/// A minibatch of about [`MINIBATCH`] agent samples of teams anywhere on the map.
fn config(kind: ExecutorKind, recurrent: bool, agents: usize) -> RunConfig {
    let mut config = RunConfig { task: TaskConfig::simple_spread(agents, Spawn::Uniform), ..RunConfig::default() };
    config.executor.kind = kind;
    config.executor.recurrent = recurrent;
    config.mappo.minibatch_size = MINIBATCH;
    config
}

pub(crate) fn update(args: &UpdateArgs) -> anyhow::Result<Report> {
    if args.growth { growth(args.rounds) } else { executors(args) }
}

/// The time of an agent sample by team size. A map grows with its team, so that neighbours are as dense.
fn growth(rounds: u32) -> anyhow::Result<Report> {
    let title = "One PPO minibatch, one core: microseconds of an agent sample as teams grow";
    let heading = ["executor", "N", "samples", "µs", "µs with values and advantages", "least µs", "against N = 5"];
    let mut report = Report::new("update", title, 1, &heading);
    let teams = [
        (ExecutorKind::Local, &[5, 20, 50, 200, 1_000][..]),
        (ExecutorKind::Flat, &[5, 20, 50]),
        (ExecutorKind::Magex, &[5, 20, 50, 200]),
    ];
    for (kind, sizes) in teams {
        let mut first = None;
        for &agents in sizes {
            let time = minibatch(&config(kind, false, agents), 8, rounds as usize)?;
            let each = |ms: f64| 1e3 * ms / time.samples as f64;
            let ratio = each(time.least_ms) / *first.get_or_insert(each(time.least_ms));
            let mut cells = vec![kind.to_string(), agents.to_string(), time.samples.to_string()];
            cells.extend([time.gradient_ms, time.update_ms, time.least_ms].map(|ms| format!("{:.2}", each(ms))));
            cells.push(format!("{ratio:.2} x"));
            report.row(cells, json!({ "executor": kind, "agents": agents, "time": time, "against_5": ratio }));
        }
    }
    Ok(report)
}

fn executors(args: &UpdateArgs) -> anyhow::Result<Report> {
    let title = "One PPO minibatch, one core: actor and critic, forward, loss, backward, Adam";
    let heading = ["executor", "N", "samples", "ms", "ms with values and advantages", "least ms", "GFLOP/s", "of peak"];
    let mut report = Report::new("update", title, 1, &heading);
    let mut peak = peak();
    for (kind, recurrent, agents) in [
        (ExecutorKind::Local, false, 64),
        (ExecutorKind::Magex, false, 50),
        (ExecutorKind::MagexLiteral, false, 50),
        (ExecutorKind::Attention, false, 50),
        (ExecutorKind::Mlp, false, 50),
        (ExecutorKind::Flat, false, 20),
        (ExecutorKind::Flat, true, 20),
    ] {
        let config = config(kind, recurrent, agents);
        let rounds = if kind == ExecutorKind::Local { args.rounds } else { args.rounds.div_ceil(3) };
        let time = minibatch(&config, 8, rounds as usize)?;
        peak = peak.max(self::peak());
        let name = if recurrent { format!("{kind}, GRU") } else { kind.to_string() };
        let mut cells = vec![
            name,
            agents.to_string(),
            time.samples.to_string(),
            format!("{:.2}", time.gradient_ms),
            format!("{:.2}", time.update_ms),
            format!("{:.2}", time.least_ms),
        ];
        let rate = time.flops.map(|flops| flops / time.least_ms / 1e6);
        cells.push(rate.map_or_else(|| "-".to_owned(), |rate| format!("{rate:.1}")));
        cells.push(rate.map_or_else(|| "-".to_owned(), |rate| format!("{:.2}", rate * 1e9 / peak)));
        let value = json!({ "executor": kind, "recurrent": recurrent, "agents": agents, "time": time, "peak": peak });
        report.row(cells, value);
    }
    report.notes.push(format!(
        "peak of one core: {:.1} GFLOP/s (fused multiply-adds in registers, measured between the rows); \
         floating-point operations are those of the products, forward and both gradients, real rows only",
        peak / 1e9
    ));
    Ok(report)
}

/// Floating-point operations per second of sixteen independent chains of fused multiply-adds that touch no memory: the most that
/// any kernel here could reach. The best of a few short runs.
fn peak() -> f64 {
    const CHAINS: usize = 16;
    const STEPS: usize = 20_000;
    let (factor, term) = (f32x16::splat(black_box(0.999)), f32x16::splat(black_box(0.001)));
    let run = |_| {
        let mut sums = [f32x16::splat(black_box(1.0)); CHAINS];
        let clock = Instant::now();
        for _ in 0..STEPS {
            for sum in &mut sums {
                *sum = factor.mul_add(*sum, term);
            }
        }
        let seconds = clock.elapsed().as_secs_f64();
        black_box(sums);
        (CHAINS * STEPS * 2 * 16) as f64 / seconds
    };
    (0..20).map(run).fold(0.0, f64::max)
}

/// Floating-point operations of the products of one agent sample: forward, gradient of the weights and, where something is learned
/// before a layer, of its input. `None` for executors with products that are not layers.
fn flops(config: &RunConfig, mappo: &Mappo, neighbours: f64) -> Result<Option<f64>, TrainError> {
    let n = config.task.agents as f64;
    if !matches!(config.executor.kind, ExecutorKind::Local | ExecutorKind::Magex | ExecutorKind::Flat) {
        return Ok(None);
    }
    let networks = mappo.init()?;
    let layer = |entry: &Entry| match (entry.name.as_str(), &entry.shape[..]) {
        // Features are constant.
        ("own.weight" | "f_o.weight" | "f_goal.weight", [k, n]) => 4.0 * (k * n) as f64,
        (name, [k, n]) if name.ends_with(".relative") => 4.0 * (k * n) as f64,
        ("neighbour.weight", [k, n]) => 4.0 * neighbours * (k * n) as f64,
        // Once per joint state.
        ("team.weight", [k, m]) => 4.0 / n * (k * m) as f64,
        // Once per pair.
        (name, [p]) if name.ends_with(".score") => 6.0 * (n - 1.0) * (p - 1) as f64,
        (_, [k, n]) => 6.0 * (k * n) as f64,
        _ => 0.0,
    };
    Ok(Some(networks.iter().flat_map(|network| &network.params.entries).map(layer).sum()))
}

/// What a minibatch takes on one thread, medians in milliseconds.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
struct MinibatchTime {
    /// Agent samples of a minibatch.
    samples: usize,
    /// Minibatches of an update.
    minibatches: usize,
    /// A whole update of one epoch, values and advantages included, per minibatch.
    update_ms: f64,
    /// One more epoch, per minibatch: actor and critic forward, loss, backward, clipping, Adam.
    gradient_ms: f64,
    /// The same from the fastest rounds instead of the medians: what others on the machine leave alone.
    least_ms: f64,
    /// Floating-point operations of the minibatch's products.
    flops: Option<f64>,
}

/// Times updates on a synthetic batch of exactly `minibatches` minibatches of the configured size (rounded down to whole
/// joint states, or chunks of networks with memory) for teams of `config.task.agents` agents.
///
/// # Errors
/// Networks that cannot be built.
fn minibatch(config: &RunConfig, minibatches: usize, rounds: usize) -> Result<MinibatchTime, TrainError> {
    let mut config = config.clone();
    let n = config.task.agents;
    let chunk = Mappo::new(&config)?.chunk();
    let units = (config.mappo.minibatch_size / (chunk * n)).max(1);
    // One episode is one minibatch.
    config.task.horizon = (units * chunk) as u32;
    let trajectory = synthetic(&config, minibatches);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).stack_size(64 << 20).build();
    let pool = pool.map_err(|error| TrainError::Threads(error.to_string()))?;
    pool.install(|| {
        let mut time = [Vec::new(), Vec::new()];
        let mut per_sample = None;
        for round in 0..=rounds {
            for (epochs, times) in (1u32..).zip(&mut time) {
                config.mappo.epochs = epochs;
                let mappo = Mappo::new(&config)?;
                let about = About::of(&config);
                let mut learned =
                    Learned { networks: mappo.init()?, value_norm: mappo.value_norm(), replay: None, about };
                let mut batch = Batch::new(config.run.seed, mappo.spec(), std::slice::from_ref(&trajectory));
                // The update refuses those of another policy.
                batch.log_probs = mappo.log_probs(&learned, &batch)?;
                let counts = batch.features.iter().flat_map(|features| &features.counts);
                let (sum, rows) = counts.fold((0.0, 0.0), |(sum, rows), &count| (sum + f64::from(count), rows + 1.0));
                per_sample = flops(&config, &mappo, sum / f64::max(rows, 1.0))?;
                let clock = Instant::now();
                mappo.update(&mut learned, &batch, 0, 0.0)?;
                // The first round warms the caches.
                if round > 0 {
                    times.push(clock.elapsed().as_secs_f64() * 1e3);
                }
            }
        }
        let samples = units * chunk * n;
        let least = time.each_ref().map(|times| times.iter().copied().fold(f64::INFINITY, f64::min));
        let [one, two] = time.map(|mut times| quantile(&mut times, 0.5));
        Ok(MinibatchTime {
            samples,
            least_ms: (least[1] - least[0]) / minibatches as f64,
            flops: per_sample.map(|flops| flops * samples as f64),
            minibatches,
            update_ms: one / minibatches as f64,
            gradient_ms: (two - one) / minibatches as f64,
        })
    })
}

/// B episodes of agents anywhere on the map, doing anything.
fn synthetic(config: &RunConfig, episodes: usize) -> Trajectory {
    let shape = config.task.shape(episodes);
    let (t, b, n) = (shape.steps, episodes, shape.agents);
    let mut stream = Key::new(config.run.seed, Purpose::Bench, &[3]).stream();
    let half = f64::from(config.task.side / 2.0);
    let mut within =
        |limit: f64, count: usize| -> Vec<f32> { (0..count).map(|_| stream.range(-limit, limit) as f32).collect() };
    let state = (t + 1) * b * shape.bodies * shape.dims;
    let (positions, velocities) = (within(half, state), within(1.0, state));
    let (landmarks, rewards) = (within(half, b * n * shape.dims), within(1.0, t * b * n));
    let choices = config.task.action_heads();
    let uniform: f64 = choices.iter().map(|&c| -libm::log(c as f64)).sum();
    Trajectory {
        shard: Shard {
            kind: ShardKind::Train,
            iteration: Iteration(0),
            index: 0,
            episodes: b as u32,
            first_episode: 0,
            version: WeightsVersion(0),
            mode: Mode::Sampled,
            eval_set: 0,
            record: false,
        },
        shape,
        positions,
        velocities,
        agent_state: vec![0.0; (t + 1) * b * n * shape.agent_state],
        statics: Statics::landmarks(n, shape.dims, landmarks),
        goals: (0..b * n).flat_map(|i| std::iter::repeat_n((i % n) as u32, shape.goals_per_agent)).collect(),
        actions: (0..t * b * n)
            .flat_map(|_| choices.iter().map(|&c| stream.below(c as u32) as u8).collect::<Vec<_>>())
            .collect(),
        log_probs: vec![uniform as f32; t * b * n],
        rewards,
        moves: Vec::new(),
        masks: Vec::new(),
        marks: Vec::new(),
        world_states: Vec::new(),
        goal_log_probs: vec![0.0; b * shape.goals_per_agent],
        costs: vec![1.0; b * shape.goals_per_agent],
        exact_costs: vec![1.0; b * shape.goals_per_agent],
        metrics: Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_batch_is_whole_minibatches() {
        let mut config = RunConfig { task: TaskConfig::simple_spread(8, Spawn::Uniform), ..RunConfig::default() };
        config.mappo.minibatch_size = 256;
        config.executor.kind = ExecutorKind::Local;
        let time = minibatch(&config, 2, 1).unwrap();
        assert_eq!((time.samples, time.minibatches), (256, 2));
        assert!(time.update_ms > 0.0);
    }
}
