//! The interface to the scheduler of a run.

use magex_assign::GoOn;
use magex_dispatch::Problem;
use magex_policy::acting::Policies;
use magex_proto::convert::ConvertError;
pub use magex_proto::goals::{AssignmentMethod, GoalReply, GoalRequest, WeightsKey};
use std::sync::Arc;

/// The assignment of one team.
#[derive(Debug, Clone, PartialEq)]
pub struct TeamReply {
    /// `[N]` goal of each agent, all different; `None` only if there are fewer goals than agents.
    pub goals: Vec<Option<u32>>,
    /// `[N]` probability that the policy gave to each agent's goal, if it has one.
    pub probabilities: Option<Vec<f32>>,
}

/// Why a scheduler has no assignment.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SchedulerError {
    /// This scheduler does not support the request; another method does.
    #[error("not supported: {0}")]
    Unsupported(String),
    /// A field of the request is invalid.
    #[error(transparent)]
    Invalid(#[from] ConvertError),
    /// The call has ended.
    #[error("interrupted")]
    Interrupted,
    /// The weights or the configuration of the run are invalid.
    #[error("{0}")]
    Load(String),
    /// The computation failed.
    #[error("{0}")]
    Compute(String),
}

/// The scheduler of a run with one version of its weights. Answers are pure functions of the request.
pub trait Scheduler: Send + Sync {
    /// Goals for the episodes of a shard, for as long as `go_on` holds; random choices are keyed by (seed, shard).
    fn assign_batch(&self, request: &GoalRequest, go_on: GoOn<'_>) -> Result<GoalReply, SchedulerError>;

    /// The method that the run configures. Only a learned scheduler answers single teams.
    fn method(&self) -> AssignmentMethod {
        AssignmentMethod::Learned
    }

    /// Goals for the positions of one team of an external client; N and G may differ. Random choices are keyed by its seed.
    fn assign_team(&self, problem: &Problem) -> Result<TeamReply, SchedulerError>;

    /// The policy of the same weights, or why there is none.
    fn policies(&self) -> Result<&Policies, &str> {
        Err("the model has no policy")
    }
}

/// Makes a scheduler of the weights (safetensors) and the run's configuration (TOML).
pub type LoadScheduler = fn(&[u8], &str) -> Result<Arc<dyn Scheduler>, SchedulerError>;
