//! Made-up weights, plans and results.

use bytes::Bytes;
use magex_assign::{cost_of_points, exact_points};
use magex_core::ids::{Iteration, Mode, RunId, Shard, ShardKind, WeightsVersion};
use magex_core::metrics_table::{COST_RATIO, METRICS, REWARD};
use magex_core::rng::{Key, Purpose};
use magex_core::statics::Statics;
use magex_core::task::{Spawn, TaskConfig};
use magex_core::trajectory::{EpisodeMetrics, ShardResult, Trajectory};
use magex_proto::convert::encode_result;
use magex_proto::weights::Weights;
use std::sync::Arc;

/// Shards of a plan: more than there are leases out at any time, so that no actor waits for the next plan.
const PLAN: u32 = 512;
/// Different results; the shards of a plan take turns.
const RESULTS: u32 = 32;

/// What the simulated actors send.
#[derive(Clone)]
pub(super) struct Load {
    pub(super) task: TaskConfig,
    pub(super) weights: Arc<Weights>,
    pub(super) plan: Vec<Shard>,
}

impl Load {
    pub(super) fn new(agents: usize, episodes: u32) -> Self {
        let task = TaskConfig::simple_spread(agents, Spawn::Uniform);
        let plan = (0..PLAN).map(|index| shard(index, episodes)).collect();
        Self { task, weights: weights(64, 0), plan }
    }

    /// The encoded results of the plan.
    pub(super) fn results(&self) -> Vec<Bytes> {
        let made: Vec<Trajectory> =
            self.plan.iter().take(RESULTS as usize).map(|shard| trajectory(&self.task, shard)).collect();
        let encode = |shard: &Shard| {
            let like = &made[(shard.index % RESULTS) as usize];
            let result = ShardResult::Train(Trajectory { shard: *shard, ..like.clone() });
            encode_result(&self.weights.run_id, &self.weights.sha256, &result)
        };
        self.plan.iter().map(encode).collect()
    }
}

fn shard(index: u32, episodes: u32) -> Shard {
    Shard {
        kind: ShardKind::Train,
        iteration: Iteration(0),
        index,
        episodes,
        first_episode: index * episodes,
        version: WeightsVersion(0),
        mode: Mode::Sampled,
        eval_set: 0,
        record: false,
    }
}

/// Numbers that could be those of an episode: the learner refuses others.
fn trajectory(task: &TaskConfig, shard: &Shard) -> Trajectory {
    let shape = task.shape(shard.episodes as usize);
    let (t, b, n) = (shape.steps, shape.episodes, shape.agents);
    let mut stream = Key::new(0, Purpose::Action, &[shard.index]).stream();
    let mut numbers = |count: usize| -> Vec<f32> { (0..count).map(|_| stream.uniform32()).collect() };
    let positions = numbers((t + 1) * b * shape.bodies * shape.dims);
    let landmarks = numbers(b * shape.landmarks * shape.dims);
    let rewards = numbers(t * b * n);
    let in_order: Vec<u32> = (0..n as u32).collect();
    let width = n * shape.dims;
    let sides = |e: usize| (&positions[e * width..(e + 1) * width], &landmarks[e * width..(e + 1) * width]);
    let cost = |e| cost_of_points(sides(e).0, sides(e).1, shape.dims, &in_order) as f32;
    let exact = |e| exact_points(sides(e).0, sides(e).1, shape.dims).map_or(0.0, |(_, cost)| cost as f32);
    let (costs, exact_costs): (Vec<f32>, Vec<f32>) = (0..b).map(|e| (cost(e), exact(e))).unzip();
    let metrics = |e: usize| {
        // A value that every metric may have.
        let mut metrics = EpisodeMetrics([1.0; METRICS.len()]);
        let row = |step: usize| &rewards[(step * b + e) * n..(step * b + e + 1) * n];
        metrics[REWARD] = ((0..t).flat_map(row).map(|&x| f64::from(x)).sum::<f64>() / (t * n) as f64) as f32;
        metrics[COST_RATIO] = costs[e] / exact_costs[e].max(1e-9);
        metrics
    };
    Trajectory {
        shard: *shard,
        shape,
        metrics: (0..b).map(metrics).collect(),
        velocities: numbers((t + 1) * b * shape.bodies * shape.dims),
        agent_state: numbers((t + 1) * b * n * shape.agent_state),
        statics: Statics::landmarks(shape.landmarks, shape.dims, landmarks),
        goals: (0..b).flat_map(|_| 0..n as u32).collect(),
        actions: vec![1; t * b * n * shape.action_components],
        log_probs: numbers(t * b * n).iter().map(|x| -x).collect(),
        moves: Vec::new(),
        masks: Vec::new(),
        marks: Vec::new(),
        world_states: Vec::new(),
        goal_log_probs: vec![-1.0; b * shape.goals_per_agent],
        costs,
        exact_costs,
        positions,
        rewards,
    }
}

/// Weights of any content, different for every version.
pub(crate) fn weights(bytes: usize, version: u32) -> Arc<Weights> {
    let bytes: Vec<u8> = (0..bytes).map(|at| (at as u32 ^ version) as u8).collect();
    let run_id = RunId("bench".into());
    Arc::new(Weights::new(run_id, WeightsVersion(version), bytes.into()))
}
