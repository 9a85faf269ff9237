//! What is kept of a cell and seed: `results/<table>/<system>-<N>-seed-<s>.json`. Every table can be made from these files alone.

use super::budget::Cell;
use crate::artifacts;
use crate::runs::SeedRun;
use crate::settings;
use anyhow::Context as _;
use magex_core::config::RunConfig;
use magex_core::metrics_table::{
    ARRIVAL_STEP, COLLISION_RATE, COLLISIONS_PER_AGENT_STEP, METRICS, SUCCESS_RATE, as_written,
};
use magex_core::trajectory::EpisodeMetrics;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// The format of the file.
pub(crate) const FORMAT: &str = "magex-reproduce-1";
/// A file keeps at most this many points of a curve.
const POINTS: usize = 200;
/// A training that reached no target has converged if the greedy success of its last quarter differs from that of the quarter
/// before by less than this.
const FLAT: f64 = 0.01;
/// Evaluations below which nothing can be said of it.
const FEW: usize = 8;
/// A training that its wall time ended had less than it may have now if it took less than this share of it: the rest leaves
/// room for what is not training.
const SPENT: f64 = 0.8;

/// One cell and seed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Record {
    pub(crate) format: String,
    pub(crate) table: String,
    pub(crate) system: String,
    pub(crate) agents: usize,
    pub(crate) seed: u64,
    /// Every key of the configuration.
    pub(crate) config: serde_json::Value,
    /// SHA-256 of the weights that were evaluated; null for a controller.
    pub(crate) weights_sha256: Option<String>,
    pub(crate) joint_env_steps: u64,
    /// Seconds of training.
    pub(crate) wall_s: f64,
    pub(crate) ended_by: EndedBy,
    /// `None` where too few evaluations say nothing of it, and of controllers.
    pub(crate) converged: Option<bool>,
    pub(crate) eval_set: u32,
    pub(crate) greedy: Evaluated,
    pub(crate) sampled: Evaluated,
    /// Wall time per episode in a controller without weights; null for a learner.
    pub(crate) planning_ms: Option<f64>,
    pub(crate) curve: Vec<CurvePoint>,
}

/// Why a training ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum EndedBy {
    /// Two evaluations in a row reached the target of the configuration.
    Target,
    /// The joint environment steps were spent.
    Steps,
    /// The wall time was spent; where it ended depends on the machine.
    Time,
    /// Nothing was trained.
    NoTraining,
}

impl EndedBy {
    pub(crate) fn words(self) -> &'static str {
        match self {
            Self::Target => "target",
            Self::Steps => "steps",
            Self::Time => "time",
            Self::NoTraining => "no training",
        }
    }
}

/// A value for every episode [episodes].
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Evaluated {
    pub(crate) success_rate: Vec<f64>,
    pub(crate) collisions_per_agent_step: Vec<f64>,
    /// First step after which (almost) all landmarks were covered; the horizon + 1 if that never happened.
    pub(crate) arrival_step: Vec<f64>,
    /// Share of crashed agents; 0 in tasks where nothing crashes.
    pub(crate) collision_rate: Vec<f64>,
}

impl Evaluated {
    pub(crate) fn of(episodes: &[EpisodeMetrics]) -> Self {
        let values = |metric| episodes.iter().map(|e| as_written(e.get(metric).unwrap_or_default().into())).collect();
        Self {
            success_rate: values(SUCCESS_RATE),
            collisions_per_agent_step: values(COLLISIONS_PER_AGENT_STEP),
            arrival_step: values(ARRIVAL_STEP),
            collision_rate: values(COLLISION_RATE),
        }
    }
}

/// An evaluation while training.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct CurvePoint {
    pub(crate) joint_env_steps: u64,
    pub(crate) success_rate: f64,
    pub(crate) sampled_success_rate: Option<f64>,
    pub(crate) collision_rate: Option<f64>,
}

/// The file of a cell and seed.
pub(crate) fn path(out: &Path, cell: &Cell, seed: u64) -> PathBuf {
    out.join("results").join(cell.table.name).join(format!("{}-seed-{seed}.json", cell.id()))
}

