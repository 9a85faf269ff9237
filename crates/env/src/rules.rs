//! What a task adds to [`Env`](crate::Env): where its episodes start, and its rules.

use magex_core::error::{FieldError, check_count, check_finite};
use magex_core::statics::{LANDMARKS, StaticArray, Statics};
use magex_core::task::TaskConfig;

/// The physics, the reward and the score of a batch of episodes. Every argument has been checked.
pub trait Rules: Send {
    /// Takes goals [B, N, K].
    fn set_goals(&mut self, _goals: &[u32]) {}

    /// One joint step of every episode, the `step`-th (from 1): goals [B, N, K], actions [B, N, H], rewards [B, N].
    fn step(&mut self, step: u32, goals: &[u32], actions: &[u8], rewards: &mut [f32]);

    /// Writes [B, E, D].
    fn write_positions(&self, out: &mut [f32]);

    /// Writes [B, E, D].
    fn write_velocities(&self, out: &mut [f32]);

    /// Writes [B, N, X].
    fn write_agent_state(&self, _out: &mut [f32]) {}

    /// Landmarks of an episode that are covered now.
    fn covered(&self, episode: usize) -> usize;

    /// What an episode has scored in `steps` (at least 1) joint steps; its goals are [N, K], or empty before they are set.
    fn score(&self, episode: usize, steps: f64, goals: &[u32]) -> Score;
}

/// What an episode has scored.
#[derive(Debug, Clone, Copy)]
pub struct Score {
    /// Landmarks that are matched one-to-one to what covers them.
    pub matched: usize,
    /// First step after which enough landmarks were covered.
    pub arrival: Option<u32>,
    /// Collisions per agent and step.
    pub collisions: f64,
    /// Share of the agents that crashed.
    pub crashed: f64,
    /// Sum over agents and steps.
    pub reward: f64,
}

/// Where the episodes of a batch start.
#[derive(Debug, Clone, Default)]
pub(crate) struct Starts {
    /// [B, E, D]
    pub(crate) positions: Vec<f32>,
    /// [B, E, D]
    pub(crate) velocities: Vec<f32>,
    pub(crate) statics: Statics,
}

impl Starts {
    /// Without an episode yet.
    pub(crate) fn none(task: &TaskConfig) -> Self {
        let specs = task.statics().into_iter();
        let empty = specs.map(|spec| StaticArray { name: spec.name.to_owned(), shape: spec.shape, values: Vec::new() });
        Self { statics: Statics(empty.collect()), ..Self::default() }
    }

    /// Given positions and velocities [B, E, D] and landmarks [B, N, D].
    pub(crate) fn given(task: &TaskConfig, state: [&[f32]; 3]) -> Result<Self, FieldError> {
        task.validate()?;
        let [positions, velocities, landmarks] = state;
        let (points, all) = (task.agents * task.dims(), task.shape(1).bodies * task.dims());
        check_count("landmarks", "entries", landmarks.len(), landmarks.len().next_multiple_of(points))?;
        let expected = landmarks.len() / points * all;
        for (field, values, expected) in [
            ("positions", positions, expected),
            ("velocities", velocities, expected),
            ("landmarks", landmarks, landmarks.len()),
        ] {
            check_count(field, "entries", values.len(), expected)?;
            check_finite(field, values)?;
        }
        let statics = Statics::landmarks(task.agents, task.dims(), landmarks.to_vec());
        Ok(Self { positions: positions.to_vec(), velocities: velocities.to_vec(), statics })
    }

    /// Appends the next episode's part of a static array.
    pub(crate) fn extend(&mut self, name: &str, values: &[f32]) {
        let array = self.statics.0.iter_mut().find(|array| array.name == name);
        array.into_iter().for_each(|array| array.values.extend_from_slice(values));
    }

    /// [B, G, D]
    pub(crate) fn landmarks(&self) -> &[f32] {
        self.statics.get(LANDMARKS)
    }
}
