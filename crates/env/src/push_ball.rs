//! Push Ball as the rest of MAGE-X sees it.

mod batch;
pub(crate) mod law;
pub mod layouts;
mod start;

use crate::env::{Env, all_covered};
use crate::error::{EnvError, check_actions, check_finite, check_len};
use crate::spread::LANES;
use batch::Batch;
use magex_core::metrics_table::{
    ALL_COVERED_RATE, ARRIVAL_STEP, COLLISION_RATE, COLLISIONS_PER_AGENT_STEP, MATCHED_SUCCESS_RATE, REWARD,
    SPAWN_SUCCESS_RATE, SUCCESS_RATE,
};
use magex_core::rng::Stream;
use magex_core::task::{PushBallConfig, TaskConfig};
use magex_core::trajectory::EpisodeMetrics;

pub use start::{Start, spawn};

/// Radius of an agent.
pub const AGENT_RADIUS: f64 = PushBallConfig::AGENT_RADIUS;
/// Radius of a ball.
pub const BALL_RADIUS: f64 = PushBallConfig::BALL_RADIUS;
/// An agent touches a ball when their centres are this close.
pub const PUSH_DISTANCE: f64 = PushBallConfig::PUSH_DISTANCE;
/// A landmark is covered when a ball's centre is within this distance (ball radius 0.15 + landmark radius 0.15).
pub const REACHED: f64 = 0.3;

/// Balls start at least this far from each other, and so do landmarks, wherever they fit.
pub const SPACING: f64 = 2.0 * BALL_RADIUS;

/// Bodies from which neighbours are found by cells; see [`crate::Spread`], which does the same.
const CELLS_FROM: usize = 256;

/// B episodes of Push Ball with N agents, N balls and N landmarks (paper, section 5.1.1), stepped together.
///
/// Arrays are row-major: positions and velocities `[B, 2N, 2]` (agents, then balls) in world units (and per second),
/// landmarks `[B, N, 2]`, goals `[B, N, 2]` (the agent's ball, that ball's landmark), actions and rewards `[B, N]`. Balls
/// move by contact only. Episode b depends only on the task, its stream, its goals and its actions: not on B, not on b.
#[derive(Debug, Clone)]
pub struct PushBall {
    worlds: Worlds,
    agents: usize,
    horizon: u32,
    steps: u32,
    goals: Vec<u32>,
    /// `[B]`
    spawn_success: Vec<f32>,
}

/// Small worlds share registers; a large one, or one of a few, is looked at by itself. Both ways give the same bits.
#[derive(Debug, Clone)]
enum Worlds {
    Lanes(Batch<f32, LANES>),
    Cells(Batch<f32, 1>),
}

/// The same call on either.
macro_rules! either {
    ($worlds:expr, $batch:ident => $call:expr) => {
        match $worlds {
            Worlds::Lanes($batch) => $call,
            Worlds::Cells($batch) => $call,
        }
    };
}

impl PushBall {
    /// One episode per stream, spawned as the task says; `training` mixes in starts in line with balls
    /// (`task.push_ball.start_in_line_fraction`). Errors if the task does not validate.
    pub fn new(task: &TaskConfig, streams: impl Iterator<Item = Stream>, training: bool) -> Result<Self, EnvError> {
        task.validate().map_err(EnvError::Task)?;
        let (mut positions, mut landmarks) = (Vec::new(), Vec::new());
        for mut stream in streams {
            let start = spawn(task, training, &mut stream);
            positions.extend_from_slice(&start.agents);
            positions.extend_from_slice(&start.balls);
            landmarks.extend_from_slice(&start.landmarks);
        }
        let velocities = vec![0.0; positions.len()];
        Ok(Self::assemble(task, &positions, &velocities, landmarks))
    }

    /// Episodes that start from given positions and velocities `[B, 2N, 2]` and landmarks `[B, N, 2]`.
    pub fn from_state(
        task: &TaskConfig,
        positions: &[f32],
        velocities: &[f32],
        landmarks: &[f32],
    ) -> Result<Self, EnvError> {
        task.validate().map_err(EnvError::Task)?;
        let expected = landmarks.len().next_multiple_of(2 * task.agents);
        check_len("landmarks", landmarks.len(), expected)?;
        check_len("positions", positions.len(), 2 * expected)?;
        check_len("velocities", velocities.len(), 2 * expected)?;
        for (field, values) in [("positions", positions), ("velocities", velocities), ("landmarks", landmarks)] {
            check_finite(field, values)?;
        }
        Ok(Self::assemble(task, positions, velocities, landmarks.to_vec()))
    }

