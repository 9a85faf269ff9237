//! The records of a run: one line per iteration in metrics.jsonl, and summary.json at its end. docs/metrics.md lists every
//! field.

use crate::checkpoint::Progress;
use crate::checkpoint::disk::{FileSystem, replace_file};
use crate::report::bottleneck::{Bottleneck, CollectTiming, attribute};
use crate::report::means::{ClosingMeans, EvalSummary, IterationMeans};
use crate::run_events::IterationReport;
use crate::train::commander_ppo::CommanderStats;
use crate::train::stats::UpdateStats;
use magex_core::config::RunConfig;
use magex_core::metrics_table::SUCCESS_RATE;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Where an iteration's wall time went, in seconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Timing {
    /// Publishing the weights.
    pub publish_s: f64,
    /// Waiting for the actors.
    pub collect_s: f64,
    /// Updating the executor.
    pub executor_s: f64,
    /// Updating the commander.
    pub commander_s: f64,
    /// Writing checkpoints.
    pub checkpoint_s: f64,
    /// The stage that took most of it.
    pub bottleneck: Bottleneck,
}

impl Timing {
    /// With its bottleneck.
    pub fn attributed(self, collected: Option<&CollectTiming>) -> Self {
        let learner_s = self.publish_s + self.executor_s + self.commander_s + self.checkpoint_s;
        Self { bottleneck: attribute(learner_s, self.collect_s, collected), ..self }
    }

    fn seconds(&self) -> f64 {
        self.publish_s + self.collect_s + self.executor_s + self.commander_s + self.checkpoint_s
    }
}

/// One line of metrics.jsonl. Fields of an evaluation are null on iterations without one; fields of training are null on
/// the last line, which only evaluates.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct IterationMetrics {
    /// Iterations completed; equals the version of the weights that the evaluation measured on the last line.
    pub iteration: u32,
    /// Joint environment steps trained on.
    pub joint_env_steps: u64,
    /// Agent steps trained on.
    pub agent_steps: u64,
    /// What its episodes scored.
    #[serde(flatten)]
    pub episodes: IterationMeans,
    /// Executor update.
    pub executor: Option<UpdateStats>,
    /// Commander update.
    pub commander: Option<CommanderStats>,
    /// Where the time went.
    pub timing: Timing,
    /// Joint steps trained on per second of this iteration.
    pub joint_steps_per_s: f64,
    /// Seconds since the run began, over all its processes.
    pub wall_s: f64,
}

impl IterationMetrics {
    /// Assembles a line.
    pub fn new(
        config: &RunConfig,
        progress: &Progress,
        training: Option<EvalSummary>,
        evaluation: Option<EvalSummary>,
        timing: Timing,
        updates: Option<(UpdateStats, CommanderStats)>,
        wall_s: f64,
    ) -> Self {
        let seconds = timing.seconds();
        let steps = if training.is_some() { config.steps_per_iteration() as f64 } else { 0.0 };
        Self {
            iteration: progress.iteration,
            joint_env_steps: progress.joint_env_steps,
            agent_steps: progress.joint_env_steps * config.task.agents as u64,
            episodes: IterationMeans { greedy: evaluation, sampled: training },
            commander: updates.as_ref().map(|u| u.1),
            executor: updates.map(|u| u.0),
            timing,
            joint_steps_per_s: steps / seconds.max(1e-9),
            wall_s,
        }
    }
}

/// What a finished run achieved: the evaluation that closes it, on spawns never seen before.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// What its episodes scored.
    #[serde(flatten)]
    pub episodes: ClosingMeans,
    /// Joint environment steps trained on.
    pub joint_env_steps: u64,
    /// Agent steps trained on.
    pub agent_steps: u64,
    /// Seconds of the learner from its start to the end of training, the closing evaluation excluded.
    pub wall_s: f64,
    /// Iterations completed.
    pub iterations: u32,
    /// Episodes of each closing evaluation.
    pub final_episodes: u32,
    /// Whether the target was reached before the budget was spent.
    pub target_reached: bool,
    /// SHA-256 of weights.safetensors.
    pub weights_sha256: String,
    /// Task.
    pub task: String,
    /// Architecture of the executor.
    pub executor: String,
    /// Goal scheduler.
    pub scheduler: String,
    /// N.
    pub agents: usize,
    /// Seed of the run.
    pub seed: u64,
}

impl Summary {
    /// Assembles the summary.
    pub fn new(
        config: &RunConfig,
        progress: &Progress,
        greedy: &EvalSummary,
        sampled: &EvalSummary,
        target_reached: bool,
        wall_s: f64,
        weights_sha256: String,
    ) -> Self {
        Self {
            episodes: ClosingMeans { greedy: greedy.means, sampled_success_rate: sampled.means[SUCCESS_RATE] },
            joint_env_steps: progress.joint_env_steps,
            agent_steps: progress.joint_env_steps * config.task.agents as u64,
            wall_s,
            iterations: progress.iteration,
            final_episodes: config.run.final_episodes,
            target_reached,
            weights_sha256,
            task: config.task.name.to_string(),
            executor: config.executor.kind.to_string(),
            scheduler: config.commander.kind.to_string(),
            agents: config.task.agents,
            seed: config.run.seed,
        }
    }
}

/// Limit of the lines kept while the file cannot be written; the oldest are dropped first.
const MAX_WAITING: usize = 4096;

