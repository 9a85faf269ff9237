//! A hand-written pilot: what a drone that knows its landmark can reach without learning.

use super::{ACCELERATION, MOST_SPEED};
use crate::env::View;
use crate::error::{EnvError, check_len};
use magex_core::task::DroneConfig;

/// τ: mass over the controller's D gain along x, y and z, s.
const VELOCITY_LAG: [f64; 3] = [0.135, 0.135, 0.054];
/// σ: gain of the attitude controller's rate over that of its angle (20000 / 140000), s; none along z.
const ATTITUDE_LAG: f64 = 0.143;
/// m/s² per unit of the up axis' x and y in level flight.
const GRAVITY: f64 = 9.8;

/// Chooses per axis the command after which the drone, if it braked from then on, would come to rest nearest to its
/// landmark, other drones ignored.
///
/// For small tilts v follows the target v\* as τ σ v'' + τ v' + v = v\*, with v' = g · up axis. Integrated to rest: a drone
/// whose target goes to zero still moves by τ v + τ σ v' + what v\* covers on its way, which from n · 5 m/s² / 30 is
/// n (n + 1) / 2 of that per 1/30 s. Ties go to stop.
///
/// `agents` is N; `out` `[S, N, 3]` is overwritten with 0 forward, 1 stop, 2 backward.
pub fn scripted_drones(view: &View<'_>, agents: usize, out: &mut [u8]) -> Result<(), EnvError> {
    let numbers = out.len() / 3;
    check_len("actions", out.len(), 3 * numbers.next_multiple_of(agents.max(1)))?;
    check_len("positions", view.positions.len(), 3 * numbers)?;
    check_len("velocities", view.velocities.len(), 3 * numbers)?;
    check_len("extras", view.extras.len(), DroneConfig::EXTRAS * numbers)?;
    check_len("landmarks", view.landmarks.len(), 3 * view.goals.len())?;
    if let Some(place) = view.goals.iter().position(|&goal| goal as usize >= agents) {
        return Err(EnvError::Goal { place, goal: view.goals[place], landmarks: agents });
    }
    // Q episodes, and every state belongs to one of them.
    check_len("goals", view.goals.len(), view.goals.len().next_multiple_of(agents).max(agents))?;
    for (k, actions) in out.chunks_exact_mut(3).enumerate() {
        let of_episode = k % view.goals.len();
        let landmark = 3 * (of_episode / agents * agents + view.goals[of_episode] as usize);
        for (d, action) in actions.iter_mut().enumerate() {
            let [position, velocity] = [view.positions, view.velocities].map(|values| f64::from(values[3 * k + d]));
            let target = f64::from(view.extras[DroneConfig::EXTRAS * k + d]);
            // Extras 3 and 4: the up axis.
            let up = if d < 2 { f64::from(view.extras[DroneConfig::EXTRAS * k + 3 + d]) } else { 0.0 };
            let coast = VELOCITY_LAG[d] * (velocity + ATTITUDE_LAG * GRAVITY * up);
            let way = f64::from(view.landmarks[landmark + d]) - position - coast;
            *action = nearest_stop(way, target);
        }
    }
    Ok(())
}

/// argmin over the commands of |way − way to rest|.
fn nearest_stop(way: f64, target: f64) -> u8 {
    const PERIOD: f64 = 1.0 / DroneConfig::COMMANDS_HZ as f64;
    const CHANGE: f64 = ACCELERATION * PERIOD;
    let miss = |action: u8| {
        let speed = (target + CHANGE * (1.0 - f64::from(action))).clamp(-MOST_SPEED, MOST_SPEED);
        (way - 0.5 * PERIOD * speed * (speed.abs() / CHANGE + 1.0)).abs()
    };
    let mut best = 1;
    for action in [0, 2] {
        if miss(action) < miss(best) {
            best = action;
        }
    }
    best
}
