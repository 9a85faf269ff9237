//! What a run writes down: one line per iteration in metrics.jsonl, and summary.json at its end. docs/metrics.md lists
//! every field.

use crate::checkpoint::Progress;
use crate::checkpoint::disk::{FileSystem, replace_file};
use crate::report::bottleneck::{Bound, Collected, judge};
use crate::train::commander_ppo::CommanderStats;
use crate::train::stats::UpdateStats;
use crate::trainer::TrainError;
use magex_core::config::RunConfig;
use magex_core::trajectory::EpisodeMetrics;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Means over the episodes of an evaluation, or of an iteration's training episodes.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EvalSummary {
    /// Episodes.
    pub episodes: usize,
    /// Share of landmarks covered at the last step.
    pub success_rate: f64,
    /// Share of landmarks that can be matched one-to-one to agents at the last step.
    pub matched_success_rate: f64,
    /// Share of episodes with every landmark covered at the last step.
    pub all_covered_rate: f64,
    /// Mean first step with at least 99 % covered; episodes without one count with the horizon + 1.
    pub arrival_step: f64,
    /// Other agents closer than two radii, per agent and step.
    pub collisions_per_agent_step: f64,
    /// Mean reward per agent and step.
    pub reward: f64,
    /// Mean C_c / C_h of agents to their first goals.
    pub cost_ratio: f64,
    /// The same of the second stage, if the task has one.
    pub second_cost_ratio: Option<f64>,
    /// Mean share of landmarks that the spawn already covered.
    pub spawn_success_rate: f64,
    /// Mean share of agents that crashed.
    pub collision_rate: f64,
}

/// Means in the order of the episodes; `None` if there are none.
pub fn summarise<'a>(episodes: impl IntoIterator<Item = &'a EpisodeMetrics>) -> Option<EvalSummary> {
    let episodes: Vec<&EpisodeMetrics> = episodes.into_iter().collect();
    let count = episodes.len();
    if count == 0 {
        return None;
    }
    let mean = |f: fn(&EpisodeMetrics) -> f64| episodes.iter().map(|e| f(e)).sum::<f64>() / count as f64;
    Some(EvalSummary {
        episodes: count,
        success_rate: mean(|e| e.success.into()),
        matched_success_rate: mean(|e| e.matched_success.into()),
        all_covered_rate: mean(|e| if e.success >= 1.0 { 1.0 } else { 0.0 }),
        arrival_step: mean(|e| e.arrival_step.into()),
        collisions_per_agent_step: mean(|e| e.collisions_per_agent_step.into()),
        reward: mean(|e| e.reward.into()),
        cost_ratio: mean(|e| e.cost_ratio.into()),
        second_cost_ratio: episodes
            .iter()
            .map(|e| e.second_cost_ratio.map(f64::from))
            .sum::<Option<f64>>()
            .map(|sum| sum / count as f64),
        spawn_success_rate: mean(|e| e.spawn_success.into()),
        collision_rate: mean(|e| e.collision_rate.into()),
    })
}

/// Where an iteration's wall time went, in seconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Timing {
    /// Making the weights known.
    pub publish_s: f64,
    /// Waiting for the actors.
    pub collect_s: f64,
    /// Updating the executor.
    pub executor_s: f64,
    /// Updating the commander.
    pub commander_s: f64,
    /// Writing checkpoints.
    pub checkpoint_s: f64,
    /// What the iteration waited for.
    pub bound: Bound,
}

