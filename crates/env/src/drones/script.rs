//! A hand-written pilot: what a drone that knows its landmark can reach without learning.

use super::{ACCELERATION, MOST_SPEED};
use crate::env::View;
use crate::error::{EnvError, check_len};
use magex_core::task::DroneConfig;

/// Wanted target velocity per metre of way, 1/s. The drone lags its target by 0.14 s of velocity control (mass over the
/// D gain) and 0.14 s of attitude control, whose torques saturate: a pilot that brakes at the last moment tumbles.
const APPROACH: f64 = 2.0;

/// Chooses per axis the command that brings the target velocity nearest to 2/s times the way to the landmark, at most
/// 2 m/s, other drones ignored. Ties go to stop.
///
/// `agents` is N; `out` `[S, N, 3]` is overwritten with 0 forward, 1 stop, 2 backward.
pub fn scripted_drones(view: &View<'_>, agents: usize, out: &mut [u8]) -> Result<(), EnvError> {
    let states = view.positions.len() / (3 * agents).max(1);
    let numbers = states * agents;
    check_len("positions", view.positions.len(), 3 * numbers)?;
    check_len("actions", out.len(), 3 * numbers)?;
    check_len("agent_state", view.agent_state.len(), DroneConfig::AGENT_STATE * numbers)?;
    check_len("landmarks", view.landmarks.len(), 3 * view.goals.len())?;
    // Q episodes, at least one.
    check_len("goals", view.goals.len(), view.goals.len().max(1).next_multiple_of(agents.max(1)))?;
    if let Some(place) = view.goals.iter().position(|&goal| goal as usize >= agents) {
        return Err(EnvError::Goal { place, goal: view.goals[place], landmarks: agents });
    }
    for (k, actions) in out.chunks_exact_mut(3).enumerate() {
        let of_episode = k % view.goals.len();
        let landmark = 3 * (of_episode / agents * agents + view.goals[of_episode] as usize);
        for (d, action) in actions.iter_mut().enumerate() {
            let way = f64::from(view.landmarks[landmark + d]) - f64::from(view.positions[3 * k + d]);
            let wanted = (APPROACH * way).clamp(-MOST_SPEED, MOST_SPEED);
            let missing = wanted - f64::from(view.agent_state[DroneConfig::AGENT_STATE * k + d]);
            *action = nearest(missing);
        }
    }
    Ok(())
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
