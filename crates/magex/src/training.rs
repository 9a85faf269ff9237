//! A training run in its folder, from its configuration to its pictures: what `magex train` and `magex reproduce` share.

use crate::artifacts::{run_name, write_curve, write_recorded_replay};
use crate::failure::{cannot_create, code_of, coded};
use crate::folder;
use crate::local::LocalCollector;
use crate::output::note;
use crate::progress::Progress;
use crate::supervise::{self, ActorPlan, ServicesPlan, TrainEnd};
use magex_actor::environment::Environments;
use magex_core::config::RunConfig;
use magex_core::ids::RunId;
use magex_learner::run_folder::{Claim, RunFolderState};
use magex_learner::run_start::Parent;
use magex_learner::trainer::{TrainOutcome, Trainer};
use magex_runtime::{backoff, exit, http, limits};
use magex_viewer::page::{LivePage, RunInfo};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use tokio::runtime::Runtime;
use tokio_util::sync::CancellationToken;

/// Threads of this process besides those that train: the page, the training thread and the threads of training or of the
/// services.
const OWN_THREADS: usize = 4;

/// What trains and where, apart from the configuration.
#[derive(Debug, Clone)]
pub(crate) struct Means {
    /// Training threads, and rollout threads within this process.
    pub(crate) threads: usize,
    /// Address of the live page, if there is one.
    pub(crate) http: Option<String>,
    /// The actor processes; `None` to train in this process.
    pub(crate) actors: Option<ActorPlan>,
    /// The name of this process in the lock of a run folder.
    pub(crate) command: &'static str,
    /// The environments of an external task: those of this process, and the options of an actor.
    pub(crate) environment: (Option<Arc<Environments>>, Vec<String>),
}

/// A run that is ready to start.
pub(crate) struct Plan {
    pub(crate) config: RunConfig,
    pub(crate) folder: PathBuf,
    pub(crate) means: Means,
    /// The right to write to it.
    claim: Arc<Claim>,
    /// The run whose weights this one begins from.
    parent: Option<Parent>,
    /// Whether there is a checkpoint to continue from.
    resume: bool,
}

/// Fails where this process may not start the threads and open the files of a run.
pub(crate) fn require_limits() -> anyhow::Result<()> {
    Ok(limits::require(limits::FILES, OWN_THREADS)?)
}

impl Plan {
    /// Creates the folder of a new run: `out`, or one in `runs/`. With `resume`, the run in `out` continues if it has begun.
    pub(crate) fn prepare(
        config: RunConfig,
        parent: Option<Parent>,
        out: Option<&Path>,
        resume: bool,
        means: Means,
    ) -> anyhow::Result<Self> {
        let resumed = out.filter(|folder| resume && continues(folder));
        let (folder, claim) = match resumed {
            Some(folder) => (folder.to_owned(), Claim::resume(folder, means.command, None).map_err(folder::refused)?),
            None => {
                let (name, toml) = (folder::default_name(&config), config.to_toml()?);
                folder::begin(out, &name, &toml, means.command, resume).map_err(folder::refused)?
            }
        };
        Ok(Self { config, folder, means, claim: Arc::new(claim), parent, resume: resumed.is_some() })
    }

    /// Trains until the run is complete or interrupted, and draws its pictures.
    pub(crate) fn train(
        &self,
        runtime: &Runtime,
        interrupted: &CancellationToken,
        progress: &mut Progress,
    ) -> anyhow::Result<TrainEnd> {
        let end = self.run(runtime, interrupted, progress);
        progress.end();
        let end = end.inspect_err(|error| {
            // Nothing was started: a corrected command finds nothing in its way.
            if [exit::USAGE, exit::UNAVAILABLE, exit::CANNOT_CREATE].contains(&code_of(error)) {
                self.claim.abandon();
            }
        })?;
        if let Err(error) = write_curve(&self.folder, &self.config) {
            tracing::warn!("no curve.svg: {error:#}");
        }
        if end == TrainEnd::Finished
            && let Err(error) = write_recorded_replay(&self.folder, &self.config)
        {
            tracing::warn!("no replay.html: {error:#}");
        }
        Ok(end)
    }

