//! ORCA as a controller: a velocity for every agent that avoids the others, turned into the actions of the task.
//!
//! The algorithm chooses velocities as if they could be had at once. In Simple Spread they cannot: thrust is discrete, along
//! one axis, and takes three steps to act. So a collision is avoided mostly, not always (docs/baselines/planners.md).

mod velocity;

use super::{Controller, check, drones, one_state_each, spread};
use magex_core::error::FieldError;
use magex_core::joint_state::JointState;
use magex_core::rng::{Key, Stream};
use magex_core::task::{ActionCode, TaskConfig};
use velocity::{Settings, Vector, add, neighbours, scale, sorted_by_x, square, sub, velocity};

/// Largest noise on the preferred velocity, as a share of the largest speed: without any, agents that are exactly symmetric
/// wait for each other for ever.
const NOISE: f64 = 0.01;

/// What ORCA is told about the agents of a task, and seconds in which an agent wants to be at its goal when it is near.
fn settings(task: &TaskConfig) -> (Settings, f64) {
    let common = Settings {
        time_step: 0.1,
        time_horizon: 1.0,
        neighbour_distance: 2.0,
        max_neighbours: 10,
        radius: 0.1,
        max_speed: 2.0,
    };
    match task.action_code() {
        // An agent coasts 0.3 s and moves on for one step. A longer time horizon keeps agents off landmarks among parked ones.
        ActionCode::Thrust | ActionCode::Own => (Settings { time_horizon: 0.15, ..common }, 0.4),
        // The radius leaves as much room as a drone has itself, because it follows late. 0.5 s: as the scripted pilot.
        ActionCode::PerAxis => (Settings { time_step: 1.0 / 30.0, radius: 0.12, ..common }, 0.5),
    }
}

/// Chooses velocities by ORCA (van den Berg et al. 2011): preferred is the way to the landmark, at most 2 units/s, slower near
/// it. Drones avoid each other in the plane and fly at the height of their landmarks.
#[derive(Debug)]
pub struct Orca {
    task: TaskConfig,
    /// One per episode.
    noise: Vec<Stream>,
}

impl Orca {
    /// For teams whose agents themselves go to landmarks; Push Ball is refused. `keys` name the noise of each episode.
    pub fn new(task: &TaskConfig, keys: &[Key]) -> Self {
        Self { task: task.clone(), noise: keys.iter().map(Key::stream).collect() }
    }
}

impl Controller for Orca {
    fn act(&mut self, state: &JointState<'_>, actions: &mut [u8]) -> Result<(), FieldError> {
        let episodes = check(&self.task, state, actions)?;
        let (n, dims, heads) = (self.task.agents, self.task.dims(), self.task.action_heads().len());
        one_state_each(self.noise.len(), episodes, actions.len(), n * heads)?;
        let (settings, approach) = settings(&self.task);
        let landmarks = state.landmarks();
        let flat = |points: &[f32], k: usize| [0, 1].map(|d| f64::from(points[k * dims + d]));
        for (episode, actions) in actions.chunks_exact_mut(n * heads).enumerate() {
            let first = episode * n;
            let [positions, velocities] = [state.positions, state.velocities]
                .map(|all| (first..first + n).map(|k| flat(all, k)).collect::<Vec<Vector>>());
            let by_x = sorted_by_x(&positions);
            for (agent, actions) in actions.chunks_exact_mut(heads).enumerate() {
                let (k, goal) = (first + agent, first + state.goals[first + agent] as usize);
                let way = scale(sub(flat(landmarks, goal), positions[agent]), 1.0 / approach);
                let speed = square(way).sqrt().max(f64::MIN_POSITIVE);
                let preferred = scale(way, (settings.max_speed / speed).min(1.0));
                let noise = [(); 2].map(|()| NOISE * settings.max_speed * self.noise[episode].range(-1.0, 1.0));
                let near = neighbours(&settings, &positions, &by_x, agent);
                let chosen = velocity(&settings, (&positions, &velocities), (agent, &near), add(preferred, noise));
                match self.task.action_code() {
                    ActionCode::Thrust | ActionCode::Own => {
                        actions[0] = spread::accelerate(state, k, chosen.map(|v| v as f32))
                    }
                    ActionCode::PerAxis => {
                        let up = f64::from(landmarks[dims * goal + 2]) - f64::from(state.positions[dims * k + 2]);
                        drones::command(state, k, actions, |d| if d < 2 { chosen[d] } else { up / approach });
                    }
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
