//! What a run tells whoever watches it, and why collecting or training ends.

use crate::serve::ledger::PlanError;
use crate::serve::validate::describe;
use magex_core::ids::{Iteration, Shard, WeightsVersion};
use std::fmt;

/// Why the learner stops before the end of the run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum StopReason {
    /// The process was told to stop.
    Shutdown,
    /// An operator asked for it.
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

/// Why a plan did not get done.
#[derive(Debug, thiserror::Error)]
pub enum CollectError {
    /// The learner stops; nothing of the plan is kept.
    #[error("stopped ({0})")]
    Stopped(StopReason),
    /// A shard failed on every attempt.
    #[error("{} failed on every attempt, the last time with: {reason}", describe(.shard))]
    Shard {
        /// Which.
        shard: Shard,
        /// What the last actor said.
        reason: String,
    },
    /// The plan makes no sense.
    #[error("plan: {0}")]
    Plan(#[from] PlanError),
    /// The plan names weights that no actor can have.
    #[error("plan: names weights version {0}, which is not among the latest two that were published")]
    Version(WeightsVersion),
    /// Anything else.
    #[error("{0}")]
    Other(String),
}

/// Something that happened in the run.
#[derive(Debug, Clone, PartialEq)]
pub enum RunEvent {
    /// An iteration was completed.
    Iteration(IterationReport),
    /// Something to tell a person.
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

/// What an iteration was like.
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
    /// What a line of metrics.jsonl says; `None` if it is not one.
    pub(crate) fn of(line: String) -> Option<Self> {
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
