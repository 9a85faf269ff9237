//! The training loop: publish → plan → collect → evaluate → update → record → checkpoint. It runs on its own thread and blocks
//! on its [`Collector`]; its [`RunObserver`]s follow it. It has no connections.

mod finish;
mod outcome;
mod plan;
mod room;
mod saving;
mod target;
mod trust;
mod update;

use finish::summary_of;
pub use outcome::{TrainError, TrainOutcome};
pub use plan::{EVAL_SET_FINAL, EVAL_SET_TRAINING, max_shard_episodes};
use room::{check_buffer, pool};

use crate::checkpoint::disk::{Disk, FileSystem, Place, replace_file};
use crate::checkpoint::{self, CheckpointError, Progress};
use crate::collector::Collector;
use crate::origin::Origin;
use crate::report::means::{EvalSummary, IterationMeans, summarise};
use crate::report::metrics_file::{MetricsFile, ranges};
use crate::report::observer::{FileError, RunObserver, RunStart};
use crate::report::records::{IterationMetrics, Summary, Timing};
use crate::report::senders::SendersFile;
use crate::report::tensorboard::EventFile;
use crate::run_events::{RunEvent, parse_report};
use crate::run_folder::CONFIG_FILE;
use crate::run_start::{Changes, Parent, continued};
use crate::train::algorithm::Algorithm;
use crate::train::commander_ppo::{CommanderPpo, CommanderStats};
use crate::train::learned::Learned;
use crate::train::stats::UpdateStats;
use magex_core::config::RunConfig;
use magex_core::ids::{Mode, RunId, Shard, ShardKind, WeightsVersion};
use magex_core::metrics_table::{REWARD, SUCCESS_RATE};
use magex_core::sha256;
use magex_core::trajectory::{EvalOutcome, ShardResult, Trajectory};
use magex_proto::v1::{FinishedEvent, IterationEvent};
use magex_proto::weights::Weights;
use magex_runtime::trace;
use magex_viewer::page::{Phase, RunEnd};
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;
use trust::Collected;

/// Evaluations in a row that must reach the target.
const EVALUATIONS_ON_TARGET: u32 = 2;

const SUMMARY_FILE: &str = "summary.json";

/// One run.
#[derive(Debug)]
pub struct Trainer {
    config: RunConfig,
    run_id: RunId,
    disk: Arc<dyn Disk>,
    /// The run folder.
    place: Place,
    algorithm: Algorithm,
    commander: CommanderPpo,
    learned: Learned,
    progress: Progress,
    started: Instant,
    /// metrics.jsonl comes first: an iteration is on disk before it is reported anywhere else.
    observers: Vec<Box<dyn RunObserver>>,
    pool: Arc<rayon::ThreadPool>,
    /// The summary of a run that was complete when it was opened, parsed and as it is on disk.
    complete: Option<(Summary, String)>,
    before: Option<IterationEvent>,
    /// Iterations that were trained and have no line in metrics.jsonl.
    missing_lines: Vec<u32>,
    /// Checkpoints that could not be written, in a row.
    failed_checkpoints: u32,
    /// Updates that failed because of their results, in a row.
    refused: u32,
    /// The first iteration that the run may have to go back to.
    unconfirmed_since: Option<u32>,
}

impl Trainer {
    /// A new run in an existing, empty folder, with checkpoint 0.
    ///
    /// # Errors
    /// A configuration that its task or networks reject; a folder that cannot be written.
    pub fn create(config: &RunConfig, run_id: RunId, folder: &Path, threads: usize) -> Result<Self, TrainError> {
        Self::create_from(None, config, run_id, folder, threads)
    }

    /// The same, from the weights that the configuration names, if it names any: those of `parent`.
    pub fn create_from(
        parent: Option<&Parent>,
        config: &RunConfig,
        run_id: RunId,
        folder: &Path,
        threads: usize,
    ) -> Result<Self, TrainError> {
        Self::create_on(Arc::new(FileSystem), parent, config, run_id, folder, threads)
    }