    fn assemble(task: &TaskConfig, positions: &[f32], velocities: &[f32], landmarks: Vec<f32>) -> Self {
        let (agents, bodies) = (task.agents, 2 * task.agents);
        let episodes = landmarks.len() / bodies;
        let worlds = if bodies < CELLS_FROM && LANES * episodes >= bodies {
            Worlds::Lanes(Batch::new(task, positions, velocities, landmarks, false))
        } else {
            Worlds::Cells(Batch::new(task, positions, velocities, landmarks, true))
        };
        let mut new =
            Self { worlds, agents, horizon: task.horizon, steps: 0, goals: Vec::new(), spawn_success: Vec::new() };
        new.spawn_success = (0..episodes).map(|world| new.share(new.covered(world))).collect();
        new
    }

    /// N.
    pub fn agents(&self) -> usize {
        self.agents
    }

    /// T.
    pub fn horizon(&self) -> u32 {
        self.horizon
    }

    /// The present positions `[B, 2N, 2]`.
    pub fn positions(&self) -> Vec<f32> {
        let mut out = vec![0.0; 4 * self.numbers()];
        either!(&self.worlds, batch => batch.write_positions(&mut out));
        out
    }

    /// The present velocities `[B, 2N, 2]`.
    pub fn velocities(&self) -> Vec<f32> {
        let mut out = vec![0.0; 4 * self.numbers()];
        either!(&self.worlds, batch => batch.write_velocities(&mut out));
        out
    }

    fn covered(&self, world: usize) -> usize {
        either!(&self.worlds, batch => batch.covered(world))
    }

    /// A count of landmarks as a share of them.
    fn share(&self, count: usize) -> f32 {
        (count as f64 / self.agents as f64) as f32
    }

    fn score(&self, world: usize) -> EpisodeMetrics {
        let ((reward, hits), arrival) = either!(&self.worlds, batch => (batch.sums(world), batch.arrival(world)));
        let own = 2 * world * self.agents..2 * (world + 1) * self.agents;
        let goals = self.goals.get(own).unwrap_or_default();
        let agent_steps = f64::from(self.steps.max(1)) * self.agents as f64;
        let success = self.share(self.covered(world));
        EpisodeMetrics::of([
            (SUCCESS_RATE, success),
            (MATCHED_SUCCESS_RATE, self.share(either!(&self.worlds, batch => batch.matched(world, goals)))),
            (ALL_COVERED_RATE, all_covered(success)),
            (SPAWN_SUCCESS_RATE, self.spawn_success[world]),
            (ARRIVAL_STEP, arrival.unwrap_or(self.horizon + 1) as f32),
            (COLLISIONS_PER_AGENT_STEP, (hits / agent_steps) as f32),
            (COLLISION_RATE, 0.0),
            (REWARD, (reward / agent_steps) as f32),
        ])
    }

    /// B · N.
    fn numbers(&self) -> usize {
        self.episodes() * self.agents
    }
}

impl Env for PushBall {
    fn episodes(&self) -> usize {
        either!(&self.worlds, batch => batch.worlds())
    }

    fn steps(&self) -> u32 {
        self.steps
    }

    fn landmarks(&self) -> &[f32] {
        either!(&self.worlds, batch => batch.landmarks())
    }

    fn write_positions(&self, out: &mut [f32]) -> Result<(), EnvError> {
        check_len("positions", out.len(), 4 * self.numbers())?;
        either!(&self.worlds, batch => batch.write_positions(out));
        Ok(())
    }

    fn write_velocities(&self, out: &mut [f32]) -> Result<(), EnvError> {
        check_len("velocities", out.len(), 4 * self.numbers())?;
        either!(&self.worlds, batch => batch.write_velocities(out));
        Ok(())
    }

    fn write_agent_state(&self, out: &mut [f32]) -> Result<(), EnvError> {
        check_len("agent_state", out.len(), 0)
    }

    fn set_goals(&mut self, goals: &[u32]) -> Result<(), EnvError> {
        check_len("goals", goals.len(), 2 * self.numbers())?;
        if let Some(place) = goals.iter().position(|&goal| goal as usize >= self.agents) {
            let (goal, count) = (goals[place], self.agents);
            return Err(match place % 2 {
                0 => EnvError::Ball { place, goal, balls: count },
                _ => EnvError::Goal { place, goal, landmarks: count },
            });
        }
        either!(&mut self.worlds, batch => batch.set_goals(goals));
        self.goals.clear();
        self.goals.extend_from_slice(goals);
        Ok(())
    }

    fn step(&mut self, actions: &[u8], rewards: &mut [f32]) -> Result<(), EnvError> {
        check_len("actions", actions.len(), self.numbers())?;
        check_len("rewards", rewards.len(), self.numbers())?;
        if self.goals.len() != 2 * self.numbers() {
            return Err(EnvError::GoalsNotSet);
        }
        if self.steps >= self.horizon {
            return Err(EnvError::EpisodeOver { horizon: self.horizon });
        }
        check_actions(actions)?;
        self.steps += 1;
        either!(&mut self.worlds, batch => batch.step(self.steps, actions, rewards));
        Ok(())
    }

    fn scores(&self) -> Vec<EpisodeMetrics> {
        (0..self.episodes()).map(|world| self.score(world)).collect()
    }
}

#[cfg(test)]
mod tests;
