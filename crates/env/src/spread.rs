//! Simple Spread (paper, section 5.1.1): its starts and its reward. Positions, velocities and landmarks are `[B, N, 2]` in
//! world units (and per second), goals, actions and rewards `[B, N]`.

pub(crate) mod layouts;
pub mod start;

mod objective;

use crate::particles::batch::Batch;
use crate::particles::constants::{LANES, share_registers};
use crate::rules::{Rules, Starts};
use magex_core::error::FieldError;
use magex_core::rng::Stream;
use magex_core::statics::LANDMARKS;
use magex_core::task::TaskConfig;
use objective::SpreadObjective;

pub use objective::COVER_RADIUS;

/// Draws the start of one episode.
pub(crate) fn start(task: &TaskConfig, stream: &mut Stream, starts: &mut Starts) {
    let start = start::spawn(task, stream);
    starts.positions.extend_from_slice(&start.agents);
    starts.extend(LANDMARKS, &start.landmarks);
}

/// The rules of episodes that start there.
pub(crate) fn rules(task: &TaskConfig, starts: &Starts) -> Result<Box<dyn Rules>, FieldError> {
    Ok(if share_registers(task.agents, starts.landmarks().len() / (2 * task.agents)) {
        Box::new(Batch::<LANES, SpreadObjective<LANES>>::new(task, starts, false)?)
    } else {
        Box::new(Batch::<1, SpreadObjective<1>>::new(task, starts, true)?)
    })
}

#[cfg(test)]
mod tests;
