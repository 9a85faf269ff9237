//! A hand-written pilot: what a drone that knows its landmark can reach without learning.

use super::{Controller, check};
use crate::drones::{ACCELERATION, MOST_SPEED};
use magex_core::error::FieldError;
use magex_core::joint_state::JointState;
use magex_core::task::{DroneConfig, Spawn, TaskConfig, TaskName};

/// Wanted target velocity per metre of way, 1/s. The drone lags its target by 0.14 s of velocity control (mass over the
/// D gain) and 0.14 s of attitude control, whose torques saturate: a pilot that brakes at the last moment tumbles.
const APPROACH: f64 = 2.0;

/// Chooses per axis the command that brings the target velocity nearest to 2/s times the way to the landmark, at most
/// 2 m/s, other drones ignored. Ties go to stop. Actions are 0 forward, 1 stop, 2 backward.
#[derive(Debug, Clone)]
pub struct DroneScript {
    task: TaskConfig,
}

impl DroneScript {
    /// For teams of N drones.
    pub fn new(agents: usize) -> Self {
        Self { task: TaskConfig::of(TaskName::Drones, agents, Spawn::Uniform) }
    }
}

impl Controller for DroneScript {
    fn act(&mut self, state: &JointState<'_>, actions: &mut [u8]) -> Result<(), FieldError> {
        check(&self.task, state, actions)?;
        let (agents, goals, landmarks) = (self.task.agents, state.goals, state.landmarks());
        for (k, actions) in actions.chunks_exact_mut(3).enumerate() {
            let of_episode = k % goals.len();
            let landmark = 3 * (of_episode / agents * agents + goals[of_episode] as usize);
            steer(state, k, [0, 1, 2].map(|d| landmarks[landmark + d]), actions);
        }
        Ok(())
    }
}

/// Steers the k-th drone of all states to a target.
pub(super) fn steer(state: &JointState<'_>, k: usize, target: [f32; 3], actions: &mut [u8]) {
    command(state, k, actions, |d| {
        let way = f64::from(target[d]) - f64::from(state.positions[3 * k + d]);
        (APPROACH * way).clamp(-MOST_SPEED, MOST_SPEED)
    });
}

/// Brings the target velocity of the k-th drone of all states nearest to what is wanted along each axis, m/s.
pub(super) fn command(state: &JointState<'_>, k: usize, actions: &mut [u8], wanted: impl Fn(usize) -> f64) {
    for (d, action) in actions.iter_mut().enumerate() {
        let target_velocity = f64::from(state.agent_state[DroneConfig::AGENT_STATE * k + d]);
        *action = nearest(wanted(d) - target_velocity);
    }
}

/// The command whose change of the target velocity is nearest to what is missing.
fn nearest(missing: f64) -> u8 {
    const CHANGE: f64 = ACCELERATION / DroneConfig::COMMANDS_HZ as f64;
    if missing.abs() <= 0.5 * CHANGE {
        1
    } else if missing > 0.0 {
        0
    } else {
        2
    }
}
