//! Episodes of any task: lengths, goals, actions and the horizon are checked here, once.

use crate::rules::{Rules, Starts};
use magex_core::error::{FieldError, check_count};
use magex_core::metrics_table::{
    ALL_COVERED_RATE, ARRIVAL_STEP, COLLISION_RATE, COLLISIONS_PER_AGENT_STEP, MATCHED_SUCCESS_RATE, REWARD,
    SPAWN_SUCCESS_RATE, SUCCESS_RATE,
};
use magex_core::statics::Statics;
use magex_core::task::{ActionCode, Group, Stage, TaskConfig};
use magex_core::trajectory::{EpisodeMetrics, Shape};

/// B episodes of a task, stepped together. Arrays are row-major, lengths in world units, times in seconds; sizes are those
/// of [`TaskConfig::shape`]. An error leaves the episodes untouched.
///
/// Episode b is a function of the task, its stream, its goals and its actions: not of B, not of b.
pub struct Env<R: Rules + ?Sized = dyn Rules> {
    pub(crate) rules: Box<R>,
    pub(crate) shape: Shape,
    action_code: ActionCode,
    stages: &'static [Stage],
    statics: Statics,
    /// `[B]`
    spawn_success: Vec<f32>,
    /// [B, N, K]; empty until they are set.
    goals: Vec<u32>,
    /// Joint steps done so far, up to T.
    pub(crate) steps: u32,
}

impl<R: Rules + ?Sized> Env<R> {
    pub(crate) fn new(task: &TaskConfig, starts: Starts, rules: Box<R>) -> Self {
        let mut shape = task.shape(0);
        shape.episodes = starts.positions.len() / (shape.bodies * shape.dims);
        Self {
            spawn_success: (0..shape.episodes).map(|episode| share(rules.covered(episode), shape.landmarks)).collect(),
            rules,
            shape,
            action_code: task.action_code(),
            stages: task.stages(),
            statics: starts.statics,
            goals: Vec::new(),
            steps: 0,
        }
    }

    /// The static arrays of the episodes; see [`TaskConfig::statics`].
    pub fn statics(&self) -> &Statics {
        &self.statics
    }

    /// The present positions [B, E, D], agents first, then balls.
    pub fn positions(&self) -> Vec<f32> {
        let mut out = vec![0.0; self.joint()];
        self.rules.write_positions(&mut out);
        out
    }

    /// The present velocities [B, E, D].
    pub fn velocities(&self) -> Vec<f32> {
        let mut out = vec![0.0; self.joint()];
        self.rules.write_velocities(&mut out);
        out
    }

    /// Writes the present positions [B, E, D], agents first, then balls.
    pub fn write_positions(&self, out: &mut [f32]) -> Result<(), FieldError> {
        check_count("positions", "entries", out.len(), self.joint())?;
        self.rules.write_positions(out);
        Ok(())
    }

    /// Writes the present velocities [B, E, D].
    pub fn write_velocities(&self, out: &mut [f32]) -> Result<(), FieldError> {
        check_count("velocities", "entries", out.len(), self.joint())?;
        self.rules.write_velocities(out);
        Ok(())
    }

    /// Writes the further state of the agents [B, N, X].
    pub fn write_agent_state(&self, out: &mut [f32]) -> Result<(), FieldError> {
        check_count("agent_state", "entries", out.len(), self.rows() * self.shape.agent_state)?;
        self.rules.write_agent_state(out);
        Ok(())
    }

    /// Assigns goals [B, N, K]; see [`TaskConfig::stages`].
    pub fn set_goals(&mut self, goals: &[u32]) -> Result<(), FieldError> {
        check_count("goals", "entries", goals.len(), self.rows() * self.stages.len())?;
        check_goals(goals, self.shape.agents, |place| self.stages[place % self.stages.len()].to)?;
        self.rules.set_goals(goals);
        self.goals.clear();
        self.goals.extend_from_slice(goals);
        Ok(())
    }

