//! The seam between the rollout pool and the rollout.

use crate::goal_client::{GoalError, GrpcGoals};
use magex_core::ids::Shard;
use magex_core::trajectory::ShardResult;
use magex_proto::v1::Welcome;
use magex_proto::weights::Weights;
use std::sync::Arc;

/// Turns shards into results. Belongs to one rollout thread and keeps no state that a result could depend on.
pub trait Worker: Send {
    /// Rolls out one shard with the weights that it names.
    fn work(&mut self, shard: &Shard, weights: &Weights, goals: &mut GrpcGoals) -> Result<ShardResult, WorkError>;
}

/// Why a shard failed.
#[derive(Debug, thiserror::Error)]
pub enum WorkError {
    /// The goals are not available.
    #[error("goals: {0}")]
    Goals(#[from] GoalError),
    /// Anything else after which another attempt may succeed.
    #[error("{0}")]
    Retryable(String),
    /// A failure that every attempt would repeat.
    #[error("{0}")]
    Fatal(String),
}

impl WorkError {
    /// A failure that every attempt would repeat.
    pub fn fatal(reason: impl Into<String>) -> Self {
        Self::Fatal(reason.into())
    }

    /// Another attempt may succeed, here or at another actor.
    pub fn is_retryable(&self) -> bool {
        use GoalError::{Cancelled, Late, Unauthorized};
        matches!(self, Self::Retryable(_) | Self::Goals(Cancelled | Late(_) | Unauthorized(_)))
    }

    /// Every shard would fail in this way at this actor, though another actor may succeed.
    pub fn is_fatal_to_actor(&self) -> bool {
        matches!(self, Self::Goals(GoalError::Unauthorized(_)))
    }
}

/// Creates the worker of one rollout thread for the run of a learner. Together with a shard and its weights, the learner's
/// welcome determines every result. Called once per thread and run, and again after a worker panicked.
pub type MakeWorker = Arc<dyn Fn(&Welcome) -> Result<Box<dyn Worker>, WorkError> + Send + Sync>;
