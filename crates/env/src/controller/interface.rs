//! What drives agents without a network: a script, a planner.

use crate::error::EnvError;
use magex_core::joint_state::JointState;

/// Chooses actions for B episodes. It may keep a state from [`Controller::begin`] to the end of the episodes.
pub trait Controller: Send {
    /// Sees the episodes as they start, goals included: before the first call of `act`, and again for every new batch.
    fn begin(&mut self, _start: &JointState<'_>) -> Result<(), EnvError> {
        Ok(())
    }

    /// Overwrites `actions` with one action [N, H] per joint state, along the axes of the world.
    fn act(&mut self, state: &JointState<'_>, actions: &mut [u8]) -> Result<(), EnvError>;
}
