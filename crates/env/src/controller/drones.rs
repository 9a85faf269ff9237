//! A hand-written pilot: what a drone that knows its landmark can reach without learning.

use crate::controller::interface::Controller;
use crate::drones::{ACCELERATION, MOST_SPEED};
use crate::error::{EnvError, check_len};
use magex_core::joint_state::JointState;
use magex_core::task::DroneConfig;

/// Wanted target velocity per metre of way, 1/s. The drone lags its target by 0.14 s of velocity control (mass over the
/// D gain) and 0.14 s of attitude control, whose torques saturate: a pilot that brakes at the last moment tumbles.
const APPROACH: f64 = 2.0;

/// Chooses per axis the command that brings the target velocity nearest to 2/s times the way to the landmark, at most
/// 2 m/s, other drones ignored. Ties go to stop. Actions are 0 forward, 1 stop, 2 backward.
#[derive(Debug, Clone)]
pub struct DroneScript {
    agents: usize,
}

impl DroneScript {
    /// For teams of N drones.
    pub fn new(agents: usize) -> Self {
        Self { agents }
    }
}

impl Controller for DroneScript {
    fn act(&mut self, state: &JointState<'_>, actions: &mut [u8]) -> Result<(), EnvError> {
        let (agents, goals, landmarks) = (self.agents, state.goals, state.landmarks());
        let states = state.positions.len() / (3 * agents).max(1);
        let numbers = states * agents;
        check_len("positions", state.positions.len(), 3 * numbers)?;
        check_len("actions", actions.len(), 3 * numbers)?;
        check_len("agent_state", state.agent_state.len(), DroneConfig::AGENT_STATE * numbers)?;
        check_len("landmarks", landmarks.len(), 3 * goals.len())?;
        // Q episodes, at least one.
        check_len("goals", goals.len(), goals.len().max(1).next_multiple_of(agents.max(1)))?;
        if let Some(place) = goals.iter().position(|&goal| goal as usize >= agents) {
            return Err(EnvError::Goal { place, goal: goals[place], landmarks: agents });
        }
        for (k, actions) in actions.chunks_exact_mut(3).enumerate() {
            let of_episode = k % goals.len();
            let landmark = 3 * (of_episode / agents * agents + goals[of_episode] as usize);
            for (d, action) in actions.iter_mut().enumerate() {
                let way = f64::from(landmarks[landmark + d]) - f64::from(state.positions[3 * k + d]);
                let wanted = (APPROACH * way).clamp(-MOST_SPEED, MOST_SPEED);
                let missing = wanted - f64::from(state.agent_state[DroneConfig::AGENT_STATE * k + d]);
                *action = nearest(missing);
            }
        }
        Ok(())
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
