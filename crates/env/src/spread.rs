//! Simple Spread as the rest of MAGE-X sees it.

use crate::batch::Batch;
use crate::env::{Env, all_covered};
use crate::error::{EnvError, check_actions, check_finite, check_len};
use crate::matching::maximum_matching;
use crate::spawn;
use magex_core::metrics_table::{
    ALL_COVERED_RATE, ARRIVAL_STEP, COLLISION_RATE, COLLISIONS_PER_AGENT_STEP, MATCHED_SUCCESS_RATE, REWARD,
    SPAWN_SUCCESS_RATE, SUCCESS_RATE,
};
use magex_core::rng::Stream;
use magex_core::task::TaskConfig;
use magex_core::trajectory::EpisodeMetrics;

/// A landmark is covered when an agent's centre is within this distance (agent radius 0.1 + landmark radius 0.05).
pub const COVER_RADIUS: f64 = 0.15;
/// Two agents collide when their centres are closer than this (two radii of 0.1).
pub const CONTACT_DISTANCE: f64 = 0.2;

/// Worlds stepped side by side: one vector register of f32 on the widest machines.
pub(crate) const LANES: usize = 16;
/// N from which neighbours are found by cells instead of comparing all pairs of 16 worlds at once; fewer than N / 16
/// worlds do not fill the registers well enough to be worth it either. Both ways give the same bits.
const CELLS_FROM: usize = 256;

/// B episodes of Simple Spread with N agents and N landmarks (paper, section 5.1.1), stepped together.
///
/// Arrays are row-major: positions, velocities and landmarks `[B, N, 2]` in world units (and per second), goals,
/// actions and rewards `[B, N]`. Episode b depends only on the task, its stream, its goals and its actions: not on B,
/// not on b.
#[derive(Debug, Clone)]
pub struct Spread {
    worlds: Worlds,
    agents: usize,
    horizon: u32,
    steps: u32,
    goals: Vec<u32>,
    /// `[B]`
    spawn_success: Vec<f32>,
}

/// Small worlds share registers; a large one, or one of a few, is looked at by itself.
#[derive(Debug, Clone)]
enum Worlds {
    Lanes(Batch<f32, LANES>),
    Cells(Batch<f32, 1>),
}

impl Spread {
    /// One episode per stream, spawned as the task says. Errors if the task does not validate.
    pub fn new(task: &TaskConfig, streams: impl Iterator<Item = Stream>) -> Result<Self, EnvError> {
        task.validate().map_err(EnvError::Task)?;
        let (mut positions, mut landmarks) = (Vec::new(), Vec::new());
        for mut stream in streams {
            let episode = spawn::spawn(task, &mut stream);
            positions.extend_from_slice(&episode.agents);
            landmarks.extend_from_slice(&episode.landmarks);
        }
        let velocities = vec![0.0; positions.len()];
        Ok(Self::assemble(task, &positions, &velocities, landmarks))
    }

    /// Episodes that start from given positions, velocities and landmarks, each `[B, N, 2]`.
    pub fn from_state(
        task: &TaskConfig,
        positions: &[f32],
        velocities: &[f32],
        landmarks: &[f32],
    ) -> Result<Self, EnvError> {
        task.validate().map_err(EnvError::Task)?;
        let expected = landmarks.len().next_multiple_of(2 * task.agents);
        check_len("landmarks", landmarks.len(), expected)?;
        check_len("positions", positions.len(), expected)?;
        check_len("velocities", velocities.len(), expected)?;
        for (field, values) in [("positions", positions), ("velocities", velocities), ("landmarks", landmarks)] {
            check_finite(field, values)?;
        }
        Ok(Self::assemble(task, positions, velocities, landmarks.to_vec()))
    }

    fn assemble(task: &TaskConfig, positions: &[f32], velocities: &[f32], landmarks: Vec<f32>) -> Self {
        let episodes = landmarks.len() / (2 * task.agents);
        let worlds = if task.agents < CELLS_FROM && LANES * episodes >= task.agents {
            Worlds::Lanes(Batch::new(task, positions, velocities, landmarks, false))
        } else {
            Worlds::Cells(Batch::new(task, positions, velocities, landmarks, true))
        };
        let near = |world| match &worlds {
            Worlds::Lanes(batch) => batch.near(world),
            Worlds::Cells(batch) => batch.near(world),
        };
        let spawn_success = (0..episodes).map(|world| covered(&near(world), task.agents)).collect();
        Self { worlds, agents: task.agents, horizon: task.horizon, steps: 0, goals: Vec::new(), spawn_success }
    }

    /// N.
    pub fn agents(&self) -> usize {
        self.agents
    }

    /// T.
    pub fn horizon(&self) -> u32 {
        self.horizon
    }

