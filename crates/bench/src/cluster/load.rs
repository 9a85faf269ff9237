//! Made-up weights, plans and results.

use bytes::Bytes;
use magex_core::ids::{Iteration, Mode, RunId, Shard, ShardKind, WeightsVersion};
use magex_core::metrics_table::METRICS;
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

/// Numbers that could be those of an episode.
fn trajectory(task: &TaskConfig, shard: &Shard) -> Trajectory {
    let shape = task.shape(shard.episodes as usize);
    let (t, b, n) = (shape.steps, shape.episodes, shape.agents);
    let mut stream = Key::new(0, Purpose::Action, &[shard.index]).stream();
    let mut numbers = |count: usize| -> Vec<f32> { (0..count).map(|_| stream.uniform32()).collect() };
    // A value that every metric may have.
    let metrics = EpisodeMetrics([1.0; METRICS.len()]);
    Trajectory {
        shard: *shard,
        shape,
        positions: numbers((t + 1) * b * shape.bodies * shape.dims),
        velocities: numbers((t + 1) * b * shape.bodies * shape.dims),
        agent_state: numbers((t + 1) * b * n * shape.agent_state),
        statics: Statics::landmarks(shape.landmarks, shape.dims, numbers(b * shape.landmarks * shape.dims)),
        goals: (0..b).flat_map(|_| 0..n as u32).collect(),
        actions: vec![1; t * b * n * shape.action_components],
        log_probs: numbers(t * b * n).iter().map(|x| -x).collect(),
        rewards: numbers(t * b * n),
        goal_log_probs: vec![-1.0; b * shape.goals_per_agent],
        costs: vec![2.0; b * shape.goals_per_agent],
        exact_costs: vec![1.0; b * shape.goals_per_agent],
        metrics: vec![metrics; b],
    }
}

/// Weights of any content, different for every version.
pub(crate) fn weights(bytes: usize, version: u32) -> Arc<Weights> {
    let bytes: Vec<u8> = (0..bytes).map(|at| (at as u32 ^ version) as u8).collect();
    let run_id = RunId("bench".into());
    Arc::new(Weights::new(run_id, WeightsVersion(version), bytes.into()))
}
