//! Push Ball (paper, section 5.1.1): its starts and its reward. Positions and velocities are `[B, 2N, 2]` (agents, then
//! balls) in world units (and per second), landmarks `[B, N, 2]`, goals `[B, N, 2]` (the agent's ball, that ball's landmark),
//! actions and rewards `[B, N]`. Balls move by contact only.

mod layouts;

mod constants;
pub(crate) mod law;
mod objective;
mod start;

use crate::particles::batch::Batch;
use crate::particles::constants::{LANES, share_registers};
use crate::rules::{Rules, Starts};
use magex_core::error::FieldError;
use magex_core::rng::Stream;
use magex_core::statics::LANDMARKS;
use magex_core::task::TaskConfig;
use objective::PushBallObjective;

pub(crate) use constants::REACHED;
use start::spawn;

/// Draws the start of one episode. In training, starts in line with balls are mixed in
/// (`task.push_ball.start_in_line_fraction`).
pub(crate) fn start(
    task: &TaskConfig,
    training: bool,
    stream: &mut Stream,
    starts: &mut Starts,
) -> Result<(), FieldError> {
    let start = spawn(task, training, stream)?;
    starts.positions.extend_from_slice(&start.agents);
    starts.positions.extend_from_slice(&start.balls);
    starts.extend(LANDMARKS, &start.landmarks);
    Ok(())
}

/// The rules of episodes that start there.
pub(crate) fn rules(task: &TaskConfig, starts: &Starts) -> Result<Box<dyn Rules>, FieldError> {
    let bodies = 2 * task.agents;
    Ok(if share_registers(bodies, starts.landmarks().len() / bodies) {
        Box::new(Batch::<LANES, PushBallObjective<LANES>>::new(task, starts, false)?)
    } else {
        Box::new(Batch::<1, PushBallObjective<1>>::new(task, starts, true)?)
    })
}

#[cfg(test)]
mod tests;
