//! Agreement with recordings of the authors' simulator (format `mpe-golden-1`).
//!
//! Three questions are asked: does one step from every recorded state lead to the next one (insensitive to chaos); does a
//! whole run from the initial state stay with the recorded one for as long as the system is well conditioned; and do the
//! authors' own formulas, defects included, give the recorded reward and success.

mod recording;
mod replay;

use crate::reader::Field;
use crate::report::Report;
use magex_core::error::FieldError;
use recording::Recording;

pub(crate) const FORMAT: &str = "mpe-golden-1";
/// The scenarios that are simulated: Simple Spread and Push Ball.
pub(crate) const SCENARIOS: [&str; 2] = ["spread", "push_ball"];

/// Measures the agreement with a recording. Differences are the largest absolute ones of a coordinate, in world units (and
/// per second).
pub(crate) fn verify(root: &Field<'_>) -> Result<Report, FieldError> {
    Ok(replay::verify(&Recording::read(root)?))
}

#[cfg(test)]
mod tests;
