//! What every task looks like from outside.

use crate::error::EnvError;
use magex_core::statics::{LANDMARKS, Statics};
use magex_core::trajectory::EpisodeMetrics;

/// B episodes of a task, stepped together. Arrays are row-major, lengths in world units, times in seconds; sizes are those
/// of [`magex_core::task::TaskConfig::shape`].
///
/// Episode b is a function of the task, its stream, its goals and its actions: not of B, not of b.
pub trait Env: Send {
    /// B.
    fn episodes(&self) -> usize;

    /// Joint steps done so far, up to T.
    fn steps(&self) -> u32;

    /// The static arrays of the episodes; see [`magex_core::task::TaskConfig::statics`].
    fn statics(&self) -> &Statics;

    /// [B, G, D]
    fn landmarks(&self) -> &[f32] {
        self.statics().get(LANDMARKS)
    }

    /// Writes the present positions [B, E, D], agents first, then balls.
    fn write_positions(&self, out: &mut [f32]) -> Result<(), EnvError>;

    /// Writes the present velocities [B, E, D].
    fn write_velocities(&self, out: &mut [f32]) -> Result<(), EnvError>;

    /// Writes the further state of the agents [B, N, X].
    fn write_agent_state(&self, out: &mut [f32]) -> Result<(), EnvError>;

    /// Assigns goals [B, N, K]; see [`magex_core::task::TaskConfig::stages`].
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
