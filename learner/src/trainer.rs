//! The training loop: publish → collect → update → checkpoint → again. It runs on a thread of its own and blocks on its
//! [`Collector`]; it knows nothing of connections.

mod saving;

use crate::checkpoint::{self, CheckpointError, Learned, Progress, sha256_hex};
use crate::collector::Collector;
use crate::report::metrics_file::{EvalSummary, IterationMetrics, MetricsFile, Summary, Timing, summarise};
use crate::report::tensorboard::EventFile;
use crate::run_events::{CollectError, IterationReport, RunEvent, StopReason};
use crate::train::batch::Batch;
use crate::train::commander_ppo::CommanderPpo;
use crate::train::mappo::Mappo;
use magex_core::config::RunConfig;
use magex_core::ids::{Iteration, Mode, RunId, Shard, ShardKind, WeightsVersion};
use magex_core::trajectory::{EpisodeMetrics, EvalOutcome, Recording, ShardResult, Trajectory};
use magex_nets::commander::CommanderError;
use magex_nets::params::ParamError;
use magex_proto::weights::Weights;
use magex_runtime::trace;
use magex_viewer::page::{LivePage, Phase, RunEnd};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

/// Episodes of an evaluation shard.
const EVAL_SHARD: u32 = 16;
/// Evaluation set while training.
pub const EVAL_SET_TRAINING: u32 = 1;
/// Evaluation set that closes a run: other spawns than any set before.
pub const EVAL_SET_FINAL: u32 = 2;

/// Why training stopped with an error.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// The plan could not be collected.
    #[error(transparent)]
    Collect(#[from] CollectError),
    /// Reading or writing the run folder.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// Networks.
    #[error(transparent)]
    Weights(#[from] ParamError),
    /// Commander.
    #[error(transparent)]
    Commander(#[from] CommanderError),
    /// Files of the run folder.
    #[error("{path}: {error}")]
    Io {
        /// Which.
        path: PathBuf,
        /// What the system said.
        error: std::io::Error,
    },
    /// The run is done, and what it leaves behind cannot be written.
    #[error(
        "{path}: {error}, for {waited} s; make room or give the rights, then continue with --resume: only the end is done again"
    )]
    LastFiles {
        /// Which.
        path: PathBuf,
        /// What the system said.
        error: std::io::Error,
        /// How long it was tried.
        waited: u64,
    },
    /// A result that does not belong to the plan.
    #[error("results: {0}")]
    Result(String),
    /// The run folder belongs to another configuration.
    #[error("{0}")]
    Configuration(String),
}

/// How a run ended.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// Target reached or budget spent.
    Finished(Box<Summary>),
    /// Told to stop; the run resumes from its last checkpoint.
    Stopped(StopReason),
}

/// One run.
#[derive(Debug)]
pub struct Trainer {
    config: RunConfig,
    run_id: RunId,
    folder: PathBuf,
    mappo: Mappo,
    commander: CommanderPpo,
    learned: Learned,
    progress: Progress,
    started: Instant,
    metrics: MetricsFile,
    events: EventFile,
    page: Option<Arc<LivePage>>,
    pool: Arc<rayon::ThreadPool>,
    /// A run that was complete when it was opened, and its summary as it is on disk.
    complete: Option<(Summary, String)>,
    /// How a resumed run stood.
    before: Option<IterationReport>,
    /// Checkpoints in a row that could not be written.
    failed_checkpoints: u32,
}

impl Trainer {
    /// A new run in an existing, empty folder.
    pub fn create(config: &RunConfig, run_id: RunId, folder: &Path, threads: usize) -> Result<Self, TrainError> {
        let mut trainer = Self::prepare(config, run_id, folder, threads)?;
        trainer.metrics = MetricsFile::create(folder)?;
        trainer.events = EventFile::new(folder, None);
        trainer.checkpoint()?;
        Ok(trainer)
    }

    /// A run that continues from its newest usable checkpoint. What was wrong with newer ones is returned. A run that is
    /// complete stays as it is.
    pub fn resume(
        config: &RunConfig,
        folder: &Path,
        threads: usize,
    ) -> Result<(Self, Vec<CheckpointError>), TrainError> {
        let mut trainer = Self::prepare(config, RunId(String::new()), folder, threads)?;
        let (progress, learned, skipped) = checkpoint::read_latest(folder, &trainer.learned)?;
        if progress.config_sha256 != trainer.progress.config_sha256 {
            return Err(TrainError::Configuration(format!(
                "{}: the checkpoint was made with another configuration; resume without a configuration file, or start anew",
                folder.display()
            )));
        }
        trainer.run_id = RunId(progress.run_id.clone());
        checkpoint::clean(folder);
        trainer.complete = summary_of(folder, progress.iteration, &learned)?;
        if trainer.complete.is_none() {
            trainer.metrics = MetricsFile::reopen(folder, progress.iteration)?;
            trainer.events = EventFile::new(folder, Some(progress.joint_env_steps));
        }
        trainer.before = MetricsFile::last_line(folder).and_then(IterationReport::of);
        trainer.progress = progress;
        trainer.learned = learned;
        Ok((trainer, skipped))
    }

