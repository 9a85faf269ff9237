//! What does the work: the seam between the actor's connections and the rollout.

use crate::goals::{GoalError, GoalSource};
use magex_core::ids::{RunId, Shard};
use magex_core::trajectory::ShardResult;
use magex_proto::weights::Weights;
use std::sync::Arc;
use std::time::Duration;

/// What the learner tells an actor that it accepts: with a shard and its weights, everything that a result depends on.
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
    /// An actor that says nothing for so long loses its leases.
    pub lease: Duration,
}

/// Turns shards into results. Lives on one rollout thread; keeps nothing that a result could depend on.
pub trait Worker: Send {
    /// Does one shard with the weights that it names.
    fn work(&mut self, shard: &Shard, weights: &Weights, goals: &mut dyn GoalSource) -> Result<ShardResult, WorkError>;
}

/// Why a shard did not get done.
#[derive(Debug, thiserror::Error)]
pub enum WorkError {
    /// The goals did not come.
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
    /// A failure that every attempt would meet again.
    pub fn fatal(reason: impl Into<String>) -> Self {
        Self::Failed { reason: reason.into(), retryable: false }
    }

    /// Another attempt may succeed, here or at another actor.
    pub fn is_retryable(&self) -> bool {
        match self {
            Self::Goals(error) => {
                matches!(error, GoalError::Cancelled | GoalError::Late(_) | GoalError::NotLetIn(_))
            }
            Self::Failed { retryable, .. } => *retryable,
        }
    }

    /// Every shard would fail so at this actor, whoever else could do it.
    pub fn ends_the_actor(&self) -> bool {
        matches!(self, Self::Goals(GoalError::NotLetIn(_)))
    }
}

/// Makes the worker of one rollout thread. Called once per thread and run, and again after a worker panicked.
pub type MakeWorker = Arc<dyn Fn(&Welcome) -> Result<Box<dyn Worker>, WorkError> + Send + Sync>;