    /// `[B, N]` landmark of each agent; empty until they are set.
    pub fn goals(&self) -> &[u32] {
        &self.goals
    }

    /// The present positions `[B, N, 2]`.
    pub fn positions(&self) -> Vec<f32> {
        let mut out = vec![0.0; 2 * self.numbers()];
        match &self.worlds {
            Worlds::Lanes(batch) => batch.write_positions(&mut out),
            Worlds::Cells(batch) => batch.write_positions(&mut out),
        }
        out
    }

    /// The present velocities `[B, N, 2]`.
    pub fn velocities(&self) -> Vec<f32> {
        let mut out = vec![0.0; 2 * self.numbers()];
        match &self.worlds {
            Worlds::Lanes(batch) => batch.write_velocities(&mut out),
            Worlds::Cells(batch) => batch.write_velocities(&mut out),
        }
        out
    }

    fn score(&self, world: usize) -> EpisodeMetrics {
        let (near, arrival, (reward, hits)) = match &self.worlds {
            Worlds::Lanes(batch) => (batch.near(world), batch.arrival(world), batch.sums(world)),
            Worlds::Cells(batch) => (batch.near(world), batch.arrival(world), batch.sums(world)),
        };
        let share = |count: usize| (count as f64 / self.agents as f64) as f32;
        let agent_steps = f64::from(self.steps.max(1)) * self.agents as f64;
        let success = covered(&near, self.agents);
        EpisodeMetrics::of([
            (SUCCESS_RATE, success),
            (MATCHED_SUCCESS_RATE, share(maximum_matching(&near, self.agents))),
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

impl Env for Spread {
    fn episodes(&self) -> usize {
        match &self.worlds {
            Worlds::Lanes(batch) => batch.worlds(),
            Worlds::Cells(batch) => batch.worlds(),
        }
    }

    fn steps(&self) -> u32 {
        self.steps
    }

    fn landmarks(&self) -> &[f32] {
        match &self.worlds {
            Worlds::Lanes(batch) => batch.landmarks(),
            Worlds::Cells(batch) => batch.landmarks(),
        }
    }

    fn write_positions(&self, out: &mut [f32]) -> Result<(), EnvError> {
        check_len("positions", out.len(), 2 * self.numbers())?;
        match &self.worlds {
            Worlds::Lanes(batch) => batch.write_positions(out),
            Worlds::Cells(batch) => batch.write_positions(out),
        }
        Ok(())
    }

    fn write_velocities(&self, out: &mut [f32]) -> Result<(), EnvError> {
        check_len("velocities", out.len(), 2 * self.numbers())?;
        match &self.worlds {
            Worlds::Lanes(batch) => batch.write_velocities(out),
            Worlds::Cells(batch) => batch.write_velocities(out),
        }
        Ok(())
    }

    fn write_agent_state(&self, out: &mut [f32]) -> Result<(), EnvError> {
        check_len("agent_state", out.len(), 0)
    }

    fn set_goals(&mut self, goals: &[u32]) -> Result<(), EnvError> {
        check_len("goals", goals.len(), self.numbers())?;
        if let Some(place) = goals.iter().position(|&goal| goal as usize >= self.agents) {
            return Err(EnvError::Goal { place, goal: goals[place], landmarks: self.agents });
        }
        match &mut self.worlds {
            Worlds::Lanes(batch) => batch.set_goals(goals),
            Worlds::Cells(batch) => batch.set_goals(goals),
        }
        self.goals.clear();
        self.goals.extend_from_slice(goals);
        Ok(())
    }

    fn step(&mut self, actions: &[u8], rewards: &mut [f32]) -> Result<(), EnvError> {
        check_len("actions", actions.len(), self.numbers())?;
        check_len("rewards", rewards.len(), self.numbers())?;
        if self.goals.len() != self.numbers() {
            return Err(EnvError::GoalsNotSet);
        }
        if self.steps >= self.horizon {
            return Err(EnvError::EpisodeOver { horizon: self.horizon });
        }
        check_actions(actions)?;
        self.steps += 1;
        match &mut self.worlds {
            Worlds::Lanes(batch) => batch.step(self.steps, actions, rewards),
            Worlds::Cells(batch) => batch.step(self.steps, actions, rewards),
        }
        Ok(())
    }

    fn scores(&self) -> Vec<EpisodeMetrics> {
        (0..self.episodes()).map(|world| self.score(world)).collect()
    }
}

/// Share of landmarks with anything near.
fn covered(near: &[Vec<u32>], landmarks: usize) -> f32 {
    (near.iter().filter(|agents| !agents.is_empty()).count() as f64 / landmarks as f64) as f32
}

#[cfg(test)]
mod tests;
