//! The yardstick of Simple Spread: full thrust towards the goal, braking in time.

use super::{Controller, check};
use crate::particles::physics::Physics;
use magex_core::error::FieldError;
use magex_core::joint_state::JointState;
use magex_core::task::{Spawn, TaskConfig};

/// Chooses for every agent the action after which it would come to rest nearest to its goal, other agents ignored.
///
/// With v' the velocity after the action, the agent moves by dt · v' now and then coasts by
/// dt · v' · keep / (1 − keep) = 3 dt · v', so it stops at p + 0.4 v'. Ties go to the lower action.
#[derive(Debug, Clone)]
pub struct SpreadScript {
    task: TaskConfig,
}

impl SpreadScript {
    /// For teams of N agents.
    pub fn new(agents: usize) -> Self {
        Self { task: TaskConfig::simple_spread(agents, Spawn::Uniform) }
    }
}

impl Controller for SpreadScript {
    fn act(&mut self, state: &JointState<'_>, actions: &mut [u8]) -> Result<(), FieldError> {
        check(&self.task, state, actions)?;
        let (agents, landmarks) = (self.task.agents, state.landmarks());
        for (k, action) in actions.iter_mut().enumerate() {
            let of_episode = k % state.goals.len();
            let goal = of_episode / agents * agents + state.goals[of_episode] as usize;
            *action = steer(state, k, [landmarks[2 * goal], landmarks[2 * goal + 1]]);
        }
        Ok(())
    }
}

/// The action after which the k-th agent of all states would come to rest nearest to a target.
pub(super) fn steer(state: &JointState<'_>, k: usize, target: [f32; 2]) -> u8 {
    let physics = Physics::<f32>::standard();
    let stop = physics.dt / (1.0 - physics.keep);
    // Where the agent stops without thrust is off by e; an action moves that point by `push` along one axis.
    let (glide, push) = (stop * physics.keep, stop * physics.dt * physics.sensitivity);
    let e = [0, 1].map(|d| state.positions[2 * k + d] + glide * state.velocities[2 * k + d] - target[d]);
    least_error(e, push)
}

/// The action after which the k-th agent of all states has the velocity nearest to a wanted one.
pub(super) fn accelerate(state: &JointState<'_>, k: usize, wanted: [f32; 2]) -> u8 {
    let physics = Physics::<f32>::standard();
    let e = [0, 1].map(|d| physics.keep * state.velocities[2 * k + d] - wanted[d]);
    least_error(e, physics.dt * physics.sensitivity)
}

/// argmin over the actions of |e + push · direction|: thrust against the larger error, if it is worth half a push.
fn least_error(e: [f32; 2], push: f32) -> u8 {
    let [along_x, along_y] = e.map(f32::abs);
    if along_x.max(along_y) <= 0.5 * push {
        0
    } else if along_x >= along_y {
        if e[0] < 0.0 { 1 } else { 2 }
    } else if e[1] < 0.0 {
        3
    } else {
        4
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use magex_core::statics::Statics;

    #[test]
    fn the_choice_is_the_argmin_over_the_five_actions() {
        let directions = [[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0f32]];
        for a in -40..=40 {
            for b in -40..=40 {
                let e = [0.0137 * a as f32, 0.0131 * b as f32];
                let distance = |u: [f32; 2]| (e[0] + 0.2 * u[0]).powi(2) + (e[1] + 0.2 * u[1]).powi(2);
                let best = directions.map(distance).into_iter().fold(f32::INFINITY, f32::min);
                let chosen = directions[usize::from(least_error(e, 0.2))];
                assert!(distance(chosen) <= best + 1e-6, "{e:?}");
            }
        }
    }

    #[test]
    fn arrays_that_do_not_fit_are_named() {
        let act = |velocities: &[f32], goals: &[u32]| {
            let landmarks = Statics::landmarks(2, 2, vec![0.0; 4]);
            let state = JointState {
                positions: &[0.0; 4],
                velocities,
                agent_state: &[],
                world_states: &[],
                masks: &[],
                marks: &[],
                statics: landmarks.view(),
                goals,
            };
            SpreadScript::new(2).act(&state, &mut [0; 2])
        };
        let error = act(&[0.0; 3], &[0, 1]).unwrap_err();
        assert!(error.to_string().contains("velocities"), "{error}");
        let error = act(&[0.0; 4], &[0, 2]).unwrap_err();
        assert!(error.to_string().contains("goals[1]"), "{error}");
    }
}
