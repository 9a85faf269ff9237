//! Finished and unfinished runs as they are compared: configuration, curve and closing evaluation.

use crate::failure::usage;
use crate::folder::{self, SUMMARY};
use crate::settings;
use anyhow::Context as _;
use magex_core::config::RunConfig;
use magex_core::metrics_table::{COLLISION_RATE, COLLISIONS_PER_AGENT_STEP, METRICS, SUCCESS_RATE};
use magex_learner::report::records::Summary;
use magex_viewer::curve::{MetricsLine, parse_metrics};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// One run.
#[derive(Debug, Clone)]
pub(crate) struct SeedRun {
    pub(crate) folder: PathBuf,
    pub(crate) config: RunConfig,
    /// Lines of metrics.jsonl; none if the first iteration is not complete.
    pub(crate) lines: Vec<MetricsLine>,
    /// What a complete run ended with.
    pub(crate) summary: Option<Summary>,
}

/// The runs of one configuration, which differ in their seeds.
#[derive(Debug, Clone)]
pub(crate) struct SystemRuns {
    pub(crate) name: String,
    pub(crate) folder: PathBuf,
    /// At least one, by seed.
    pub(crate) runs: Vec<SeedRun>,
}

impl SeedRun {
    pub(crate) fn read(path: &Path) -> anyhow::Result<Self> {
        let config = folder::config_of(path)?;
        let metrics = path.join("metrics.jsonl");
        let lines = match std::fs::read_to_string(&metrics) {
            Ok(text) if text.contains('\n') => parse_metrics(&text).with_context(|| metrics.display().to_string())?,
            Ok(_) => Vec::new(),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Vec::new(),
            Err(error) => return Err(anyhow::Error::new(error).context(metrics.display().to_string())),
        };
        let summary = path.join(SUMMARY);
        let summary = match std::fs::read_to_string(&summary) {
            Ok(text) => Some(serde_json::from_str(&text).with_context(|| summary.display().to_string())?),
            Err(_) => None,
        };
        Ok(Self { folder: path.to_owned(), config, lines, summary })
    }

    /// Joint environment steps trained on.
    pub(crate) fn steps(&self) -> u64 {
        let trained = self.lines.last().map_or(0, |line| line.joint_env_steps);
        self.summary.as_ref().map_or(trained, |summary| summary.joint_env_steps)
    }

    pub(crate) fn wall_s(&self) -> f64 {
        let so_far = self.lines.last().and_then(|line| line.get("wall_s")).unwrap_or_default();
        self.summary.as_ref().map_or(so_far, |summary| summary.wall_s)
    }

    /// A metric of the closing greedy evaluation, or of the latest one of a run that is not complete.
    pub(crate) fn greedy(&self, metric: usize) -> Option<f64> {
        match &self.summary {
            Some(summary) => summary.episodes.greedy[metric],
            None => self.latest(METRICS[metric].name),
        }
    }

    /// Success with sampled actions: of the closing evaluation, or of the latest training episodes.
    pub(crate) fn sampled(&self) -> Option<f64> {
        match &self.summary {
            Some(summary) => summary.episodes.sampled_success_rate,
            None => self.latest(METRICS[SUCCESS_RATE].sampled?),
        }
    }

    pub(crate) fn collisions(&self) -> [Option<f64>; 2] {
        [COLLISIONS_PER_AGENT_STEP, COLLISION_RATE].map(|metric| self.greedy(metric))
    }

    fn latest(&self, place: &str) -> Option<f64> {
        self.lines.iter().rev().find_map(|line| line.get(place))
    }

    /// [joint steps, value] of a column of metrics.jsonl.
    pub(crate) fn curve(&self, place: &str) -> Vec<[f64; 2]> {
        let point = |line: &MetricsLine| Some([line.joint_env_steps as f64, line.get(place)?]);
        self.lines.iter().filter_map(point).collect()
    }

    /// Joint steps of the first of two evaluations in a row that reach this greedy success rate.
    pub(crate) fn steps_to(&self, target: f64) -> Option<u64> {
        let curve = self.curve(METRICS[SUCCESS_RATE].name);
        let reached = curve.windows(2).find(|pair| pair.iter().all(|&[_, success]| success >= target));
        reached.map(|pair| pair[0][0] as u64)
    }
}

impl SystemRuns {
    /// A run folder, or a folder with one for every seed.
    pub(crate) fn read(path: &Path) -> anyhow::Result<Self> {
        if !path.is_dir() {
            return Err(usage(format!("RUN: {} does not exist", path.display())));
        }
        let seeds = if path.join(folder::CONFIG).exists() { Vec::new() } else { folder::seeds_in(path) };
        let folders = if seeds.is_empty() { vec![path.to_owned()] } else { seeds };
        let runs = folders.iter().map(|folder| SeedRun::read(folder)).collect::<anyhow::Result<Vec<_>>>()?;
        let without_seed = |run: &SeedRun| {
            let mut config = run.config.clone();
            config.run.seed = 0;
            settings::flat(&config)
        };
        let first = without_seed(&runs[0])?;
        for run in &runs[1..] {
            let differing = settings::differing([&first, &without_seed(run)?]);
            if !differing.is_empty() {
                let keys = differing.join(", ");
                let both = format!("{} and {}", runs[0].folder.display(), run.folder.display());
                return Err(usage(format!(
                    "{both} differ in {keys}; name runs of different configurations one by one"
                )));
            }
        }
        let name = path.file_name().map_or_else(|| path.display().to_string(), |name| name.to_string_lossy().into());
        Ok(Self { name, folder: path.to_owned(), runs })
    }

    /// The configuration as keys and values, without the seed.
    pub(crate) fn settings(&self) -> anyhow::Result<BTreeMap<String, String>> {
        let mut flat = settings::flat(&self.runs[0].config)?;
        flat.remove("run.seed");
        Ok(flat)
    }
}
