//! The seam to whatever has learned to hand out goals.

use magex_core::ids::Mode;
pub use magex_proto::goals::{GoalReply, GoalRequest, SchedulerKind, WeightsKey};
use std::sync::Arc;

/// One team from an outside client. N and G may differ.
#[derive(Debug, Clone, PartialEq)]
pub struct TeamRequest {
    /// N: agents.
    pub agent_count: usize,
    /// G: goals.
    pub goal_count: usize,
    /// D: space dimensions.
    pub dims: usize,
    /// `[N, D]` world units.
    pub agents: Vec<f32>,
    /// `[G, D]` world units.
    pub goals: Vec<f32>,
    /// How the goals are chosen.
    pub mode: Mode,
    /// Key of what is random.
    pub seed: u64,
}

/// The assignment of one team.
#[derive(Debug, Clone, PartialEq)]
pub struct TeamReply {
    /// `[N]` the goal of each agent; no goal twice, and `None` only when goals run out.
    pub goals: Vec<Option<u32>>,
    /// `[N]` probability that the policy gave to each agent's goal, if it has one.
    pub probabilities: Option<Vec<f32>>,
}

/// Why there is no assignment.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum AssignError {
    /// This scheduler cannot answer such a request; another can.
    #[error("not supported: {0}")]
    Unsupported(String),
    /// The request makes no sense.
    #[error("{field}: {problem}")]
    Invalid {
        /// Which field.
        field: String,
        /// What is wrong with it.
        problem: String,
    },
    /// Nobody waits for it any more.
    #[error("interrupted")]
    Interrupted,
    /// Anything else.
    #[error("{0}")]
    Failed(String),
}

impl AssignError {
    /// The request makes no sense.
    pub fn invalid(field: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::Invalid { field: field.into(), problem: problem.into() }
    }
}

/// One version of a trained commander. Answers are pure functions of the request.
pub trait Scheduler: Send + Sync {
    /// Goals for the episodes of a shard, for as long as `go_on` says so; what is random is keyed by (seed, shard).
    fn assign_batch(&self, request: &GoalRequest, go_on: &dyn Fn() -> bool) -> Result<GoalReply, AssignError>;

    /// It answers single teams, too.
    fn teams(&self) -> bool {
        true
    }

    /// Goals for one team; what is random is keyed by the seed.
    fn assign_team(&self, request: &TeamRequest) -> Result<TeamReply, AssignError>;
}

/// Makes a scheduler of the weights (safetensors) and the run's configuration (TOML).
pub type LoadScheduler = fn(&[u8], &str) -> Result<Arc<dyn Scheduler>, AssignError>;