/// A file of the run folder that cannot be read or written.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {error}")]
pub struct FileError {
    /// The file.
    pub path: PathBuf,
    /// The system's error.
    pub error: std::io::Error,
}

/// metrics.jsonl of a run folder. Lines that cannot be written wait until they can: neither a full disk nor a kill leaves half
/// a line in the middle.
#[derive(Debug)]
pub struct MetricsFile {
    path: PathBuf,
    /// Opened for appending.
    file: File,
    /// Bytes of whole lines.
    length: u64,
    waiting: VecDeque<String>,
}

impl MetricsFile {
    /// An empty file.
    pub fn create(folder: &Path) -> Result<Self, FileError> {
        let path = folder.join("metrics.jsonl");
        File::create(&path).map_err(|error| FileError { path: path.clone(), error })?;
        Self::open(path)
    }

    /// The file of a resumed run, truncated to the iterations that the checkpoint contains: the others will be repeated, with
    /// the same numbers.
    pub fn reopen(folder: &Path, iteration: u32) -> Result<Self, FileError> {
        let path = folder.join("metrics.jsonl");
        let io = |error| FileError { path: path.clone(), error };
        let bytes = std::fs::read(&path).or_else(|e| match e.kind() {
            std::io::ErrorKind::NotFound => Ok(Vec::new()),
            _ => Err(io(e)),
        })?;
        let text = String::from_utf8_lossy(&bytes);
        let kept: String = text
            .lines()
            .filter(|line| {
                serde_json::from_str::<serde_json::Value>(line).is_ok_and(|v| {
                    v["iteration"].as_u64().is_some_and(|i| i <= iteration.into()) && !v["executor"].is_null()
                })
            })
            .flat_map(|line| [line, "\n"])
            .collect();
        // Truncation works on a full disk, so a full disk does not keep a run from resuming.
        if bytes.starts_with(kept.as_bytes()) && path.exists() {
            let file = OpenOptions::new().write(true).open(&path).map_err(io)?;
            file.set_len(kept.len() as u64).map_err(io)?;
        } else {
            replace_file(&mut FileSystem, folder, "metrics.jsonl", kept.as_bytes()).map_err(io)?;
        }
        Self::open(path)
    }

    /// The last line of a run folder's file, if it has one.
    pub fn last_line(folder: &Path) -> Option<String> {
        let text = std::fs::read_to_string(folder.join("metrics.jsonl")).ok()?;
        text.lines().next_back().map(str::to_owned)
    }

    fn open(path: PathBuf) -> Result<Self, FileError> {
        let opened = OpenOptions::new().append(true).open(&path).and_then(|file| Ok((file.metadata()?.len(), file)));
        let (length, file) = opened.map_err(|error| FileError { path: path.clone(), error })?;
        Ok(Self { path, file, length, waiting: VecDeque::new() })
    }

    fn write_waiting(&mut self) -> std::io::Result<()> {
        while let Some(line) = self.waiting.front() {
            if let Err(error) = self.file.write_all(line.as_bytes()) {
                // A part of the line may be written. Truncation works on a full disk.
                self.file.set_len(self.length)?;
                return Err(error);
            }
            self.length += line.len() as u64;
            self.waiting.pop_front();
        }
        Ok(())
    }
}

impl MetricsFile {
    /// Appends a line. If it cannot be written, it is written with the next one.
    pub(super) fn append(&mut self, report: &IterationReport) {
        let failed_before = !self.waiting.is_empty();
        self.waiting.push_back(format!("{}\n", report.metrics_json));
        if self.waiting.len() > MAX_WAITING {
            self.waiting.pop_front();
        }
        match self.write_waiting() {
            Ok(()) if failed_before => tracing::info!("metrics.jsonl can be written again"),
            Ok(()) => {}
            Err(error) if failed_before => tracing::debug!(%error, "metrics.jsonl still cannot be written"),
            Err(error) => tracing::error!(%error, "metrics.jsonl cannot be written; its lines wait until it can"),
        }
    }

    /// The lines written so far survive a power cut.
    pub(super) fn sync(&mut self) {
        if let Err(error) = self.file.sync_data() {
            tracing::debug!(%error, "metrics.jsonl cannot be made durable");
        }
    }

    /// Writes the lines that wait.
    pub(super) fn flush(&mut self) -> Result<(), FileError> {
        self.write_waiting().map_err(|error| FileError { path: self.path.clone(), error })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::MetadataExt as _;

    fn line(iteration: u32) -> String {
        format!("{{\"iteration\":{iteration},\"executor\":{{}}}}\n")
    }

    #[test]
    fn iterations_that_a_resume_repeats_are_truncated_in_place() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.jsonl");
        let half = line(4)[..9].to_owned();
        std::fs::write(&path, line(1) + &line(2) + &line(3) + &half).unwrap();
        let file = std::fs::metadata(&path).unwrap().ino();
        MetricsFile::reopen(folder.path(), 2).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), line(1) + &line(2));
        // The file was truncated, not replaced.
        assert_eq!(std::fs::metadata(&path).unwrap().ino(), file);
        assert_eq!(MetricsFile::last_line(folder.path()).unwrap(), line(2).trim_end());
        // An invalid line in the middle is removed.
        std::fs::write(&path, line(1) + "half\n" + &line(2)).unwrap();
        MetricsFile::reopen(folder.path(), 2).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), line(1) + &line(2));
    }
}
