//! Agreement with recordings of the authors' simulator (format `mpe-golden-1`).
//!
//! A recording holds the bodies, the constants, the initial state, the actions and every following state in f64, with
//! the reward, the success rate and the overlaps the authors' code computed. Three questions are asked of it:
//! does one step from every recorded state lead to the next one (insensitive to chaos); does a whole run from the
//! initial state stay with the recorded one for as long as the system is well conditioned; and do the authors' own
//! formulas, defects included, give the recorded reward and success.

mod recording;
mod replay;

use crate::error::RecordingError;
use recording::Recording;

/// Name of the recording's format.
pub const FORMAT: &str = "mpe-golden-1";

/// How far this simulator is from a recording. Distances are the largest absolute differences of a coordinate, in
/// world units (and per second).
#[derive(Debug, Clone, PartialEq)]
pub struct MpeReport {
    /// Name of the recording.
    pub name: String,
    /// N.
    pub agents: usize,
    /// T.
    pub steps: usize,
    /// One step from every recorded state, f64.
    pub one_step_position: f64,
    /// One step from every recorded state, f64.
    pub one_step_velocity: f64,
    /// The same in f32: difference over max(1, |recorded value|). For information: a contact multiplies the rounding of
    /// a position by its stiffness, so there is no bound that holds for every recording.
    pub one_step_position_f32: f64,
    /// The same in f32: difference over max(1, |recorded value|).
    pub one_step_velocity_f32: f64,
    /// Steps of the free run: those before the recording's own divergence exceeds [`MpeReport::WELL_CONDITIONED`].
    pub free_run_steps: usize,
    /// Free run from the initial state, f64.
    pub free_run_position: f64,
    /// The authors' reward formula on the recorded states.
    pub reward: f64,
    /// The authors' success rate on the recorded states.
    pub success_rate: f64,
    /// Steps whose number of overlapping pairs differs.
    pub overlap_mismatches: usize,
}

impl MpeReport {
    /// Largest one-step, reward and success difference of an agreeing f64 simulator.
    pub const ONE_STEP: f64 = 1e-12;
    /// Free runs are compared while a perturbation of 1e-12 has grown to no more than this.
    pub const WELL_CONDITIONED: f64 = 1e-9;
    /// Largest difference of a free run.
    pub const FREE_RUN: f64 = 1e-7;

    /// Whether everything is within its bound.
    pub fn agrees(&self) -> bool {
        self.disagreements().is_empty()
    }

    /// What is out of its bound, in words; empty if nothing is.
    pub fn disagreements(&self) -> Vec<String> {
        let bounds = [
            ("one-step position", self.one_step_position, Self::ONE_STEP),
            ("one-step velocity", self.one_step_velocity, Self::ONE_STEP),
            ("free run", self.free_run_position, Self::FREE_RUN),
            ("reward", self.reward, Self::ONE_STEP),
            ("success rate", self.success_rate, Self::ONE_STEP),
            ("steps with other overlaps", self.overlap_mismatches as f64, 0.0),
        ];
        // A number that cannot be compared is no agreement.
        let outside = bounds.into_iter().filter(|&(_, error, bound)| error.is_nan() || error > bound);
        outside.map(|(what, error, bound)| format!("{what}: {error:e} is above {bound:e}")).collect()
    }
}

/// Reads a recording and measures the agreement with it.
pub fn verify_mpe(text: &str) -> Result<MpeReport, RecordingError> {
    Ok(replay::verify(&Recording::parse(text)?))
}

#[cfg(test)]
mod tests;
