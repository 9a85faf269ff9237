//! Events of a run, and the reasons for which collecting or training ends.

use crate::origin::Conviction;
use magex_core::ids::{RunId, Shard, WeightsVersion};
use magex_nets::params::ParamError;
use magex_proto::v1;
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
    /// An actor is proven to compute wrong results; the results of the plan are discarded.
    #[error(
        "actor {} (process {:x}) sent a wrong result of {}: {} where every other computation gives {}",
        .0.origin.actor, .0.origin.process, describe(&.0.shard), .0.origin.digest, .0.digest
    )]
    Convicted(Box<Conviction>),
    /// Two actors disagree, and this host cannot find out which of them is right.
    #[error("{} has two different results, from {first} and {second}, and cannot be computed here: {reason}", describe(.shard))]
    Undecided {
        /// The shard.
        shard: Shard,
        /// Name of one actor.
        first: String,
        /// Name of the other.
        second: String,
        /// Why this host cannot compute it.
        reason: String,
    },
    /// The plan has no shards.
    #[error("plan: the plan has no shards")]
    EmptyPlan,
    /// The plan names this shard of this iteration twice.
    #[error("plan: the plan names shard {0} of iteration {1} twice")]
    Repeated(u32, u32),
    /// The previous plan is not complete.
    #[error("plan: a plan is open with {0} of {1} shards done")]
    OpenPlan(usize, usize),
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
    #[error("run_id: weights of run '{0}' published to run '{1}'")]
    OtherRun(RunId, RunId),
    /// The published weights do not fit the configuration.
    #[error("weights: {0}")]
    Weights(#[from] ParamError),
    /// A rollout thread of this process panicked.
    #[error("a rollout thread panicked; its message is in the log above")]
    RolloutThread,
}

pub(crate) fn describe(shard: &Shard) -> String {
    format!("{:?} shard {} of iteration {}", shard.kind, shard.index, shard.iteration).to_lowercase()
}

/// Something that happened in the run, as `WatchRun` sends it.
pub type RunEvent = v1::watch_run_response::Event;

/// Parses a line of metrics.jsonl, the last one of a run that has done what `completed` counts (iterations, joint steps); `None`
/// if it is not one.
pub(crate) fn parse_report(line: String, completed: (u32, u64)) -> Option<v1::IterationEvent> {
    let metrics: serde_json::Value = serde_json::from_str(&line).ok()?;
    Some(v1::IterationEvent {
        iteration: u32::try_from(metrics["iteration"].as_u64()?).ok()?,
        joint_env_steps: metrics["joint_env_steps"].as_u64()?,
        success: metrics["success_rate"].as_f64().map(|x| x as f32),
        reward: metrics["reward"].as_f64().map(|x| x as f32),
        metrics_json: line,
        iterations_completed: completed.0,
        joint_env_steps_trained: completed.1,
    })
}