    fn prepare(config: &RunConfig, run_id: RunId, folder: &Path, threads: usize) -> Result<Self, TrainError> {
        let mappo = Mappo::new(config)?;
        let commander = CommanderPpo::new(&config.commander, &config.task, config.run.seed);
        let learned = Learned { executor: mappo.start()?, commander: commander.start()? };
        // Differentiation recurses through the graph: the default stack of a thread is too small for long sequences.
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads.max(1))
            .thread_name(|i| format!("magex-train-{i}"))
            .stack_size(64 << 20)
            .build()
            .map_err(|e| TrainError::Configuration(format!("training threads: {e}")))?;
        let progress = Progress {
            format: checkpoint::FORMAT,
            run_id: run_id.0.clone(),
            config_sha256: config_sha256(config)?,
            iteration: 0,
            joint_env_steps: 0,
            on_target: 0,
            wall_s: 0.0,
            value_norm: learned.executor.value_norm,
            adam_steps: [0; 3],
        };
        Ok(Self {
            config: config.clone(),
            run_id,
            folder: folder.to_owned(),
            mappo,
            commander,
            learned,
            progress,
            started: Instant::now(),
            metrics: MetricsFile::none(),
            events: EventFile::none(),
            page: None,
            pool: Arc::new(pool),
            complete: None,
            before: None,
            failed_checkpoints: 0,
        })
    }

    /// Identity of the run.
    pub fn run_id(&self) -> &RunId {
        &self.run_id
    }

    /// What has been learned so far.
    pub fn learned(&self) -> &Learned {
        &self.learned
    }

    /// Shows the run on a page, with what it wrote down before.
    pub fn show(&mut self, page: Arc<LivePage>) {
        page.begin(&self.run_id, &self.folder);
        self.page = Some(page);
    }

    fn tell(&self, what: impl FnOnce(&LivePage)) {
        if let Some(page) = &self.page {
            what(page);
        }
    }

    /// Trains until the target is reached, the budget is spent, or somebody asks to stop.
    pub fn run(&mut self, collector: &mut dyn Collector) -> Result<Outcome, TrainError> {
        let outcome = self.train(collector);
        self.tell(|page| {
            page.ended(match &outcome {
                Ok(Outcome::Finished(summary)) => RunEnd::Finished(serde_json::to_value(summary).unwrap_or_default()),
                Ok(Outcome::Stopped(reason)) => RunEnd::Stopped(reason.to_string()),
                Err(error) => RunEnd::Failed(error.to_string()),
            });
        });
        outcome
    }

    fn train(&mut self, collector: &mut dyn Collector) -> Result<Outcome, TrainError> {
        if let Some(before) = self.before.take() {
            collector.resumed(&before);
        }
        if let Some((summary, line)) = self.complete.take() {
            // Nothing is computed or written again; commanders and watchers that come late are served.
            self.publish(collector)?;
            collector.event(RunEvent::Finished { summary_json: line });
            return Ok(Outcome::Finished(Box::new(summary)));
        }
        let budget = self.config.max_iterations();
        // Spent on the checkpoint after the line before.
        let mut checkpoint_s = 0.0;
        loop {
            let iteration = self.progress.iteration;
            // Ends with the iteration; leases, and what comes of them in other processes, are its children.
            let _span = tracing::info_span!(target: trace::TARGET, parent: None, "iteration", iteration).entered();
            let clock = Instant::now();
            self.publish(collector)?;
            let publish_s = clock.elapsed().as_secs_f64();
            let evaluate = iteration.is_multiple_of(self.config.run.eval_every) || iteration >= budget;
            let train = iteration < budget;
            let mut timing = Timing { checkpoint_s, publish_s, ..Timing::default() };

            // Collect: evaluation of version k and training episodes under version k in one plan, so that no actor idles.
            let clock = Instant::now();
            let mut plan = Vec::new();
            if evaluate {
                let episodes = self.config.run.eval_episodes;
                // Somebody may look at it; no number depends on that.
                plan.extend(self.evaluation(EVAL_SET_TRAINING, episodes, Mode::Greedy, self.page.is_some()));
            }
            if train {
                plan.extend(self.training());
            }
            self.tell(|page| page.phase(if train { Phase::Collecting } else { Phase::Evaluating }));
            let results = match collector.collect(plan) {
                Err(CollectError::Stopped(reason)) => return self.stop(collector, reason),
                other => other?,
            };
            timing.collect_s = clock.elapsed().as_secs_f64();
            let (trajectories, outcomes) = split(results);
            self.tell(|page| page.evaluated(&outcomes));
            let evaluation = summarise(outcomes.iter().flat_map(|o| &o.metrics));
            // Counted when the iteration is complete: whoever resumes before that evaluates again.
            let on_target = match &evaluation {
                Some(evaluation) if evaluation.success_rate >= f64::from(self.config.run.target_success) => {
                    self.progress.on_target.saturating_add(1)
                }
                Some(_) => 0,
                None => self.progress.on_target,
            };
            let target_reached = on_target >= 2;
            if target_reached || !train {
                self.record(collector, &[], evaluation, timing, None)?;
                return self.finish(collector, target_reached);
            }

            // Update.
            self.tell(|page| page.phase(Phase::Training));
            let clock = Instant::now();
            let span = tracing::info_span!(target: trace::TARGET, "update").entered();
            let done = self.progress.joint_env_steps as f64 / self.config.run.max_steps.max(1) as f64;
            let (mappo, learned, seed) = (&self.mappo, &mut self.learned, self.config.run.seed);
            let stats = self.pool.install(|| {
                let batch = Batch::new(seed, mappo.spec(), &trajectories);
                mappo.update(&mut learned.executor, &batch, iteration, done.min(1.0))
            })?;
            timing.executor_s = clock.elapsed().as_secs_f64();
            let clock = Instant::now();
            let rate = if self.config.mappo.linear_decay { 1.0 - done.min(1.0) } else { 1.0 };
            let commander = self.commander.update(&mut self.learned.commander, &trajectories, iteration, rate)?;
            timing.commander_s = clock.elapsed().as_secs_f64();
            drop(span);

            self.progress.on_target = on_target;
            self.progress.iteration += 1;
            self.progress.joint_env_steps += self.config.steps_per_iteration();
            // The line comes before the checkpoint: a kill in between costs nothing, a resume cuts the line off again.
            let episodes: Vec<EpisodeMetrics> = trajectories.iter().flat_map(|t| t.metrics.clone()).collect();
            self.record(collector, &episodes, evaluation, timing, Some((stats, commander)))?;
            let clock = Instant::now();
            let stop = collector.stop_requested();
            let due = self.progress.iteration.is_multiple_of(self.config.run.checkpoint_every);
            if due || stop.is_some() || collector.checkpoint_requested() {
                self.save(collector);
            }
            checkpoint_s = clock.elapsed().as_secs_f64();
            if let Some(reason) = stop {
                return Ok(Outcome::Stopped(reason));
            }
        }
    }

    fn publish(&self, collector: &mut dyn Collector) -> Result<(), TrainError> {
        let bytes = self.learned.broadcast()?;
        let weights = Weights::new(self.run_id.clone(), WeightsVersion(self.progress.iteration), bytes.into());
        self.tell(|page| page.published(&weights));
        Ok(collector.publish(&Arc::new(weights))?)
    }

    /// The iteration's training shards.
    fn training(&self) -> impl Iterator<Item = Shard> + use<> {
        let shards = self.config.collect.shards_per_iteration;
        let (episodes, iteration) = (self.config.collect.episodes_per_iteration / shards, self.progress.iteration);
        (0..shards).map(move |index| Shard {
            kind: ShardKind::Train,
            iteration: Iteration(iteration),
            index,
            episodes,
            first_episode: index * episodes,
            version: WeightsVersion(iteration),
            mode: Mode::Sampled,
            eval_set: 0,
            record: false,
        })
    }

    /// Shards of an evaluation of the present version.
    fn evaluation(&self, set: u32, episodes: u32, mode: Mode, record: bool) -> impl Iterator<Item = Shard> + use<> {
        let iteration = self.progress.iteration;
        // The two final evaluations share spawns; their shards need different names.
        let offset = if mode == Mode::Sampled { episodes.div_ceil(EVAL_SHARD) } else { 0 };
        (0..episodes.div_ceil(EVAL_SHARD)).map(move |index| Shard {
            kind: ShardKind::Eval,
            iteration: Iteration(iteration),
            index: index + offset,
            episodes: EVAL_SHARD.min(episodes - index * EVAL_SHARD),
            first_episode: index * EVAL_SHARD,
            version: WeightsVersion(iteration),
            mode,
            eval_set: set,
            record: record && index == 0,
        })
    }

    /// One line of metrics.jsonl, shown to whoever watches.
    fn record(
        &mut self,
        collector: &mut dyn Collector,
        episodes: &[EpisodeMetrics],
        evaluation: Option<EvalSummary>,
        timing: Timing,
        updates: Option<(crate::train::mappo::UpdateStats, crate::train::commander_ppo::CommanderStats)>,
    ) -> Result<(), TrainError> {
        let wall_s = self.progress.wall_s + self.started.elapsed().as_secs_f64();
        let metrics = IterationMetrics::new(
            &self.config,
            &self.progress,
            summarise(episodes),
            evaluation,
            timing.judged(collector.collected().as_ref()),
            updates,
            wall_s,
        );
        let mut line = self.metrics.append(&metrics)?;
        // It is kept for late watchers; the buffer it was written into is larger.
        line.shrink_to_fit();
        collector.measured(&metrics);
        self.events.append(&line, metrics.joint_env_steps);
        self.tell(|page| page.line(&line));
        collector.event(RunEvent::Iteration(IterationReport {
            iteration: Iteration(metrics.iteration),
            joint_env_steps: metrics.joint_env_steps,
            success: metrics.success_rate.map(|x| x as f32),
            reward: metrics.reward.map(|x| x as f32),
            metrics_json: line,
        }));
        Ok(())
    }

    /// The evaluation that closes a run, the last checkpoint, and the summary.
    fn finish(&mut self, collector: &mut dyn Collector, target_reached: bool) -> Result<Outcome, TrainError> {
        let wall_s = self.progress.wall_s + self.started.elapsed().as_secs_f64();
        self.save(collector);
        let episodes = self.config.run.final_episodes;
        let mut plan: Vec<Shard> = self.evaluation(EVAL_SET_FINAL, episodes, Mode::Greedy, true).collect();
        plan.extend(self.evaluation(EVAL_SET_FINAL, episodes, Mode::Sampled, false));
        self.tell(|page| page.phase(Phase::Evaluating));
        let results = match collector.collect(plan) {
            Err(CollectError::Stopped(reason)) => return Ok(Outcome::Stopped(reason)),
            other => other?,
        };
        let (_, outcomes) = split(results);
        self.tell(|page| page.evaluated(&outcomes));
        let of = |mode: Mode| {
            summarise(outcomes.iter().filter(|o| o.shard.mode == mode).flat_map(|o| &o.metrics))
                .ok_or_else(|| TrainError::Result("the final evaluation came back empty".to_owned()))
        };
        let weights = self.learned.weights()?;
        let summary = Summary::new(
            &self.config,
            &self.progress,
            &of(Mode::Greedy)?,
            &of(Mode::Sampled)?,
            target_reached,
            wall_s,
            sha256_hex(&weights),
        );
        let recordings: Vec<&Recording> = outcomes.iter().filter_map(|o| o.recording.as_ref()).collect();
        let line = String::from_utf8_lossy(&json(&summary)?).into_owned();
        let recordings = json(&recordings)?;
        // The summary comes last: who sees it sees everything.
        let files: [(&str, &[u8]); 3] =
            [("weights.safetensors", &weights), ("recordings.json", &recordings), ("summary.json", line.as_bytes())];
        if let Some(reason) = self.write_at_last(collector, &files)? {
            return Ok(Outcome::Stopped(reason));
        }
        collector.event(RunEvent::Finished { summary_json: line });
        Ok(Outcome::Finished(Box::new(summary)))
    }

    /// Stopped before the iteration was collected: the last completed iteration is what resumes.
    fn stop(&mut self, collector: &mut dyn Collector, reason: StopReason) -> Result<Outcome, TrainError> {
        self.save(collector);
        Ok(Outcome::Stopped(reason))
    }
}

