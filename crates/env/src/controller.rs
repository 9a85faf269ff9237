//! What drives agents without a network: the classical controllers show what agents that know their goals can reach without
//! learning.

mod astar;
mod drones;
mod floors;
mod orca;
mod push_ball;
mod spread;

use crate::env::check_goals;
use magex_core::error::{FieldError, check_count};
use magex_core::joint_state::JointState;
use magex_core::task::{TaskConfig, TaskName};

pub use astar::Astar;
pub use drones::DroneScript;
pub use floors::{Nearest, Random};
pub use orca::Orca;
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

/// The controllers without weights.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Classical {
    /// Steers to the goal, brakes in time, ignores the others; Push Ball: looks ahead in a model.
    Scripted,
    /// Multi-agent A*, the paper's planning baseline.
    Astar,
    /// Optimal reciprocal collision avoidance.
    Orca,
    /// Scripted, to the landmark nearest at the start: no assignment.
    Nearest,
    /// Random actions.
    Random,
}

impl std::fmt::Display for Classical {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Scripted => "scripted",
            Self::Astar => "astar",
            Self::Orca => "orca",
            Self::Nearest => "nearest",
            Self::Random => "random",
        })
    }
}

impl Classical {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::Scripted, Self::Astar, Self::Orca, Self::Nearest, Self::Random];

    /// Whether it can drive a task.
    pub fn check(self, task: &TaskConfig) -> Result<(), FieldError> {
        if task.name == TaskName::External && self != Self::Random {
            let problem = format!("{self} knows the simulated tasks only; for an external environment use random");
            return Err(FieldError::new("controller", problem));
        }
        if matches!(self, Self::Astar | Self::Orca) && task.name == TaskName::PushBall {
            let problem = format!(
                "{self} brings agents to landmarks, but in push-ball they have to push balls there; \
                 use scripted, nearest or random"
            );
            return Err(FieldError::new("controller", problem));
        }
        Ok(())
    }
}

/// `Ok` if the controller knows as many episodes as the state has, and the state is one joint state of each.
fn one_state_each(known: usize, episodes: usize, actions: usize, per_episode: usize) -> Result<(), FieldError> {
    if known != episodes || actions != episodes * per_episode {
        let problem = format!("the controller began {known} episodes; it takes one joint state of each of them");
        return Err(FieldError::new("goals", problem));
    }
    Ok(())
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
