//! Synthetic shards and results for tests.

use magex_core::ids::{Iteration, Mode, Shard, ShardKind, WeightsVersion};
use magex_core::metrics_table::{METRICS, REWARD, SECOND_COST_RATIO, SUCCESS_RATE};
use magex_core::statics::Statics;
use magex_core::task::{Spawn, TaskConfig};
use magex_core::trajectory::{EpisodeMetrics, EvalOutcome, Recording, Shape, Trajectory};

pub(crate) fn task() -> TaskConfig {
    TaskConfig { horizon: 3, ..TaskConfig::simple_spread(5, Spawn::Uniform) }
}

pub(crate) fn train_shard(iteration: u32, index: u32, episodes: u32) -> Shard {
    Shard {
        kind: ShardKind::Train,
        iteration: Iteration(iteration),
        index,
        episodes,
        first_episode: index * episodes,
        version: WeightsVersion(iteration),
        mode: Mode::Sampled,
        eval_set: 0,
        record: false,
    }
}

fn shape(task: &TaskConfig, episodes: usize) -> Shape {
    task.shape(episodes)
}

/// 1 is a value that every metric may have; the reward is that of [`trajectory`].
fn metrics(episodes: usize) -> Vec<EpisodeMetrics> {
    let mut one = EpisodeMetrics([1.0; METRICS.len()]);
    (one[SUCCESS_RATE], one[REWARD], one[SECOND_COST_RATIO]) = (0.5, 0.3, f32::NAN);
    vec![one; episodes]
}

pub(crate) fn trajectory(task: &TaskConfig, shard: Shard) -> Trajectory {
    let shape = shape(task, shard.episodes as usize);
    let (t, b, n) = (shape.steps, shape.episodes, shape.agents);
    // Everything is at one place, so every assignment is exact.
    let in_order: Vec<u32> = (0..n as u32).collect();
    let cost = magex_assign::cost_of_points(&vec![0.5; 2 * n], &vec![0.2; 2 * n], 2, &in_order) as f32;
    Trajectory {
        shard,
        shape,
        positions: vec![0.5; (t + 1) * b * n * 2],
        velocities: vec![0.1; (t + 1) * b * n * 2],
        agent_state: vec![],
        statics: Statics::landmarks(n, 2, vec![0.2; b * n * 2]),
        goals: (0..b * n).map(|i| (i % n) as u32).collect(),
        actions: vec![1; t * b * n],
        log_probs: vec![-1.0; t * b * n],
        rewards: vec![0.3; t * b * n],
        moves: Vec::new(),
        masks: Vec::new(),
        marks: Vec::new(),
        world_states: Vec::new(),
        goal_log_probs: vec![-2.0; b],
        costs: vec![cost; b],
        exact_costs: vec![cost; b],
        metrics: metrics(b),
    }
}

pub(crate) fn eval_outcome(task: &TaskConfig, mut shard: Shard, record: bool) -> EvalOutcome {
    (shard.kind, shard.record) = (ShardKind::Eval, record);
    let shape = shape(task, 1);
    let n = shape.agents;
    let recording = record.then(|| Recording {
        shape,
        positions: vec![0.5; (shape.steps + 1) * n * 2],
        agent_state: vec![],
        statics: Statics::landmarks(n, 2, vec![0.2; n * 2]),
        pictures: Vec::new(),
        goals: (0..n as u32).collect(),
    });
    EvalOutcome { shard, metrics: metrics(shard.episodes as usize), recording }
}
