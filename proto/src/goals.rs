//! An actor's request to the commander for the goals of a shard, and the reply.

use crate::arrays::finite;
use crate::{arrays, convert, v1};
use magex_core::error::FieldError;
use magex_core::ids::{RunId, Shard, WeightsVersion};

/// How goals are assigned.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum AssignmentMethod {
    /// The trained scheduler of a run.
    Learned,
    /// The smallest summed cost.
    #[default]
    Exact,
    /// The cheapest remaining pair, repeatedly.
    Greedy,
    /// A uniformly random matching.
    Random,
    /// The smallest largest cost.
    Makespan,
}

impl AssignmentMethod {
    /// All methods.
    pub const ALL: [Self; 5] = [Self::Learned, Self::Exact, Self::Makespan, Self::Greedy, Self::Random];

    /// Its name in metrics, options and documentation.
    pub fn name(self) -> &'static str {
        match self {
            Self::Learned => "learned",
            Self::Exact => "exact",
            Self::Greedy => "greedy",
            Self::Random => "random",
            Self::Makespan => "makespan",
        }
    }
}

impl From<AssignmentMethod> for v1::AssignmentMethod {
    fn from(kind: AssignmentMethod) -> Self {
        match kind {
            AssignmentMethod::Learned => Self::Learned,
            AssignmentMethod::Exact => Self::Exact,
            AssignmentMethod::Greedy => Self::Greedy,
            AssignmentMethod::Random => Self::Random,
            AssignmentMethod::Makespan => Self::Makespan,
        }
    }
}

impl From<v1::AssignmentMethod> for AssignmentMethod {
    fn from(kind: v1::AssignmentMethod) -> Self {
        // Learned unless specified.
        Self::ALL.into_iter().find(|method| v1::AssignmentMethod::from(*method) == kind).unwrap_or_default()
    }
}

/// The weights that a request names.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct WeightsKey {
    /// Run of the weights.
    pub run_id: RunId,
    /// Their version.
    pub version: WeightsVersion,
    /// SHA-256 of their bytes, lower-case hex.
    pub sha256: String,
}

/// The teams of one shard. The reply is a pure function of it and of the weights that `shard.version` names.
#[derive(Debug, Clone, PartialEq)]
pub struct GoalRequest {
    /// The shard: kind, iteration, index, set and first episode are keys; version and mode are instructions.
    pub shard: Shard,
    /// Seed of the run.
    pub seed: u64,
    /// K: assignment problems per episode, in order; see `TaskConfig::stages`.
    pub stages: usize,
    /// N: agents per problem.
    pub agent_count: usize,
    /// G: goals per problem.
    pub goal_count: usize,
    /// D: space dimensions.
    pub dims: usize,
    /// [B, K, N, D] world units, with B = `shard.episodes`.
    pub agents: Vec<f32>,
    /// [B, K, G, D] world units.
    pub goals: Vec<f32>,
}

/// The assignments of one shard.
#[derive(Debug, Clone, PartialEq)]
pub struct GoalReply {
    /// [B, K, N] the goal of each agent in each stage.
    pub goals: Vec<u32>,
    /// [B, K] log-probability of each assignment (0 unless learned).
    pub log_probs: Vec<f32>,
    /// [B, K] summed distance of each assignment, world units.
    pub costs: Vec<f32>,
    /// [B, K] smallest possible summed distance, world units.
    pub exact_costs: Vec<f32>,
}

impl GoalRequest {
    /// The message of a request to these weights.
    pub fn to_message(&self, weights: &WeightsKey) -> v1::AssignBatchRequest {
        let b = self.shard.episodes as usize;
        v1::AssignBatchRequest {
            run_id: weights.run_id.0.clone(),
            sha256: weights.sha256.clone(),
            seed: self.seed,
            shard: Some((&self.shard).into()),
            agents: Some(arrays::from_f32(&[b, self.stages, self.agent_count, self.dims], &self.agents)),
            goals: Some(arrays::from_f32(&[b, self.stages, self.goal_count, self.dims], &self.goals)),
        }
    }

    /// Reads a message: the request, and the weights that it names. Positions are finite afterwards.
    pub fn from_message(message: v1::AssignBatchRequest) -> Result<(Self, WeightsKey), FieldError> {
        let shard = convert::shard("shard", message.shard.as_ref())?;
        let agent_shape = arrays::shape_of("agents", message.agents.as_ref(), 4)?;
        let goal_shape = arrays::shape_of("goals", message.goals.as_ref(), 4)?;
        let (b, stages, dims) = (shard.episodes as usize, agent_shape[1], agent_shape[3]);
        let agents = finite("agents", arrays::to_f32("agents", message.agents, &[b, stages, agent_shape[2], dims])?)?;
        let goals = finite("goals", arrays::to_f32("goals", message.goals, &[b, stages, goal_shape[2], dims])?)?;
        FieldError::ensure(stages > 0, || ("agents", "0 stages; send at least one assignment problem per episode"))?;
        let (agent_count, goal_count) = (agent_shape[2], goal_shape[2]);
        let version = shard.version;
        let request = Self { shard, seed: message.seed, stages, agent_count, goal_count, dims, agents, goals };
        Ok((request, WeightsKey { run_id: RunId(message.run_id), version, sha256: message.sha256 }))
    }
}

