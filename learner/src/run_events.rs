//! Events of a run, and the reasons for which collecting or training ends.

use magex_core::ids::{Iteration, RunId, Shard, WeightsVersion};
use magex_nets::params::ParamError;
use std::fmt;

/// Why the learner stops before the end of the run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum StopReason {
    /// The process shuts down.
    Shutdown,
    /// An operator requested it.
    Drain(String),
}

impl fmt::Display for StopReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Shutdown => f.write_str("shutdown"),
            Self::Drain(reason) if reason.is_empty() => f.write_str("drain"),
            Self::Drain(reason) => write!(f, "drain: {reason}"),
        }
    }
}

/// A plan that cannot be opened.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PlanError {
    /// There are no shards.
    #[error("the plan has no shards")]
    Empty,
    /// The same shard twice.
    #[error("the plan names shard {0} of iteration {1} twice")]
    Repeated(u32, u32),
    /// The previous plan is not complete.
    #[error("a plan is open with {done} of {total} shards done")]
    Open {
        /// Shards done.
        done: usize,
        /// Shards of the plan.
        total: usize,
    },
}

/// Why a plan was not collected.
#[derive(Debug, thiserror::Error)]
pub enum CollectError {
    /// The learner stops; the results of the plan are discarded.
    #[error("stopped ({0})")]
    Stopped(StopReason),
    /// A shard failed on every attempt.
    #[error("{} failed on every attempt, the last time with: {reason}", describe(.shard))]
    Shard {
        /// The shard.
        shard: Shard,
        /// The reason of the last failure.
        reason: String,
    },
    /// The plan is invalid.
    #[error("plan: {0}")]
    Plan(#[from] PlanError),
    /// The plan names weights that no actor can have.
    #[error("plan: names weights version {0}, which is not among the latest two that were published")]
    Version(WeightsVersion),
    /// Results were awaited without a plan.
    #[error("plan: no plan is open")]
    NoPlan,
    /// A plan was collected before any weights were published.
    #[error("weights: none were published before the plan")]
    NoWeights,
    /// The published weights belong to another run.
    #[error("run_id: weights of run '{weights}' published to run '{own}'")]
    OtherRun {
        /// Run of the weights.
        weights: RunId,
        /// Run that is served.
        own: RunId,
    },
    /// The published weights do not fit the configuration.
    #[error("weights: {0}")]
    Weights(#[from] ParamError),
    /// A rollout thread of this process panicked.
    #[error("a rollout thread panicked; its message is in the log above")]
    RolloutThread,
}

/// The name of a shard in messages.
pub(crate) fn describe(shard: &Shard) -> String {
    format!("{:?} shard {} of iteration {}", shard.kind, shard.index, shard.iteration).to_lowercase()
}

/// Something that happened in the run.
#[derive(Debug, Clone, PartialEq)]
pub enum RunEvent {
    /// An iteration was completed.
    Iteration(IterationReport),
    /// A message for people.
    Log(String),
    /// A checkpoint was written.
    Checkpoint {
        /// Iterations completed in it.
        iteration: Iteration,
        /// Where it is.
        path: String,
    },
    /// The run is complete.
    Finished {
        /// Its summary, one JSON object on one line.
        summary_json: String,
    },
}

/// Results of an iteration.
#[derive(Debug, Clone, PartialEq)]
pub struct IterationReport {
    /// Iterations completed.
    pub iteration: Iteration,
    /// Joint steps trained on so far.
    pub joint_env_steps: u64,
    /// Success rate, 0..=1, if it was measured.
    pub success: Option<f32>,
    /// Mean reward per agent and step.
    pub reward: Option<f32>,
    /// All metrics, one JSON object on one line.
    pub metrics_json: String,
}

impl IterationReport {
    /// Parses a line of metrics.jsonl; `None` if it is not one.
    pub(crate) fn parse(line: String) -> Option<Self> {
        let metrics: serde_json::Value = serde_json::from_str(&line).ok()?;
        Some(Self {
            iteration: Iteration(u32::try_from(metrics["iteration"].as_u64()?).ok()?),
            joint_env_steps: metrics["joint_env_steps"].as_u64()?,
            success: metrics["success_rate"].as_f64().map(|x| x as f32),
            reward: metrics["reward"].as_f64().map(|x| x as f32),
            metrics_json: line,
        })
    }
}