    /// [`Self::create_from`] on a disk of the caller's.
    ///
    /// # Errors
    /// As those of `create_from`.
    pub fn create_on(
        disk: Arc<dyn Disk>,
        parent: Option<&Parent>,
        config: &RunConfig,
        run_id: RunId,
        folder: &Path,
        threads: usize,
    ) -> Result<Self, TrainError> {
        let mut trainer = Self::prepare(disk, config, run_id, folder, threads)?;
        match parent {
            Some(parent) => parent.begin(config, &mut trainer.learned)?,
            None if config.run.initial_weights.is_empty() => {}
            None => return Err(TrainError::NoParent(config.run.initial_weights.clone())),
        }
        let own = trainer.place.clone();
        let place = || own.clone();
        let (metrics, events) = (MetricsFile::create(trainer.disk.clone(), place())?, EventFile::new(place(), None));
        trainer.observe(metrics);
        trainer.observe(events);
        trainer.observe(SendersFile::open(place(), 0));
        trainer.checkpoint()?;
        Ok(trainer)
    }

    /// A run that continues from its newest usable checkpoint; the errors of newer ones are returned. A complete run is not
    /// changed, unless the configuration is: keys of `[run]` may change, and a larger budget continues it.
    ///
    /// # Errors
    /// No usable checkpoint; one of another configuration or format; metrics.jsonl that cannot be read.
    pub fn resume(
        config: &RunConfig,
        folder: &Path,
        threads: usize,
    ) -> Result<(Self, Vec<CheckpointError>), TrainError> {
        Self::resume_on(Arc::new(FileSystem), config, folder, threads)
    }

    /// [`Self::resume`] on a disk of the caller's.
    ///
    /// # Errors
    /// As those of `resume`.
    pub fn resume_on(
        disk: Arc<dyn Disk>,
        config: &RunConfig,
        folder: &Path,
        threads: usize,
    ) -> Result<(Self, Vec<CheckpointError>), TrainError> {
        let (config, changes) = continued(folder, config)?;
        if let Some(forbidden) = changes.forbidden() {
            return Err(TrainError::OtherConfiguration(folder.to_owned(), forbidden));
        }
        let mut trainer = Self::prepare(disk, &config, RunId(String::new()), folder, threads)?;
        let (mut progress, learned, skipped) = checkpoint::read_latest(folder, &trainer.learned)?;
        trainer.run_id = RunId(progress.run_id.clone());
        checkpoint::clean(&*trainer.disk, folder, progress.iteration);
        if changes.is_empty() {
            trainer.complete = summary_of(folder, progress.iteration, &learned)?;
        } else {
            trainer.change(&changes, &mut progress)?;
        }
        if trainer.complete.is_none() {
            let own = trainer.place.clone();
            let place = || own.clone();
            let (metrics, missing) = MetricsFile::reopen(trainer.disk.clone(), place(), progress.iteration)?;
            let events = EventFile::new(place(), Some(progress.joint_env_steps));
            if !missing.is_empty() {
                let iterations = ranges(&missing);
                tracing::warn!(
                    iterations,
                    "metrics.jsonl has no lines of these iterations; they were trained all the same"
                );
            }
            trainer.missing_lines = missing;
            trainer.observe(metrics);
            trainer.observe(events);
            trainer.observe(SendersFile::open(place(), progress.iteration));
        }
        let completed = (progress.iteration, progress.joint_env_steps);
        trainer.before = MetricsFile::last_line(folder).and_then(|line| parse_report(line, completed));
        trainer.progress = progress;
        trainer.learned = learned;
        Ok((trainer, skipped))
    }

