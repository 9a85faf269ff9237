//! The seam between the rollout pool and the rollout.

use crate::goal_client::{GoalError, GoalSource};
use magex_core::ids::{RunId, Shard};
use magex_core::trajectory::ShardResult;
use magex_proto::weights::Weights;
use std::sync::Arc;
use std::time::Duration;

/// What the learner tells an actor that it accepts. Together with a shard and its weights this determines every result.
#[derive(Debug, Clone, PartialEq)]
pub struct Welcome {
    /// Identity of the run.
    pub run_id: RunId,
    /// Fingerprint of the run's task.
    pub task_fingerprint: String,
    /// The run's configuration, TOML.
    pub run_config_toml: String,
    /// Seed of the run.
    pub seed: u64,
    /// An actor that sends nothing for this time loses its leases.
    pub lease: Duration,
}

/// Turns shards into results. Belongs to one rollout thread and keeps no state that a result could depend on.
pub trait Worker: Send {
    /// Rolls out one shard with the weights that it names.
    fn work(&mut self, shard: &Shard, weights: &Weights, goals: &mut dyn GoalSource) -> Result<ShardResult, WorkError>;
}

/// Why a shard failed.
#[derive(Debug, thiserror::Error)]
pub enum WorkError {
    /// The goals are not available.
    #[error("goals: {0}")]
    Goals(#[from] GoalError),
    /// Anything else. `retryable`: another attempt may succeed.
    #[error("{reason}")]
    Failed {
        /// What went wrong.
        reason: String,
        /// Another attempt may succeed.
        retryable: bool,
    },
}

impl WorkError {
    /// A failure that every attempt would repeat.
    pub fn fatal(reason: impl Into<String>) -> Self {
        Self::Failed { reason: reason.into(), retryable: false }
    }

    /// Another attempt may succeed, here or at another actor.
    pub fn is_retryable(&self) -> bool {
        match self {
            Self::Goals(error) => {
                matches!(error, GoalError::Cancelled | GoalError::Late(_) | GoalError::Unauthorized(_))
            }
            Self::Failed { retryable, .. } => *retryable,
        }
    }

    /// Every shard would fail in this way at this actor, though another actor may succeed.
    pub fn is_fatal_to_actor(&self) -> bool {
        matches!(self, Self::Goals(GoalError::Unauthorized(_)))
    }
}

/// Creates the worker of one rollout thread. Called once per thread and run, and again after a worker panicked.
pub type MakeWorker = Arc<dyn Fn(&Welcome) -> Result<Box<dyn Worker>, WorkError> + Send + Sync>;
