//! What every task looks like from outside, and the list of them.

use crate::drones::Drones;
use crate::error::EnvError;
use crate::push_ball::PushBall;
use crate::spread::Spread;
use magex_core::rng::Stream;
use magex_core::task::{TaskConfig, TaskName};
use magex_core::trajectory::EpisodeMetrics;

/// B episodes of a task, stepped together. Arrays are row-major, lengths in world units, times in seconds; sizes are those
/// of [`TaskConfig::shape`].
///
/// Episode b is a function of the task, its stream, its goals and its actions: not of B, not of b.
pub trait Env: Send {
    /// B.
    fn episodes(&self) -> usize;

    /// Joint steps done so far, up to T.
    fn steps(&self) -> u32;

    /// [B, G, D]
    fn landmarks(&self) -> &[f32];

    /// Writes the present positions [B, E, D], agents first, then balls.
    fn write_positions(&self, out: &mut [f32]) -> Result<(), EnvError>;

    /// Writes the present velocities [B, E, D].
    fn write_velocities(&self, out: &mut [f32]) -> Result<(), EnvError>;

    /// Writes the further state of the agents [B, N, X].
    fn write_agent_state(&self, out: &mut [f32]) -> Result<(), EnvError>;

    /// Assigns goals [B, N, K]; see [`TaskConfig::stages`].
    fn set_goals(&mut self, goals: &[u32]) -> Result<(), EnvError>;

    /// One joint step of every episode. `actions` [B, N, H] along the axes of the world; `rewards` [B, N] is overwritten
    /// with the reward of the state after the step.
    fn step(&mut self, actions: &[u8], rewards: &mut [f32]) -> Result<(), EnvError>;

    /// `[B]` what each episode scored up to now; after T steps, its final score. The metrics of the assignment are absent.
    fn scores(&self) -> Vec<EpisodeMetrics>;
}

/// The value of [`ALL_COVERED_RATE`](magex_core::metrics_table::ALL_COVERED_RATE) for an episode of this success.
pub(crate) fn all_covered(success: f32) -> f32 {
    if success >= 1.0 { 1.0 } else { 0.0 }
}

/// Episodes of a task, one per stream. In training, starts that help learning may be mixed in.
pub fn new_env(
    task: &TaskConfig,
    streams: impl Iterator<Item = Stream>,
    training: bool,
) -> Result<Box<dyn Env>, EnvError> {
    Ok(match task.name {
        TaskName::SimpleSpread => Box::new(Spread::new(task, streams)?),
        TaskName::PushBall => Box::new(PushBall::new(task, streams, training)?),
        TaskName::Drones => Box::new(Drones::new(task, streams)?),
    })
}

/// What a scripted controller sees of S joint states; landmarks and goals are those of Q episodes, state s belonging to
/// episode s modulo Q.
#[derive(Debug, Clone, Copy)]
pub struct View<'a> {
    /// [S, E, D]
    pub positions: &'a [f32],
    /// [S, E, D]
    pub velocities: &'a [f32],
    /// [S, N, X]
    pub agent_state: &'a [f32],
    /// [Q, G, D]
    pub landmarks: &'a [f32],
    /// [Q, N, K]
    pub goals: &'a [u32],
}