impl Timing {
    /// With the verdict on what it was spent on.
    pub fn judged(self, collected: Option<&Collected>) -> Self {
        let learner_s = self.publish_s + self.executor_s + self.commander_s + self.checkpoint_s;
        Self { bound: judge(learner_s, self.collect_s, collected), ..self }
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
    /// Greedy evaluation of the weights that this iteration started with.
    pub success_rate: Option<f64>,
    /// Greedy evaluation: see [`EvalSummary`].
    pub matched_success_rate: Option<f64>,
    /// Greedy evaluation: see [`EvalSummary`].
    pub all_covered_rate: Option<f64>,
    /// Greedy evaluation: see [`EvalSummary`].
    pub arrival_step: Option<f64>,
    /// Greedy evaluation: see [`EvalSummary`].
    pub collisions_per_agent_step: Option<f64>,
    /// Greedy evaluation: see [`EvalSummary`].
    pub collision_rate: Option<f64>,
    /// Greedy evaluation: see [`EvalSummary`].
    pub spawn_success_rate: Option<f64>,
    /// Greedy evaluation: see [`EvalSummary`].
    pub cost_ratio: Option<f64>,
    /// Greedy evaluation: see [`EvalSummary`].
    pub second_cost_ratio: Option<f64>,
    /// Training episodes (sampled actions).
    pub sampled_success_rate: Option<f64>,
    /// Training episodes.
    pub sampled_collisions_per_agent_step: Option<f64>,
    /// Training episodes.
    pub sampled_collision_rate: Option<f64>,
    /// Training episodes (sampled goals).
    pub sampled_cost_ratio: Option<f64>,
    /// Training episodes: mean reward per agent and step.
    pub reward: Option<f64>,
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
        let eval = |f: fn(&EvalSummary) -> f64| evaluation.as_ref().map(f);
        let train = |f: fn(&EvalSummary) -> f64| training.as_ref().map(f);
        let steps = if training.is_some() { config.steps_per_iteration() as f64 } else { 0.0 };
        Self {
            iteration: progress.iteration,
            joint_env_steps: progress.joint_env_steps,
            agent_steps: progress.joint_env_steps * config.task.agents as u64,
            success_rate: eval(|e| e.success_rate),
            matched_success_rate: eval(|e| e.matched_success_rate),
            all_covered_rate: eval(|e| e.all_covered_rate),
            arrival_step: eval(|e| e.arrival_step),
            collisions_per_agent_step: eval(|e| e.collisions_per_agent_step),
            collision_rate: eval(|e| e.collision_rate),
            spawn_success_rate: eval(|e| e.spawn_success_rate),
            cost_ratio: eval(|e| e.cost_ratio),
            second_cost_ratio: evaluation.as_ref().and_then(|e| e.second_cost_ratio),
            sampled_success_rate: train(|e| e.success_rate),
            sampled_collisions_per_agent_step: train(|e| e.collisions_per_agent_step),
            sampled_collision_rate: train(|e| e.collision_rate),
            sampled_cost_ratio: train(|e| e.cost_ratio),
            reward: train(|e| e.reward),
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
    /// Greedy: share of landmarks covered at the last step.
    pub success_rate: f64,
    /// Sampled: the same.
    pub sampled_success_rate: f64,
    /// Greedy: one-to-one matched.
    pub matched_success_rate: f64,
    /// Greedy: share of episodes with every landmark covered.
    pub all_covered_rate: f64,
    /// Greedy: mean first step with at least 99 % covered.
    pub arrival_step: f64,
    /// Greedy.
    pub collisions_per_agent_step: f64,
    /// Greedy: mean share of agents that crashed.
    pub collision_rate: f64,
    /// Greedy: mean share of landmarks that the spawn already covered.
    pub spawn_success_rate: f64,
    /// Greedy: mean C_c / C_h.
    pub cost_ratio: f64,
    /// Greedy: the same of the second stage, if the task has one.
    pub second_cost_ratio: Option<f64>,
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
            success_rate: greedy.success_rate,
            sampled_success_rate: sampled.success_rate,
            matched_success_rate: greedy.matched_success_rate,
            all_covered_rate: greedy.all_covered_rate,
            arrival_step: greedy.arrival_step,
            collisions_per_agent_step: greedy.collisions_per_agent_step,
            collision_rate: greedy.collision_rate,
            spawn_success_rate: greedy.spawn_success_rate,
            cost_ratio: greedy.cost_ratio,
            second_cost_ratio: greedy.second_cost_ratio,
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

/// Lines that are kept for a disk that takes none; the oldest go first.
const WAITING: usize = 4096;

/// metrics.jsonl of a run folder. What the disk does not take now waits until it does: neither a full disk nor a kill leaves
/// half a line in the middle.
#[derive(Debug)]
pub struct MetricsFile {
    file: Option<Lines>,
}

#[derive(Debug)]
struct Lines {
    path: PathBuf,
    /// Opened for appending.
    file: File,
    /// Bytes of whole lines.
    length: u64,
    waiting: VecDeque<String>,
}

impl MetricsFile {
    /// Writes nowhere.
    pub fn none() -> Self {
        Self { file: None }
    }

    /// An empty file.
    pub fn create(folder: &Path) -> Result<Self, TrainError> {
        let path = folder.join("metrics.jsonl");
        File::create(&path).map_err(|error| TrainError::Io { path: path.clone(), error })?;
        Self::open(path)
    }

    /// The file of a resumed run, cut back to the iterations that the checkpoint contains: the others will be done again,
    /// with the same numbers.
    pub fn reopen(folder: &Path, iteration: u32) -> Result<Self, TrainError> {
        let path = folder.join("metrics.jsonl");
        let io = |error| TrainError::Io { path: path.clone(), error };
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
        // A disk without room must not keep a run from going on: what is cut off at the end needs none.
        if bytes.starts_with(kept.as_bytes()) && path.exists() {
            let file = OpenOptions::new().write(true).open(&path).map_err(io)?;
            file.set_len(kept.len() as u64).map_err(io)?;
        } else {
            replace_file(&mut FileSystem, folder, "metrics.jsonl", kept.as_bytes()).map_err(io)?;
        }
        Self::open(path)
    }

    /// The last line of a run folder's file, if it has one: how the run stood.
    pub fn last_line(folder: &Path) -> Option<String> {
        let text = std::fs::read_to_string(folder.join("metrics.jsonl")).ok()?;
        text.lines().next_back().map(str::to_owned)
    }

    /// Returns once the lines that are written would survive a power cut. What the disk says about that it says again when a
    /// checkpoint is written.
    pub fn sync(&mut self) {
        if let Some(lines) = &self.file
            && let Err(error) = lines.file.sync_data()
        {
            tracing::debug!(%error, "metrics.jsonl cannot be made durable");
        }
    }

    fn open(path: PathBuf) -> Result<Self, TrainError> {
        let opened = OpenOptions::new().append(true).open(&path).and_then(|file| Ok((file.metadata()?.len(), file)));
        let (length, file) = opened.map_err(|error| TrainError::Io { path: path.clone(), error })?;
        Ok(Self { file: Some(Lines { path, file, length, waiting: VecDeque::new() }) })
    }

    /// Appends a line and returns it. A disk that does not take it gets it with the next one.
    pub fn append(&mut self, metrics: &IterationMetrics) -> Result<String, TrainError> {
        let line = serde_json::to_string(metrics).map_err(|e| TrainError::Result(e.to_string()))?;
        if let Some(lines) = &mut self.file {
            let said = !lines.waiting.is_empty();
            lines.waiting.push_back(format!("{line}\n"));
            if lines.waiting.len() > WAITING {
                lines.waiting.pop_front();
            }
            match lines.flush() {
                Ok(()) if said => tracing::info!("metrics.jsonl can be written again"),
                Ok(()) => {}
                Err(error) if said => tracing::debug!(%error, "metrics.jsonl still cannot be written"),
                Err(error) => tracing::error!(%error, "metrics.jsonl cannot be written; its lines wait until it can"),
            }
        }
        Ok(line)
    }

    /// Writes what waits.
    ///
    /// # Errors
    /// The disk still does not take it.
    pub fn flush(&mut self) -> Result<(), TrainError> {
        match &mut self.file {
            Some(lines) => lines.flush().map_err(|error| TrainError::Io { path: lines.path.clone(), error }),
            None => Ok(()),
        }
    }
}

impl Lines {
    fn flush(&mut self) -> std::io::Result<()> {
        while let Some(line) = self.waiting.front() {
            if let Err(error) = self.file.write_all(line.as_bytes()) {
                // Part of it may be there. Cutting off needs no room.
                self.file.set_len(self.length)?;
                return Err(error);
            }
            self.length += line.len() as u64;
            self.waiting.pop_front();
        }
        Ok(())
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
    fn what_a_resume_does_again_is_cut_off_where_it_lies() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.jsonl");
        let half = line(4)[..9].to_owned();
        std::fs::write(&path, line(1) + &line(2) + &line(3) + &half).unwrap();
        let file = std::fs::metadata(&path).unwrap().ino();
        MetricsFile::reopen(folder.path(), 2).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), line(1) + &line(2));
        // No room was needed for that.
        assert_eq!(std::fs::metadata(&path).unwrap().ino(), file);
        assert_eq!(MetricsFile::last_line(folder.path()).unwrap(), line(2).trim_end());
        // Something in the middle that is no line is cut out.
        std::fs::write(&path, line(1) + "half\n" + &line(2)).unwrap();
        MetricsFile::reopen(folder.path(), 2).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), line(1) + &line(2));
    }
}
