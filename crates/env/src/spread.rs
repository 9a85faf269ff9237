//! Simple Spread (paper, section 5.1.1): its worlds, their starts and their reward.

pub(crate) mod batch;
pub mod layouts;
pub mod start;

use crate::error::EnvError;
use crate::particles::constants::{LANES, share_registers};
use crate::shell::{Rules, Shell, Starts, Task};
use batch::Batch;
use magex_core::rng::Stream;
use magex_core::statics::LANDMARKS;
use magex_core::task::TaskConfig;

pub use batch::COVER_RADIUS;

/// B episodes of Simple Spread with N agents and N landmarks, stepped together.
///
/// Positions, velocities and landmarks are `[B, N, 2]` in world units (and per second), goals, actions and rewards `[B, N]`.
pub type Spread = Shell<SpreadTask>;

/// Simple Spread as the [`Shell`] sees it.
#[derive(Debug)]
pub enum SpreadTask {}

impl Task for SpreadTask {
    type Rules = dyn Rules;

    fn start(task: &TaskConfig, _: bool, stream: &mut Stream, starts: &mut Starts) -> Result<(), EnvError> {
        let start = start::spawn(task, stream);
        starts.positions.extend_from_slice(&start.agents);
        starts.extend(LANDMARKS, &start.landmarks);
        Ok(())
    }

    fn rules(task: &TaskConfig, starts: &Starts) -> Result<Box<dyn Rules>, EnvError> {
        let (positions, velocities, landmarks) =
            (&starts.positions, &starts.velocities, starts.statics.get(LANDMARKS).to_vec());
        Ok(if share_registers(task.agents, landmarks.len() / (2 * task.agents)) {
            Box::new(Batch::<f32, LANES>::new(task, positions, velocities, landmarks, false)?)
        } else {
            Box::new(Batch::<f32, 1>::new(task, positions, velocities, landmarks, true)?)
        })
    }
}

#[cfg(test)]
mod tests;
