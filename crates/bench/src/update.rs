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
use serde_json::json;
use std::time::Instant;

/// Agent samples of the minibatch that is timed.
const MINIBATCH: usize = 4096;

/// Options of `update`.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct UpdateArgs {
    /// Updates that the median is taken of.
    #[arg(long, value_name = "K", default_value_t = 9, value_parser = settings::count)]
    rounds: u32,
}

pub(crate) fn update(args: &UpdateArgs) -> anyhow::Result<Report> {
    let title = "One PPO minibatch, one core: actor and critic, forward, loss, backward, Adam";
    let heading = ["executor", "N", "samples", "ms", "ms with values and advantages"];
    let mut report = Report::new("update", title, 1, &heading);
    for (kind, agents) in [
        (ExecutorKind::Local, 64),
        (ExecutorKind::Magex, 50),
        (ExecutorKind::MagexLiteral, 50),
        (ExecutorKind::Attention, 50),
        (ExecutorKind::Mlp, 50),
    ] {
        let mut config = RunConfig { task: TaskConfig::simple_spread(agents, Spawn::Uniform), ..RunConfig::default() };
        config.executor.kind = kind;
        config.mappo.minibatch_size = MINIBATCH;
        let rounds = if kind == ExecutorKind::Local { args.rounds } else { args.rounds.div_ceil(3) };
        let time = minibatch(&config, 8, rounds as usize)?;
        let cells = vec![
            kind.to_string(),
            agents.to_string(),
            time.samples.to_string(),
            format!("{:.2}", time.gradient_ms),
            format!("{:.2}", time.update_ms),
        ];
        report.row(cells, json!({ "executor": kind, "agents": agents, "time": time }));
    }
    Ok(report)
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
                let clock = Instant::now();
                mappo.update(&mut learned, &batch, 0, 0.0)?;
                // The first round warms the caches.
                if round > 0 {
                    times.push(clock.elapsed().as_secs_f64() * 1e3);
                }
            }
        }
        let [one, two] = time.map(|mut times| quantile(&mut times, 0.5));
        Ok(MinibatchTime {
            samples: units * chunk * n,
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
