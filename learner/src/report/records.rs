//! The records of a run: a line of metrics.jsonl for every iteration, and summary.json at its end. docs/metrics.md describes
//! every field.

use crate::report::bottleneck::{Bottleneck, CollectTiming, attribute};
use crate::report::means::{ClosingMeans, IterationMeans};
use crate::train::commander_ppo::CommanderStats;
use crate::train::stats::UpdateStats;
use serde::{Deserialize, Serialize};

/// Where an iteration's wall time went, in seconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Timing {
    /// Publishing the weights.
    pub publish_s: f64,
    /// Waiting for the actors.
    pub collect_s: f64,
    /// Updating the executor.
    pub executor_s: f64,
    /// What updating the commander, which goes on beside the executor's update, took beyond it.
    pub commander_s: f64,
    /// Writing checkpoints.
    pub checkpoint_s: f64,
    /// The stage that took most of it.
    pub bottleneck: Bottleneck,
}

impl Timing {
    pub(crate) fn attributed(self, collected: Option<&CollectTiming>) -> Self {
        let learner_s = self.publish_s + self.executor_s + self.commander_s + self.checkpoint_s;
        Self { bottleneck: attribute(learner_s, self.collect_s, collected), ..self }
    }

    pub(crate) fn seconds(&self) -> f64 {
        self.publish_s + self.collect_s + self.executor_s + self.commander_s + self.checkpoint_s
    }
}

/// One line of metrics.jsonl: the version of the weights that iteration `iteration` begins with, evaluated, rolled out and
/// updated. Fields of an evaluation are null on iterations without one; those of the updates are null on the last line of a run,
/// which does not train.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct IterationMetrics {
    /// From 0. Equals the version of the weights that was evaluated and rolled out.
    pub iteration: u32,
    /// Joint environment steps that this version has been trained on.
    pub joint_env_steps: u64,
    /// Agent steps that this version has been trained on.
    pub agent_steps: u64,
    /// What its episodes scored.
    #[serde(flatten)]
    pub episodes: IterationMeans,
    /// Executor update.
    pub executor: Option<UpdateStats>,
    /// Commander update.
    pub commander: Option<CommanderStats>,
    /// Where the time went.
    pub timing: Timing,
    /// Joint steps trained on per second of this iteration.
    pub joint_steps_per_s: f64,
    /// Seconds since the run began, over all its processes.
    pub wall_s: f64,
}

/// What a finished run achieved: the evaluation that closes it, on spawns never seen before.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// What its episodes scored.
    #[serde(flatten)]
    pub episodes: ClosingMeans,
    /// Joint environment steps trained on.
    pub joint_env_steps: u64,
    /// Agent steps trained on.
    pub agent_steps: u64,
    /// Seconds of the learner from its start to the end of training, the closing evaluation excluded.
    pub wall_s: f64,
    /// Iterations completed.
    pub iterations: u32,
    /// Episodes of each closing evaluation.
    pub final_episodes: u32,
    /// Whether the target was reached before the budget was spent.
    pub target_reached: bool,
    /// SHA-256 of weights.safetensors.
    pub weights_sha256: String,
    /// Task.
    pub task: String,
    /// Architecture of the executor.
    pub executor: String,
    /// Goal scheduler.
    pub scheduler: String,
    /// N.
    pub agents: usize,
    /// Seed of the run.
    pub seed: u64,
}