    /// One joint step of every episode. `actions` [B, N, H] along the axes of the world; `rewards` [B, N] is overwritten
    /// with the reward of the state after the step.
    pub fn step(&mut self, actions: &[u8], rewards: &mut [f32]) -> Result<(), FieldError> {
        check_count("actions", "entries", actions.len(), self.rows() * self.shape.action_components)?;
        check_count("rewards", "entries", rewards.len(), self.rows())?;
        if self.goals.len() != self.rows() * self.shape.goals_per_agent {
            return Err(FieldError::new("goals", "not set; call set_goals before the first step"));
        }
        let horizon = self.shape.steps;
        if self.steps as usize >= horizon {
            return Err(FieldError::new(
                "step",
                format!("the episode is over after {horizon} steps; start a new batch"),
            ));
        }
        self.check_actions(actions)?;
        self.steps += 1;
        self.rules.step(self.steps, &self.goals, actions, rewards);
        Ok(())
    }

    /// `[B]` what each episode scored up to now; after T steps, its final score. The metrics of the assignment are absent.
    pub fn scores(&self) -> Vec<EpisodeMetrics> {
        let (n, steps) = (self.shape.agents, f64::from(self.steps.max(1)));
        let own = n * self.shape.goals_per_agent;
        let metrics = |(episode, &spawn_success): (usize, &f32)| {
            let goals = self.goals.get(episode * own..(episode + 1) * own).unwrap_or_default();
            let success = share(self.rules.covered(episode), self.shape.landmarks);
            let score = self.rules.score(episode, steps, goals);
            EpisodeMetrics::of([
                (SUCCESS_RATE, success),
                (MATCHED_SUCCESS_RATE, share(score.matched, self.shape.landmarks)),
                (ALL_COVERED_RATE, if success >= 1.0 { 1.0 } else { 0.0 }),
                (SPAWN_SUCCESS_RATE, spawn_success),
                (ARRIVAL_STEP, score.arrival.unwrap_or(self.shape.steps as u32 + 1) as f32),
                (COLLISIONS_PER_AGENT_STEP, score.collisions as f32),
                (COLLISION_RATE, score.crashed as f32),
                (REWARD, (score.reward / (steps * n as f64)) as f32),
            ])
        };
        self.spawn_success.iter().enumerate().map(metrics).collect()
    }

    /// B · E · D.
    fn joint(&self) -> usize {
        self.shape.episodes * self.shape.bodies * self.shape.dims
    }

    /// B · N.
    pub(crate) fn rows(&self) -> usize {
        self.shape.episodes * self.shape.agents
    }

    fn check_actions(&self, actions: &[u8]) -> Result<(), FieldError> {
        let (most, choices) = match self.action_code {
            ActionCode::Thrust => (4, "0 none, 1 +x, 2 -x, 3 +y, 4 -y"),
            ActionCode::PerAxis => (2, "0 forward, 1 stop, 2 backward"),
            ActionCode::Own => (u8::MAX, "the environment's own choices"),
        };
        // The maximum first: it vectorises, the search does not.
        if actions.iter().fold(0, |largest, &action| largest.max(action)) <= most {
            return Ok(());
        }
        let place = actions.iter().position(|&action| action > most).unwrap_or_default();
        let problem = format!("{} is not an action; use {choices}", actions[place]);
        Err(FieldError::new(format!("actions[{place}]"), problem))
    }
}

/// `Ok` if every goal is below `members`, the size of every group; `group` says which one the goal at a place is of.
pub(crate) fn check_goals(goals: &[u32], members: usize, group: impl Fn(usize) -> Group) -> Result<(), FieldError> {
    let Some(place) = goals.iter().position(|&goal| goal as usize >= members) else { return Ok(()) };
    let what = if group(place) == Group::Balls { "ball" } else { "landmark" };
    let problem = format!("{} is not a {what}; use an index below {members}", goals[place]);
    Err(FieldError::new(format!("goals[{place}]"), problem))
}

fn share(count: usize, of: usize) -> f32 {
    (count as f64 / of as f64) as f32
}
