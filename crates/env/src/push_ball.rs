//! Push Ball (paper, section 5.1.1): its worlds, their starts and their reward.

mod batch;
mod constants;
pub(crate) mod law;
pub mod layouts;
mod start;

use crate::error::EnvError;
use crate::particles::constants::{LANES, share_registers};
use crate::shell::{Rules, Shell, Starts, Task};
use batch::Batch;
use magex_core::rng::Stream;
use magex_core::statics::LANDMARKS;
use magex_core::task::TaskConfig;

pub use constants::{AGENT_RADIUS, BALL_RADIUS, PUSH_DISTANCE, REACHED, SPACING};
pub use start::{Start, spawn};

/// B episodes of Push Ball with N agents, N balls and N landmarks, stepped together.
///
/// Positions and velocities are `[B, 2N, 2]` (agents, then balls) in world units (and per second), landmarks `[B, N, 2]`,
/// goals `[B, N, 2]` (the agent's ball, that ball's landmark), actions and rewards `[B, N]`. Balls move by contact only. In
/// training, starts in line with balls are mixed in (`task.push_ball.start_in_line_fraction`).
pub type PushBall = Shell<PushBallTask>;

/// Push Ball as the [`Shell`] sees it.
#[derive(Debug)]
pub enum PushBallTask {}

impl Task for PushBallTask {
    type Rules = dyn Rules;

    fn start(task: &TaskConfig, training: bool, stream: &mut Stream, starts: &mut Starts) -> Result<(), EnvError> {
        let start = spawn(task, training, stream)?;
        starts.positions.extend_from_slice(&start.agents);
        starts.positions.extend_from_slice(&start.balls);
        starts.extend(LANDMARKS, &start.landmarks);
        Ok(())
    }

    fn rules(task: &TaskConfig, starts: &Starts) -> Result<Box<dyn Rules>, EnvError> {
        let bodies = 2 * task.agents;
        let (positions, velocities, landmarks) =
            (&starts.positions, &starts.velocities, starts.statics.get(LANDMARKS).to_vec());
        Ok(if share_registers(bodies, landmarks.len() / bodies) {
            Box::new(Batch::<f32, LANES>::new(task, positions, velocities, landmarks, false)?)
        } else {
            Box::new(Batch::<f32, 1>::new(task, positions, velocities, landmarks, true)?)
        })
    }
}

#[cfg(test)]
mod tests;
