//! Agreement with recordings of gym-pybullet-drones: trajectories (`drone-golden-1`), calls of the controller
//! (`drone-controller-golden-1`) and forces of the effects (`drone-forces-golden-1`).
//!
//! A trajectory is asked four questions. Does one step of the reference model from every recorded state lead to the
//! next one (insensitive to chaos)? Does a whole run stay with the recorded one while it is well conditioned? Does the
//! controller, fed the recorded states, give the recorded rpm? Does it hold the same in closed loop?

mod calls;
mod engine;
mod exact;
mod forces;
mod recording;

use crate::check::{self, Check, worse};
use crate::error::RecordingError;
use crate::reader::Field;
use recording::Trajectory;

/// How far the drones of `magex-env` are from a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct DroneReport {
    /// What was compared, for example `PYB velocity, N = 1, 600 steps at 240 Hz`.
    pub content: String,
    /// The differences.
    pub checks: Vec<Check>,
}

impl DroneReport {
    /// Largest one-step difference of the reference model, over max(1, |recorded|).
    pub const ONE_STEP: f64 = 1e-12;
    /// Largest difference of a free run up to the recording's `free_run_horizon_steps`, over max(1, |recorded|).
    pub const FREE_RUN: f64 = 1e-9;
    /// Largest relative difference of the controller's rpm and of the effects' forces.
    pub const RELATIVE: f64 = 1e-6;

    /// Whether everything is within its limit.
    pub fn agrees(&self) -> bool {
        self.disagreements().is_empty()
    }

    /// The differences that exceed their limits, in words.
    pub fn disagreements(&self) -> Vec<String> {
        check::disagreements(&self.checks)
    }
}

/// Reads a recording of any of the three formats and measures the agreement with it.
pub fn verify_drones(text: &str) -> Result<DroneReport, RecordingError> {
    let value: serde_json::Value = serde_json::from_str(text)?;
    let root = Field::root(&value);
    let format = root.get("format")?;
    match format.text()? {
        "drone-golden-1" => {
            let recording = Trajectory::read(&root)?;
            let mut report = exact::verify(&recording);
            engine::verify(&recording, &mut report);
            Ok(report)
        }
        "drone-controller-golden-1" => calls::verify(&root),
        "drone-forces-golden-1" => forces::verify(&root),
        other => Err(format.wrong(format!(
            "'{other}' is not supported; use drone-golden-1, drone-controller-golden-1 or drone-forces-golden-1"
        ))),
    }
}

/// The formats of [`verify_drones`].
pub const FORMATS: [&str; 3] = ["drone-golden-1", "drone-controller-golden-1", "drone-forces-golden-1"];

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