    /// Continues with a changed configuration: the end of an earlier one is not the end any more.
    fn change(&self, changes: &Changes, progress: &mut Progress) -> Result<(), TrainError> {
        let (requested, done) = (self.config.run.max_steps, progress.joint_env_steps);
        if self.config.max_iterations() < progress.iteration {
            return Err(TrainError::Budget { requested, done });
        }
        tracing::info!(%changes, "continuing with a changed configuration");
        if changes.has("run.max_steps") && self.config.mappo.linear_decay {
            tracing::warn!(
                "mappo.linear_decay: step sizes fall to zero over the new budget from here on; the weights will differ from \
                 those of a run that began with it"
            );
        }
        if changes.target() {
            progress.on_target = 0;
        }
        (progress.config_sha256, progress.config) = (self.progress.config_sha256.clone(), self.progress.config.clone());
        let failed = |name: &str| {
            let path = self.place.folder().join(name);
            move |error| FileError { path, error }
        };
        // In this order: a kill in between leaves a run that is not complete.
        match self.disk.remove_file(&self.place.folder().join(SUMMARY_FILE)) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                return Err(failed(SUMMARY_FILE)(error).into());
            }
            _ => {}
        }
        let toml = self.progress.config.as_bytes();
        Ok(replace_file(&*self.disk, self.place.folder(), CONFIG_FILE, toml).map_err(failed(CONFIG_FILE))?)
    }

    fn prepare(
        disk: Arc<dyn Disk>,
        config: &RunConfig,
        run_id: RunId,
        folder: &Path,
        threads: usize,
    ) -> Result<Self, TrainError> {
        check_buffer(config)?;
        let algorithm = Algorithm::new(config)?;
        let commander = CommanderPpo::new(&config.commander, &config.task, config.run.seed);
        let learned = Learned::init(config, &algorithm, &commander)?;
        // Differentiation recurses through the graph: the default stack of a thread is too small for long sequences.
        let pool = pool(threads.max(1))?;
        let toml = config.to_toml()?;
        let progress = Progress {
            run_id: run_id.0.clone(),
            config_sha256: sha256::hex(toml.as_bytes()),
            config: toml,
            iteration: 0,
            joint_env_steps: 0,
            on_target: 0,
            wall_s: 0.0,
        };
        Ok(Self {
            config: config.clone(),
            run_id,
            disk,
            place: Place::of(folder),
            algorithm,
            commander,
            learned,
            progress,
            started: Instant::now(),
            observers: Vec::new(),
            pool: Arc::new(pool),
            complete: None,
            before: None,
            missing_lines: Vec::new(),
            failed_checkpoints: 0,
            refused: 0,
            unconfirmed_since: None,
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

    /// Iterations of the checkpoint that have no line in metrics.jsonl, in order: another program removed them.
    pub fn missing_lines(&self) -> &[u32] {
        &self.missing_lines
    }

    /// Adds an observer, after those that are there.
    pub fn observe(&mut self, mut observer: impl RunObserver + 'static) {
        observer.begin(RunStart { run_id: &self.run_id, folder: self.place.folder(), before: self.before.as_ref() });
        self.observers.push(Box::new(observer));
    }

    fn notify(&mut self, notify: impl FnMut(&mut Box<dyn RunObserver>)) {
        self.observers.iter_mut().for_each(notify);
    }

    fn event(&mut self, event: &RunEvent) {
        self.notify(|observer| observer.event(event));
    }

    /// Trains until the target is reached, the budget is spent, or a stop is requested.
    ///
    /// # Errors
    /// Shards that no actor can compute; networks or files that fail. A checkpoint that cannot be written is retried.
    pub fn run(&mut self, collector: &mut dyn Collector) -> Result<TrainOutcome, TrainError> {
        let outcome = self.train(collector);
        let end = match &outcome {
            Ok(TrainOutcome::Finished(summary)) => RunEnd::Finished(serde_json::to_value(summary).unwrap_or_default()),
            Ok(TrainOutcome::Stopped(reason)) => RunEnd::Stopped(reason.to_string()),
            Err(error) => RunEnd::Failed(error.to_string()),
        };
        self.notify(|observer| observer.end(&end));
        outcome
    }

    fn train(&mut self, collector: &mut dyn Collector) -> Result<TrainOutcome, TrainError> {
        if let Some((summary, line)) = self.complete.take() {
            // Nothing is computed or written again; commanders and watchers that connect late are served.
            self.publish(collector)?;
            self.event(&RunEvent::Finished(FinishedEvent { summary_json: line }));
            return Ok(TrainOutcome::Finished(Box::new(summary)));
        }
        // A checkpoint is written after the line of its iteration, so its time counts in the next line.
        let mut checkpoint_s = 0.0;
        loop {
            let iteration = self.progress.iteration;
            // Root span of the iteration; lease spans, including those in actors and commander, are its children.
            let _span = tracing::info_span!(target: trace::TARGET, parent: None, "iteration", iteration).entered();
            let mut timing = Timing { checkpoint_s, ..Timing::default() };

            let clock = Instant::now();
            self.publish(collector)?;
            timing.publish_s = clock.elapsed().as_secs_f64();

            let clock = Instant::now();
            let train = iteration < self.config.max_iterations();
            let plan = self.plan(train);
            self.notify(|observer| observer.phase(if train { Phase::Collecting } else { Phase::Evaluating }));
            let results = match self.collect(collector, plan)? {
                Collected::Results(results) => results,
                Collected::Stopped(reason) => {
                    // The iteration was not collected; a resume repeats it from the last complete one.
                    self.save();
                    return Ok(TrainOutcome::Stopped(reason));
                }
                Collected::Again => continue,
            };
            let shards: Vec<Shard> = results.iter().map(|result| *result.shard()).collect();
            timing.collect_s = clock.elapsed().as_secs_f64();
            let (trajectories, outcomes) = split(results);

            let sampled = summarise(trajectories.iter().flat_map(|trajectory| &trajectory.metrics));
            let episodes = IterationMeans { greedy: self.evaluated(&outcomes), sampled };
            let on_target = self.on_target(&episodes);
            let target_reached = on_target >= EVALUATIONS_ON_TARGET;
            if on_target > self.progress.on_target {
                // The end of the run depends on these results, and on nothing else.
                let sampled = self.config.run.target_sampled_success > 0.0;
                let decisive = shards.iter().filter(|shard| sampled || shard.kind == ShardKind::Eval).copied();
                match self.confirm(collector, &decisive.collect::<Vec<_>>())? {
                    Collected::Results(_) => {}
                    Collected::Stopped(reason) => {
                        self.save();
                        return Ok(TrainOutcome::Stopped(reason));
                    }
                    Collected::Again => continue,
                }
            }
            if target_reached || !train {
                self.record(collector, episodes, timing, None)?;
                match self.finish(collector, target_reached)? {
                    Some(outcome) => return Ok(outcome),
                    None => continue,
                }
            }

            let Some(updates) = self.update_or_refuse(collector, &trajectories, &mut timing)? else { continue };
            let senders: Vec<(Shard, Origin)> = shards.into_iter().zip(collector.origins().iter().cloned()).collect();
            self.notify(|observer| observer.senders(iteration, &senders));
            self.unconfirmed_since = collector.unconfirmed_since();
            // The line stands at the version that was evaluated and rolled out, and at the steps that it had seen: the update
            // leads to the next one. It precedes the checkpoint: after a kill in between, a resume truncates it and repeats the
            // iteration.
            self.record(collector, episodes, timing, Some(updates))?;
            // Counted when the iteration is complete: a resume from before that point evaluates again.
            self.progress.on_target = on_target;
            self.progress.iteration += 1;
            self.progress.joint_env_steps += self.config.steps_per_iteration();

            let clock = Instant::now();
            let stop = collector.stop_requested();
            let due = self.progress.iteration.is_multiple_of(self.config.run.checkpoint_every);
            if due || stop.is_some() || collector.checkpoint_requested() {
                self.save();
            }
            checkpoint_s = clock.elapsed().as_secs_f64();
            if let Some(reason) = stop {
                return Ok(TrainOutcome::Stopped(reason));
            }
        }
    }

    fn publish(&mut self, collector: &mut dyn Collector) -> Result<(), TrainError> {
        let bytes = self.learned.broadcast()?;
        let weights = Weights::new(self.run_id.clone(), WeightsVersion(self.progress.iteration), bytes.into());
        self.notify(|observer| observer.published(&weights));
        Ok(collector.publish(&Arc::new(weights))?)
    }

    /// Evaluation of version k and training episodes under version k in one plan, so that no actor idles between them.
    fn plan(&self, train: bool) -> Vec<Shard> {
        let (run, iteration) = (&self.config.run, self.progress.iteration);
        let mut shards = Vec::new();
        if iteration.is_multiple_of(run.eval_every) || !train {
            let record = self.observers.iter().any(|observer| observer.wants_recording());
            shards.extend(plan::evaluation(iteration, EVAL_SET_TRAINING, run.eval_episodes, Mode::Greedy, record));
        }
        // The target may ask for the success of sampled actions, of the last version, too.
        if train || run.target_sampled_success > 0.0 {
            shards.extend(plan::training(&self.config, iteration));
        }
        shards
    }

    fn evaluated(&mut self, outcomes: &[EvalOutcome]) -> Option<EvalSummary> {
        self.notify(|observer| observer.evaluated(outcomes));
        summarise(outcomes.iter().flat_map(|o| &o.metrics))
    }

    /// Evaluations in a row that reached the target, with this one.
    fn on_target(&self, episodes: &IterationMeans) -> u32 {
        if episodes.greedy.is_none() {
            return self.progress.on_target;
        }
        if target::reached(&self.config.run, episodes) { self.progress.on_target.saturating_add(1) } else { 0 }
    }

    fn record(
        &mut self,
        collector: &dyn Collector,
        episodes: IterationMeans,
        timing: Timing,
        updates: Option<(UpdateStats, CommanderStats)>,
    ) -> Result<(), TrainError> {
        let (executor, commander) = updates.unzip();
        let trained = if executor.is_some() { self.config.steps_per_iteration() } else { 0 };
        let metrics = IterationMetrics {
            iteration: self.progress.iteration,
            joint_env_steps: self.progress.joint_env_steps,
            agent_steps: self.progress.joint_env_steps * self.config.task.agents as u64,
            episodes,
            executor,
            commander,
            timing: timing.attributed(collector.collected().as_ref()),
            joint_steps_per_s: trained as f64 / timing.seconds().max(1e-9),
            wall_s: self.wall_s(),
        };
        let report = IterationEvent {
            iteration: metrics.iteration,
            joint_env_steps: metrics.joint_env_steps,
            success: metrics.episodes.get(SUCCESS_RATE).map(|x| x as f32),
            reward: metrics.episodes.get(REWARD).map(|x| x as f32),
            metrics_json: serde_json::to_string(&metrics)?,
            iterations_completed: metrics.iteration + u32::from(metrics.executor.is_some()),
            joint_env_steps_trained: metrics.joint_env_steps + trained,
        };
        self.notify(|observer| observer.iteration(&metrics, &report));
        self.event(&RunEvent::Iteration(report));
        Ok(())
    }

    fn wall_s(&self) -> f64 {
        self.progress.wall_s + self.started.elapsed().as_secs_f64()
    }
}

/// Training results and evaluations, each in the order of the plan.
fn split(results: Vec<ShardResult>) -> (Vec<Trajectory>, Vec<EvalOutcome>) {
    let (mut trajectories, mut outcomes) = (Vec::new(), Vec::new());
    results.into_iter().for_each(|result| match result {
        ShardResult::Train(trajectory) => trajectories.push(trajectory),
        ShardResult::Eval(outcome) => outcomes.push(outcome),
    });
    (trajectories, outcomes)
}