    fn run(
        &self,
        runtime: &Runtime,
        interrupted: &CancellationToken,
        progress: &mut Progress,
    ) -> anyhow::Result<TrainEnd> {
        // With services too, the run is created or checked here: errors reach the terminal instead of a log file, and the
        // learner process always continues from a checkpoint.
        let trainer = self.open()?;
        match self.means.actors {
            None => self.train_in_process(trainer, runtime, interrupted, progress),
            Some(actors) => {
                drop(trainer);
                let (folder, http) = (self.folder.as_path(), self.means.http.as_deref());
                let lock = &self.claim.lock;
                let (threads, environment) = (self.means.threads, self.means.environment.1.as_slice());
                let commander = !self.config.task.stages().is_empty();
                let services = ServicesPlan { folder, lock, threads, http, actors, environment, commander };
                runtime.block_on(supervise::run(&services, interrupted, progress))
            }
        }
    }

    /// Creates the run, or opens the newest usable checkpoint; logs what is wrong with newer ones.
    fn open(&self) -> anyhow::Result<Trainer> {
        let threads = self.means.threads;
        if !self.resume {
            let run_id = RunId(format!("{:016x}", backoff::random_id()));
            let created = Trainer::create_from(self.parent.as_ref(), &self.config, run_id, &self.folder, threads);
            return created.map_err(|error| match error {
                error if error.is_output() => cannot_create(error),
                error => error.into(),
            });
        }
        let (trainer, skipped) = Trainer::resume(&self.config, &self.folder, threads)?;
        let from = folder::continues_from(&self.folder, skipped.len()).unwrap_or_default();
        for error in &skipped {
            tracing::warn!("{}; continuing from {from}", folder::what_is_wrong(error));
        }
        if skipped.is_empty() {
            tracing::info!(checkpoint = from, "resuming");
        }
        Ok(trainer)
    }

    /// Learner, commander and rollouts as threads of this process.
    fn train_in_process(
        &self,
        mut trainer: Trainer,
        runtime: &Runtime,
        interrupted: &CancellationToken,
        progress: &mut Progress,
    ) -> anyhow::Result<TrainEnd> {
        if interrupted.is_cancelled() {
            return Ok(TrainEnd::Stopped);
        }
        let stop = Arc::new(AtomicBool::new(false));
        let (flag, told, interrupted) = (stop.clone(), self.claim.clone(), interrupted.clone());
        let stopping = runtime.spawn(async move {
            interrupted.cancelled().await;
            flag.store(true, Ordering::Relaxed);
            told.lock.stopping();
            note("finishing the iteration, then writing a checkpoint");
        });

        let closing = CancellationToken::new();
        let mut page = None;
        if let Some(listen) = &self.means.http {
            let listener = runtime.block_on(http::bind(listen)).map_err(|e| coded(exit::UNAVAILABLE, e.to_string()))?;
            progress.page(&listener.address().to_string());
            let info = RunInfo { name: run_name(&self.folder), ..RunInfo::default() };
            let live = Arc::new(LivePage::new(&self.config, info));
            trainer.observe(live.clone());
            let _entered = runtime.enter();
            page = Some((live.clone(), listener.serve(live.routes(|| None), closing.clone())));
        }

        let (events, received) = mpsc::channel();
        trainer.observe(events);
        let environments = self.means.environment.0.clone();
        let collector = LocalCollector::new(&self.config, self.means.threads, stop);
        let mut collector = collector.showing(progress.live()).in_environments(environments);
        let outcome = std::thread::scope(|scope| {
            let thread = std::thread::Builder::new().name("magex-train".into()).stack_size(64 << 20);
            let training = thread.spawn_scoped(scope, move || trainer.run(&mut collector));
            let training =
                training.map_err(|error| limits::no_thread(&error, "the training thread cannot be started"))?;
            received.iter().for_each(|event| progress.event(&event));
            training.join().map_err(|_| coded(exit::INTERNAL, "the training thread panicked; its message is above"))
        });
        // It holds the lock of the folder.
        stopping.abort();
        let outcome = outcome?;

        if let Some((live, serving)) = page {
            if outcome.is_ok() {
                runtime.block_on(live.farewell());
            }
            closing.cancel();
            // The server logs its own errors and ends soon.
            let _ = runtime.block_on(serving);
        }
        match outcome? {
            TrainOutcome::Finished(_) => Ok(TrainEnd::Finished),
            TrainOutcome::Stopped(_) => Ok(TrainEnd::Stopped),
        }
    }
}

/// Whether there is something in a folder to continue; what cannot be continued says so itself.
pub(crate) fn continues(folder: &Path) -> bool {
    matches!(RunFolderState::of(folder), RunFolderState::Run | RunFolderState::Other)
}
