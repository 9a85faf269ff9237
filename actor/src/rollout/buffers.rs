//! The joint states of a shard's episodes, and the assignment problems that they start with.

use magex_core::error::FieldError;
use magex_core::ids::Shard;
use magex_core::joint_state::{JointState, group_positions};
use magex_core::statics::{LANDMARKS, Statics};
use magex_core::task::Stage;
use magex_core::trajectory::Shape;
use magex_env::Env;
use magex_proto::goals::GoalRequest;

/// The joint states of B episodes at one step, read from the environment.
pub(super) struct Buffers {
    pub(super) positions: Vec<f32>,
    pub(super) velocities: Vec<f32>,
    pub(super) agent_state: Vec<f32>,
    pub(super) statics: Statics,
    pub(super) goals: Vec<u32>,
}

impl Buffers {
    pub(super) fn new(shape: &Shape, statics: &Statics) -> Self {
        let state = shape.episodes * shape.bodies * shape.dims;
        Self {
            positions: vec![0.0; state],
            velocities: vec![0.0; state],
            agent_state: vec![0.0; shape.episodes * shape.agents * shape.agent_state],
            statics: statics.clone(),
            goals: Vec::new(),
        }
    }

    pub(super) fn read(&mut self, worlds: &Env) -> Result<(), FieldError> {
        worlds.write_positions(&mut self.positions)?;
        worlds.write_velocities(&mut self.velocities)?;
        worlds.write_agent_state(&mut self.agent_state)
    }

    pub(super) fn joint_state(&self) -> JointState<'_> {
        JointState {
            positions: &self.positions,
            velocities: &self.velocities,
            agent_state: &self.agent_state,
            world_states: &[],
            masks: &[],
            marks: &[],
            statics: self.statics.view(),
            goals: &self.goals,
        }
    }

    /// The assignment problems of all episodes as they start.
    pub(super) fn goal_request(&self, shape: &Shape, stages: &[Stage], shard: &Shard, seed: u64) -> GoalRequest {
        let points = (&*self.positions, self.statics.get(LANDMARKS));
        let (mut agents, mut goals) = (Vec::new(), Vec::new());
        for episode in 0..shape.episodes {
            for stage in stages {
                agents.extend_from_slice(group_positions(shape, points, stage.from, episode));
                goals.extend_from_slice(group_positions(shape, points, stage.to, episode));
            }
        }
        GoalRequest {
            shard: *shard,
            seed,
            stages: stages.len(),
            agent_count: shape.agents,
            goal_count: shape.agents,
            dims: shape.dims,
            agents,
            goals,
        }
    }
}

/// [B, K, N] assignments, stage by stage, to the [B, N, K] goals that each agent finds by following them.
pub(super) fn chain(shape: &Shape, assigned: &[u32]) -> Vec<u32> {
    let (n, k) = (shape.agents, shape.goals_per_agent);
    let mut goals = Vec::with_capacity(assigned.len());
    for episode in assigned.chunks_exact(n * k) {
        for agent in 0..n {
            let mut at = agent;
            for stage in episode.chunks_exact(n) {
                // Out of range cannot be: the reply was checked. If it were, the environment would refuse it.
                let next = stage.get(at).copied().unwrap_or(u32::MAX);
                goals.push(next);
                at = next as usize;
            }
        }
    }
    goals
}
