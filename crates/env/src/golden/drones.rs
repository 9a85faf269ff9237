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

use super::GoldenError;
use super::reader::Field;
use recording::Trajectory;

/// One measured difference.
#[derive(Debug, Clone, PartialEq)]
pub struct Measure {
    /// What was compared.
    pub what: &'static str,
    /// The worst difference.
    pub worst: f64,
    /// The largest one that passes; `None` if the number is for information.
    pub limit: Option<f64>,
    /// What there is to know about it; may be empty.
    pub words: String,
}

impl Measure {
    fn limited(what: &'static str, worst: f64, limit: f64) -> Self {
        Self { what, worst, limit: Some(limit), words: String::new() }
    }
}

/// How far the drones of this crate are from a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct DroneReport {
    /// What was compared, for example `PYB velocity, N = 1, 600 steps at 240 Hz`.
    pub content: String,
    /// The differences.
    pub measures: Vec<Measure>,
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

    /// What is out of its limit, in words; empty if nothing is.
    pub fn disagreements(&self) -> Vec<String> {
        let outside = self.measures.iter().filter_map(|m| {
            // A number that cannot be compared is no agreement.
            let limit = m.limit.filter(|&limit| m.worst.is_nan() || m.worst > limit)?;
            Some(format!("{}: {:e} is above {limit:e}", m.what, m.worst))
        });
        outside.collect()
    }
}

/// Reads a recording of any of the three formats and measures the agreement with it.
pub fn verify_drones(text: &str) -> Result<DroneReport, GoldenError> {
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

/// The larger error; unlike `max`, never forgets a NaN.
fn worse(worst: f64, error: f64) -> f64 {
    if error > worst || error.is_nan() { error } else { worst }
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