/// The summary of a run that is complete: it is there, and about what the checkpoint holds.
fn summary_of(folder: &Path, iteration: u32, learned: &Learned) -> Result<Option<(Summary, String)>, TrainError> {
    let Ok(line) = std::fs::read_to_string(folder.join("summary.json")) else { return Ok(None) };
    let Ok(summary) = serde_json::from_str::<Summary>(&line) else { return Ok(None) };
    let same = summary.iterations == iteration && summary.weights_sha256 == sha256_hex(&learned.weights()?);
    Ok(same.then_some((summary, line)))
}

/// SHA-256 of everything that decides a run's numbers.
pub fn config_sha256(config: &RunConfig) -> Result<String, TrainError> {
    let text = config.to_toml().map_err(|e| TrainError::Configuration(e.to_string()))?;
    Ok(sha256_hex(text.as_bytes()))
}

fn json<T: serde::Serialize>(value: &T) -> Result<Vec<u8>, TrainError> {
    serde_json::to_vec(value).map_err(|e| TrainError::Result(e.to_string()))
}

fn split(results: Vec<ShardResult>) -> (Vec<Trajectory>, Vec<EvalOutcome>) {
    let (mut trajectories, mut outcomes) = (Vec::new(), Vec::new());
    for result in results {
        match result {
            ShardResult::Train(trajectory) => trajectories.push(trajectory),
            ShardResult::Eval(outcome) => outcomes.push(outcome),
        }
    }
    (trajectories, outcomes)
}
