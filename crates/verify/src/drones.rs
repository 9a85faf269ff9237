//! Agreement with recordings of gym-pybullet-drones: trajectories (`drone-golden-1`), calls of the controller
//! (`drone-controller-golden-1`) and forces of the effects (`drone-forces-golden-1`).
//!
//! A flight is asked four questions: does one step of the reference model from every recorded state lead to the next one
//! (insensitive to chaos); does a whole run stay with the recorded one while it is well conditioned; does the controller,
//! fed the recorded states, give the recorded rpm; and does it hold the same in closed loop?

mod calls;
mod engine;
mod exact;
mod forces;
mod recording;

use crate::reader::Field;
use crate::report::{Report, worse};
use magex_core::error::FieldError;
use recording::Trajectory;

pub(crate) use calls::verify as verify_calls;
pub(crate) use forces::verify as verify_forces;

pub(crate) const FLIGHT: &str = "drone-golden-1";
pub(crate) const CALLS: &str = "drone-controller-golden-1";
pub(crate) const FORCES: &str = "drone-forces-golden-1";
/// Largest one-step difference of the reference model, over max(1, |recorded|).
const ONE_STEP: f64 = 1e-12;
/// Largest difference of a free run up to the recording's `free_run_horizon_steps`, over max(1, |recorded|).
const FREE_RUN: f64 = 1e-9;
/// Largest relative difference of the controller's rpm and of the effects' forces.
const RELATIVE: f64 = 1e-6;

/// Compares the reference model, the controller and the task's engine with a recorded flight.
pub(crate) fn verify_flight(root: &Field<'_>) -> Result<Report, FieldError> {
    let recording = Trajectory::read(root)?;
    let mut report = exact::verify(&recording);
    engine::verify(&recording, &mut report);
    Ok(report)
}

/// Largest |a − b| / max(1, |b|).
fn apart(ours: &[f64], recorded: &[f64]) -> f64 {
    ours.iter().zip(recorded).fold(0.0, |worst, (a, b)| worse(worst, (a - b).abs() / b.abs().max(1.0)))
}

/// The same of two quaternions, which may differ in sign.
fn turned(ours: [f64; 4], recorded: [f64; 4]) -> f64 {
    let negative = ours.map(|c| -c);
    let (plus, minus) = (apart(&ours, &recorded), apart(&negative, &recorded));
    if minus < plus { minus } else { plus }
}

#[cfg(test)]
mod tests;
