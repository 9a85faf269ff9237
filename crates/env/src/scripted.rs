//! Hand-written controllers: what an agent that knows its goals can reach without learning.

mod push_ball;

use crate::drones::scripted_drones;
use crate::env::View;
use crate::error::{EnvError, check_len};
use crate::physics::Physics;
use magex_core::task::{TaskConfig, TaskName};

/// The controller of a task: one action [N, H] per joint state, along the axes of the world.
pub fn scripted(task: &TaskConfig, view: &View<'_>, out: &mut [u8]) -> Result<(), EnvError> {
    match task.name {
        TaskName::SimpleSpread => {
            scripted_actions(view.positions, view.velocities, view.landmarks, view.goals, task.agents, out)
        }
        TaskName::PushBall => scripted_push_ball(view, task.agents, out),
        TaskName::Drones => scripted_drones(view, task.agents, out),
    }
}

pub use push_ball::scripted_push_ball;

/// Simple Spread: chooses for every agent the action after which it would come to rest nearest to its goal, other agents ignored.
///
/// With v' the velocity after the action, the agent moves by dt · v' now and then coasts by
/// dt · v' · keep / (1 − keep) = 3 dt · v', so it stops at p + 0.4 v'. Ties go to the lower action.
///
/// `positions`, `velocities`, `landmarks` are `[B, N, 2]`, `goals` and `out` `[B, N]`; `agents` is N.
pub fn scripted_actions(
    positions: &[f32],
    velocities: &[f32],
    landmarks: &[f32],
    goals: &[u32],
    agents: usize,
    out: &mut [u8],
) -> Result<(), EnvError> {
    let numbers = goals.len();
    check_len("positions", positions.len(), 2 * numbers)?;
    check_len("velocities", velocities.len(), 2 * numbers)?;
    check_len("landmarks", landmarks.len(), 2 * numbers)?;
    check_len("actions", out.len(), numbers)?;
    if let Some(place) = goals.iter().position(|&goal| goal as usize >= agents) {
        return Err(EnvError::Goal { place, goal: goals[place], landmarks: agents });
    }
    let physics = Physics::<f32>::standard();
    let stop = physics.dt / (1.0 - physics.keep);
    // Where the agent stops without thrust is off by e; an action moves that point by `push` along one axis.
    let (glide, push) = (stop * physics.keep, stop * physics.dt * physics.sensitivity);
    for (k, action) in out.iter_mut().enumerate() {
        let goal = k / agents * agents + goals[k] as usize;
        let e = [0, 1].map(|d| positions[2 * k + d] + glide * velocities[2 * k + d] - landmarks[2 * goal + d]);
        *action = nearest_stop(e, push);
    }
    Ok(())
}

/// argmin over the actions of |e + push · direction|: thrust against the larger error, if it is worth half a push.
fn nearest_stop(e: [f32; 2], push: f32) -> u8 {
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

    #[test]
    fn the_choice_is_the_argmin_over_the_five_actions() {
        let directions = [[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0f32]];
        for a in -40..=40 {
            for b in -40..=40 {
                let e = [0.0137 * a as f32, 0.0131 * b as f32];
                let distance = |u: [f32; 2]| (e[0] + 0.2 * u[0]).powi(2) + (e[1] + 0.2 * u[1]).powi(2);
                let best = directions.map(distance).into_iter().fold(f32::INFINITY, f32::min);
                let chosen = directions[usize::from(nearest_stop(e, 0.2))];
                assert!(distance(chosen) <= best + 1e-6, "{e:?}");
            }
        }
    }

    #[test]
    fn arrays_that_do_not_fit_are_named() {
        let error = scripted_actions(&[0.0; 4], &[0.0; 3], &[0.0; 4], &[0, 1], 2, &mut [0; 2]).unwrap_err();
        assert!(error.to_string().contains("velocities"), "{error}");
        let error = scripted_actions(&[0.0; 4], &[0.0; 4], &[0.0; 4], &[0, 2], 2, &mut [0; 2]).unwrap_err();
        assert!(error.to_string().contains("goals[1]"), "{error}");
    }
}
