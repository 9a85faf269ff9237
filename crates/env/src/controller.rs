//! What drives agents without a network: hand-written controllers show what an agent that knows its goals can reach without
//! learning.

mod drones;
mod push_ball;
mod spread;

use crate::env::check_goals;
use magex_core::error::{FieldError, check_count};
use magex_core::joint_state::JointState;
use magex_core::task::TaskConfig;

pub use drones::DroneScript;
pub use push_ball::PushBallScript;
pub use spread::SpreadScript;

/// Chooses actions for B episodes. It may keep a state from [`Controller::begin`] to the end of the episodes.
pub trait Controller: Send {
    /// Sees the episodes as they start, goals included: before the first call of `act`, and again for every new batch.
    fn begin(&mut self, _start: &JointState<'_>) -> Result<(), FieldError> {
        Ok(())
    }

    /// Overwrites `actions` with one action [N, H] per joint state, along the axes of the world.
    fn act(&mut self, state: &JointState<'_>, actions: &mut [u8]) -> Result<(), FieldError>;
}

/// B, the number of episodes, if every array fits the task and the number of joint states that `actions` is for.
fn check(task: &TaskConfig, state: &JointState<'_>, actions: &[u8]) -> Result<usize, FieldError> {
    let (shape, stages) = (task.shape(1), task.stages());
    let (of_team, goals) = (shape.agents * shape.action_components, shape.agents * stages.len());
    let (states, episodes) = (actions.len() / of_team.max(1), state.goals.len() / goals.max(1));
    let joint = states * shape.bodies * shape.dims;
    for (field, found, expected) in [
        ("goals", state.goals.len(), goals * episodes.max(usize::from(states > 0))),
        ("landmarks", state.landmarks().len(), episodes * shape.landmarks * shape.dims),
        ("actions", actions.len(), of_team * states.next_multiple_of(episodes.max(1))),
        ("positions", state.positions.len(), joint),
        ("velocities", state.velocities.len(), joint),
        ("agent_state", state.agent_state.len(), states * shape.agents * shape.agent_state),
    ] {
        check_count(field, "entries", found, expected)?;
    }
    check_goals(state.goals, shape.agents, |place| stages[place % stages.len()].to)?;
    Ok(episodes)
}