/// The record, if there is one.
pub(crate) fn read(path: &Path) -> anyhow::Result<Option<Record>> {
    let text = match std::fs::read_to_string(path) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(anyhow::Error::new(error).context(path.display().to_string())),
    };
    let named = || format!("{}: not a result of magex reproduce; remove it to measure again", path.display());
    let record: Record = serde_json::from_str(&text).with_context(named)?;
    let episodes = record.greedy.success_rate.len();
    let complete = |e: &Evaluated| {
        let all = [&e.success_rate, &e.collisions_per_agent_step, &e.arrival_step, &e.collision_rate];
        all.iter().all(|v| v.len() == episodes)
    };
    if record.format != FORMAT || episodes == 0 || !complete(&record.greedy) || !complete(&record.sampled) {
        return Err(anyhow::anyhow!("its format is {}, or it has no episodes", record.format).context(named()));
    }
    Ok(Some(record))
}

pub(crate) fn write(path: &Path, record: &Record) -> anyhow::Result<()> {
    artifacts::write(path, format!("{}\n", serde_json::to_string(record)?).as_bytes())
}

impl Record {
    /// Keys whose values differ from those that are asked for, with both values.
    pub(crate) fn differs(&self, config: &RunConfig) -> anyhow::Result<Vec<String>> {
        // With keys that are newer than the record.
        let own = match RunConfig::from_keys(&self.config) {
            Ok(own) => settings::flat(&own)?,
            Err(_) => settings::flat_value(&self.config),
        };
        Ok(settings::changes(&own, &settings::flat(config)?))
    }

    /// Whether the training ended because of a wall time that was shorter than `limit`, in seconds.
    pub(crate) fn is_cut_short(&self, limit: Option<f64>) -> bool {
        self.ended_by == EndedBy::Time && limit.is_none_or(|limit| self.wall_s < SPENT * limit)
    }

    /// The same measurement as a cell of another table.
    pub(crate) fn in_table(&self, cell: &Cell) -> Self {
        Self { table: cell.table.name.to_owned(), system: cell.system.id.to_owned(), ..self.clone() }
    }

    /// The seed's points as [joint steps, greedy success].
    pub(crate) fn success_curve(&self) -> Vec<[f64; 2]> {
        self.curve.iter().map(|point| [point.joint_env_steps as f64, point.success_rate]).collect()
    }
}

/// The curve of a run, thinned to [`POINTS`], and whether it had become flat, if there are enough evaluations to tell.
pub(crate) fn curve_of(run: &SeedRun) -> (Vec<CurvePoint>, Option<bool>) {
    let success = &METRICS[SUCCESS_RATE];
    let points: Vec<CurvePoint> = run
        .lines
        .iter()
        .filter_map(|line| {
            Some(CurvePoint {
                joint_env_steps: line.joint_env_steps,
                success_rate: line.get(success.name)?,
                sampled_success_rate: success.sampled.and_then(|place| line.get(place)),
                collision_rate: line.get(METRICS[COLLISION_RATE].name),
            })
        })
        .collect();
    let values: Vec<f64> = points.iter().map(|point| point.success_rate).collect();
    (thinned(&points), flat(&values))
}

/// At most [`POINTS`] of them, evenly, the first and the last one among them.
fn thinned(points: &[CurvePoint]) -> Vec<CurvePoint> {
    let last = points.len().saturating_sub(1);
    if points.len() <= POINTS {
        return points.to_vec();
    }
    (0..POINTS).map(|k| points[k * last / (POINTS - 1)]).collect()
}

fn flat(values: &[f64]) -> Option<bool> {
    let quarter = values.len() / 4;
    let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
    (values.len() >= FEW).then(|| {
        let (before, last) = (values.len() - 2 * quarter, values.len() - quarter);
        (mean(&values[last..]) - mean(&values[before..last])).abs() < FLAT
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_is_flat_when_its_last_quarters_agree() {
        let rising: Vec<f64> = (0..40).map(|k| f64::from(k) / 40.0).collect();
        assert_eq!([flat(&rising), flat(&[1.0; 7]), flat(&[1.0; 8])], [Some(false), None, Some(true)]);
        let saturated: Vec<f64> = (0..40).map(|k| (f64::from(k) / 10.0).min(0.9)).collect();
        assert_eq!(flat(&saturated), Some(true));
    }

    #[test]
    fn a_long_curve_is_thinned_with_its_ends() {
        let point = |k: u64| CurvePoint {
            joint_env_steps: k,
            success_rate: 0.0,
            sampled_success_rate: None,
            collision_rate: None,
        };
        let points: Vec<CurvePoint> = (0..1234).map(point).collect();
        let thin = thinned(&points);
        assert_eq!((thin.len(), thin[0].joint_env_steps, thin[POINTS - 1].joint_env_steps), (POINTS, 0, 1233));
        assert!(thin.windows(2).all(|pair| pair[0].joint_env_steps < pair[1].joint_env_steps));
    }
}
