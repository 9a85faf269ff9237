//! Floors: what a team reaches without assignment or without control. A baseline that matters is above them.

use super::{Controller, check, one_state_each};
use magex_core::error::FieldError;
use magex_core::joint_state::{JointState, group_positions};
use magex_core::rng::{Key, Stream};
use magex_core::task::TaskConfig;

/// Every agent goes to the landmark that is nearest to it at the start, driven by the scripted controller, whatever the
/// commander says and the others do; ties go to the lower landmark. In Push Ball to the nearest ball, and with it to the
/// landmark that is nearest to the ball.
pub struct Nearest {
    task: TaskConfig,
    scripted: Box<dyn Controller>,
    /// [B, N, K]
    goals: Vec<u32>,
}

impl Nearest {
    /// `scripted` is the task's scripted controller.
    pub(crate) fn new(task: &TaskConfig, scripted: Box<dyn Controller>) -> Self {
        Self { task: task.clone(), scripted, goals: Vec::new() }
    }
}

impl Controller for Nearest {
    fn begin(&mut self, start: &JointState<'_>) -> Result<(), FieldError> {
        let (stages, n) = (self.task.stages(), self.task.agents);
        let shape = self.task.shape(start.goals.len() / (n * stages.len()).max(1));
        let points = (start.positions, start.landmarks());
        self.goals.clear();
        for episode in 0..shape.episodes {
            for agent in 0..n {
                let mut member = agent;
                for stage in stages {
                    let [from, to] =
                        [stage.from, stage.to].map(|group| group_positions(&shape, points, group, episode));
                    member = nearest(&from[member * shape.dims..][..shape.dims], to);
                    self.goals.push(member as u32);
                }
            }
        }
        self.scripted.begin(&JointState { goals: &self.goals, ..*start })
    }

    fn act(&mut self, state: &JointState<'_>, actions: &mut [u8]) -> Result<(), FieldError> {
        let per_episode = self.task.agents * self.task.action_heads().len();
        let of_goals = (self.task.agents * self.task.stages().len()).max(1);
        one_state_each(self.goals.len() / of_goals, state.goals.len() / of_goals, actions.len(), per_episode)?;
        self.scripted.act(&JointState { goals: &self.goals, ..*state }, actions)
    }
}

/// Number of the point of `points` [G, D] that is nearest to another one.
fn nearest(point: &[f32], points: &[f32]) -> usize {
    let mut best = (f64::INFINITY, 0);
    for (k, other) in points.chunks_exact(point.len()).enumerate() {
        let distance2 = point.iter().zip(other).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
        if distance2 < best.0 {
            best = (distance2, k);
        }
    }
    best.1
}

/// Every agent takes a uniformly random action at every step.
#[derive(Debug)]
pub struct Random {
    task: TaskConfig,
    /// One per episode.
    streams: Vec<Stream>,
}

impl Random {
    /// `keys` name the actions of each episode.
    pub fn new(task: &TaskConfig, keys: &[Key]) -> Self {
        Self { task: task.clone(), streams: keys.iter().map(Key::stream).collect() }
    }
}

impl Controller for Random {
    fn act(&mut self, state: &JointState<'_>, actions: &mut [u8]) -> Result<(), FieldError> {
        let episodes = check(&self.task, state, actions)?;
        let heads = self.task.action_heads();
        let per_episode = self.task.agents * heads.len();
        one_state_each(self.streams.len(), episodes, actions.len(), per_episode)?;
        for (stream, actions) in self.streams.iter_mut().zip(actions.chunks_exact_mut(per_episode.max(1))) {
            for (action, &choices) in actions.iter_mut().zip(heads.iter().cycle()) {
                *action = stream.below(choices as u32) as u8;
            }
        }
        Ok(())
    }
}