impl GoalReply {
    /// The message of a reply to a request.
    pub fn to_message(&self, request: &GoalRequest, version: WeightsVersion) -> v1::AssignBatchResponse {
        let problems = [request.shard.episodes as usize, request.stages];
        v1::AssignBatchResponse {
            goals: Some(arrays::from_u32(&[problems[0], problems[1], request.agent_count], &self.goals)),
            log_probs: Some(arrays::from_f32(&problems, &self.log_probs)),
            costs: Some(arrays::from_f32(&problems, &self.costs)),
            exact_costs: Some(arrays::from_f32(&problems, &self.exact_costs)),
            version: version.0,
        }
    }

    /// Reads the reply to a request: shapes match, numbers are finite, and goals exist.
    pub fn from_message(message: v1::AssignBatchResponse, request: &GoalRequest) -> Result<Self, FieldError> {
        let problems = [request.shard.episodes as usize, request.stages];
        let (found, asked) = (message.version, request.shard.version);
        FieldError::ensure(found == asked.0, || {
            ("version", format!("version {found} answered a request to version {asked}"))
        })?;
        let goals = arrays::to_u32("goals", message.goals, &[problems[0], problems[1], request.agent_count])?;
        if let Some(goal) = goals.iter().find(|&&goal| goal as usize >= request.goal_count) {
            return Err(FieldError::new("goals", format!("{goal} is not below {}", request.goal_count)));
        }
        Ok(Self {
            goals,
            log_probs: finite("log_probs", arrays::to_f32("log_probs", message.log_probs, &problems)?)?,
            costs: finite("costs", arrays::to_f32("costs", message.costs, &problems)?)?,
            exact_costs: finite("exact_costs", arrays::to_f32("exact_costs", message.exact_costs, &problems)?)?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use magex_core::ids::{Iteration, Mode, ShardKind};

    fn request() -> GoalRequest {
        let shard = Shard {
            kind: ShardKind::Train,
            iteration: Iteration(1),
            index: 2,
            episodes: 2,
            first_episode: 4,
            version: WeightsVersion(1),
            mode: Mode::Sampled,
            eval_set: 0,
            record: false,
        };
        let points: Vec<f32> = (0..8).map(|i| i as f32).collect();
        let (seed, goals) = (5, points.clone());
        GoalRequest { shard, seed, stages: 1, agent_count: 2, goal_count: 2, dims: 2, agents: points, goals }
    }

    #[test]
    fn request_and_reply_round_trip() {
        let key = WeightsKey { run_id: RunId("r".into()), version: WeightsVersion(1), sha256: "ab".into() };
        let back = GoalRequest::from_message(request().to_message(&key)).unwrap();
        assert_eq!(back, (request(), key));
        let reply = GoalReply {
            goals: vec![1, 0, 0, 1],
            log_probs: vec![-1.0, 0.0],
            costs: vec![2.0, 3.0],
            exact_costs: vec![2.0, 2.5],
        };
        let message = reply.to_message(&request(), WeightsVersion(1));
        assert_eq!(GoalReply::from_message(message.clone(), &request()).unwrap(), reply);
        let other = v1::AssignBatchResponse { version: 2, ..message };
        assert!(GoalReply::from_message(other, &request()).unwrap_err().to_string().contains("version 2 answered"));
    }

    #[test]
    fn a_request_without_a_stage_is_rejected() {
        let key = WeightsKey { run_id: RunId("r".into()), version: WeightsVersion(1), sha256: "ab".into() };
        let empty = GoalRequest { stages: 0, agents: vec![], goals: vec![], ..request() };
        assert!(
            GoalRequest::from_message(empty.to_message(&key)).unwrap_err().to_string().starts_with("agents: 0 stages")
        );
    }

    #[test]
    fn a_position_that_is_not_finite_is_named() {
        let key = WeightsKey { run_id: RunId("r".into()), version: WeightsVersion(1), sha256: "ab".into() };
        let mut bad = request();
        bad.goals[3] = f32::NAN;
        let error = GoalRequest::from_message(bad.to_message(&key)).unwrap_err();
        assert_eq!(error.to_string(), "goals[3]: NaN is not finite");
    }
}
