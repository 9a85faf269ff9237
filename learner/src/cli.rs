//! The learner's command line.

use crate::checkpoint;
use crate::run_events::StopReason;
use crate::run_folder::{CONFIG_FILE, Claim, FolderError, RunFolderState};
use crate::run_identity::RunIdentity;
use crate::run_start::Parent;
use crate::serve::judge::Compute;
use crate::serve::service::learner_service;
use crate::serve::validate::{Limits, RECOMPUTE};
use crate::trainer::{TrainError, TrainOutcome, Trainer, max_shard_episodes};
use clap::Args;
use magex_core::config::{RunConfig, SEED_MAX};
use magex_core::ids::RunId;
use magex_proto::v1;
use magex_runtime::backoff::random_id;
use magex_runtime::exit::{self, Failure};
use magex_runtime::health::probe;
use magex_runtime::limits;
use magex_runtime::options;
use magex_runtime::process;
use magex_runtime::security::{Security, ServerArgs};
use magex_runtime::service::{self, Context, ServiceArgs};
use magex_viewer::page::{LivePage, RunInfo};
use std::io::ErrorKind;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use tokio_util::sync::CancellationToken;

/// How long the trainer may take to end its iteration after a shutdown. The process may exit at any moment without damage to
/// its checkpoints.
const STOP_BUDGET: Duration = Duration::from_secs(8);

/// How often a run that continues looks whether its disk takes writes again.
const DISK_RETRY: Duration = Duration::from_secs(1);
/// What a disk says that may take writes later.
const PASSING: [ErrorKind; 3] = [ErrorKind::ReadOnlyFilesystem, ErrorKind::StorageFull, ErrorKind::QuotaExceeded];

/// Differentiation recurses through the graph.
const TRAINER_STACK: usize = 64 << 20;

/// Options of a learner. Only `config` (and `seed`) can change a number of the run.
#[derive(Debug, Clone, Args)]
pub struct LearnerArgs {
    /// Configuration of the run; without it the defaults, or when resuming the run's own
    #[arg(long, env = "MAGEX_CONFIG", value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Seed of the run, in place of the configuration's
    #[arg(long, env = "MAGEX_SEED", value_name = "S", value_parser = options::whole::<u64>(0, SEED_MAX))]
    pub seed: Option<u64>,
    /// Folder of the run
    #[arg(long, env = "MAGEX_OUT", default_value = "runs/run", value_name = "FOLDER")]
    pub out: PathBuf,
    /// Continue the run in that folder
    #[arg(long, env = "MAGEX_RESUME", value_parser = options::switch)]
    pub resume: bool,
    /// Continue the run in that folder if there is one, begin it otherwise: for supervisors that repeat the same command
    #[arg(long, env = "MAGEX_RESUME_OR_CREATE", value_parser = options::switch)]
    pub resume_or_create: bool,
    /// Begin a new run from the weights of another one: its newest checkpoint
    #[arg(long, env = "MAGEX_FROM", value_name = "RUN")]
    pub from: Option<PathBuf>,
    /// With --from: begin with the state of its optimiser, too
    #[arg(long, env = "MAGEX_KEEP_OPTIMISER", value_parser = options::switch)]
    pub keep_optimiser: bool,
    /// Continue serving after the run is complete, until shutdown
    #[arg(long, env = "MAGEX_LEARNER_STAY", value_parser = options::switch)]
    pub stay: bool,
    /// Address to listen on; port 0 is any free one
    #[arg(long, env = "MAGEX_LEARNER_LISTEN", default_value = "127.0.0.1:7000", value_name = "HOST:PORT")]
    pub listen: String,
    /// Silence after which an actor loses its leases
    #[arg(long, env = "MAGEX_LEASE_SECONDS", default_value_t = 15.0, value_name = "SECONDS", value_parser = options::number(0.1, 3600.0))]
    pub lease_seconds: f64,
    /// Share of the shards that are computed a second time, by another actor, to see whether the results are the same; 0: none
    #[arg(long, env = "MAGEX_RECOMPUTE", default_value_t = RECOMPUTE, value_name = "SHARE", value_parser = options::number(0.0, 1.0))]
    pub recompute: f64,
    /// TLS and access rules of the port.
    #[command(flatten)]
    pub security: ServerArgs,
    /// Training threads [default: one per processor]
    #[arg(long, env = "MAGEX_LEARNER_THREADS", default_value_t = process::processors(), hide_default_value = true, value_name = "T", value_parser = options::whole::<usize>(1, options::THREADS_MAX))]
    pub threads: usize,
    /// Descriptor of the run folder's lock, which the supervisor of this process holds
    #[arg(long, hide = true)]
    pub lock_descriptor: Option<i32>,
    /// Options of every service
    #[command(flatten)]
    pub service: ServiceArgs,
}

/// The name of this process in the lock of a run folder.
const COMMAND: &str = "magex learner";

/// Makes what computes shards on this host, for a run's configuration: [`crate::serve::judge`].
pub type MakeJudge = fn(&RunConfig) -> Compute;

/// Trains until the run is complete or stopped. Returns the exit code.
pub fn run(mut args: LearnerArgs, judge: MakeJudge) -> Result<u8, Failure> {
    if args.service.health_check {
        return probe::own(&args.listen, args.security.tls_cert.is_some());
    }
    if args.resume && args.resume_or_create {
        return Err(Failure::usage("--resume and --resume-or-create: give one of them"));
    }
    if args.keep_optimiser && args.from.is_none() {
        return Err(Failure::usage("--keep-optimiser: give the run that it comes from with --from"));
    }
    let state = RunFolderState::of(&args.out);
    args.resume |= args.resume_or_create && state == RunFolderState::Run;
    // A run that has begun knows the weights that it began from.
    let from = args.from.as_deref().filter(|_| !args.resume || state == RunFolderState::Begun);
    let parent = from.map(Parent::read).transpose().map_err(failed)?;
    let config = configure(&args, parent.as_ref())?;
    let toml = config.to_toml().map_err(Failure::usage)?;
    if args.service.print_config {
        process::print(&toml);
        return Ok(exit::OK);
    }
    let lease = Duration::try_from_secs_f64(args.lease_seconds)
        .ok()
        .filter(|lease| (Duration::from_millis(100)..=Duration::from_secs(3600)).contains(lease))
        .ok_or_else(|| Failure::usage(format!("--lease-seconds: {} is outside 0.1..=3600", args.lease_seconds)))?;
    let security = args.security.read(&args.listen)?;
    let run = async |context: Context| train(context, &args, config, toml, parent, lease, security, judge).await;
    let reason = match service::main("learner", 2, &args.service, run)? {
        Some(TrainOutcome::Finished(_)) => return Ok(exit::OK),
        Some(TrainOutcome::Stopped(reason)) => reason.to_string(),
        None => "the iteration did not end in time; the last checkpoint remains valid".to_owned(),
    };
    tracing::info!(reason, out = %args.out.display(), "stopped; continue with --resume");
    Ok(exit::TEMPORARY)
}

/// Binds the port, prepares the run folder, then trains and serves; `None` if the trainer did not end in time.
#[expect(clippy::too_many_arguments, reason = "the one caller reads them from the command line")]
async fn train(
    mut context: Context,
    args: &LearnerArgs,
    config: RunConfig,
    toml: String,
    parent: Option<Parent>,
    lease: Duration,
    security: Security,
    judge: MakeJudge,
) -> Result<Option<TrainOutcome>, Failure> {
    // Bound first: a port that is not available must not leave a run folder behind.
    let (incoming, address) = context.listen(&args.listen, args.security.connections()).await?;
    let stop = context.stop.clone();
    let Some((claim, mut trainer)) = prepared(&stop, || prepare(args, &config, &toml, parent.as_ref())).await? else {
        return Ok(Some(TrainOutcome::Stopped(StopReason::Shutdown)));
    };
    let claim = Arc::new(claim);
    let (stopped, claimed, begun) = (stop.clone(), claim.clone(), claim.clone());
    tokio::spawn(async move {
        stopped.cancelled().await;
        claimed.lock.stopping();
    });
    let identity = RunIdentity {
        run_id: trainer.run_id().clone(),
        name: args.out.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned()),
        task_fingerprint: config.task.fingerprint(),
        run_config_toml: toml,
        seed: config.run.seed,
        lease,
    };
    let live = RunInfo { name: identity.name.clone(), learner: Some(address.to_string()), lease: Some(lease) };
    let limits = Limits::for_task(&config.task, max_shard_episodes(&config) as usize);
    // What is not a function of its name has no second result to compare with.
    let recompute = if config.task.pure() { args.recompute } else { 0.0 };
    let limits = Limits { recompute, ..limits };
    let (handle, mut collector) = learner_service(identity, limits);
    collector.judge(judge(&config));
    trainer.observe(handle.observer());
    let sources = security.sources();
    let handle = handle.guarded(security).beating(args.security.heartbeat());
    let showing = context.has_page().then(|| Arc::new(LivePage::new(&config, live)));
    let routes = match &showing {
        Some(live) => {
            trainer.observe(live.clone());
            let status = handle.clone();
            handle.routes().merge(live.routes(move || Some(status.status())))
        }
        None => handle.routes(),
    };
    context.reload(sources, handle.metrics());
    let page = context.serve_page(routes);
    let (served, until) = (handle.clone(), stop.clone());
    let serving = tokio::spawn(async move { served.serve(incoming, until).await });
    context.announce();
    let (ended, training_end) = tokio::sync::oneshot::channel();
    std::thread::Builder::new()
        .name("magex-train".to_owned())
        .stack_size(TRAINER_STACK)
        .spawn(move || {
            // The receiver is gone when the process shuts down.
            let _ = ended.send(trainer.run(&mut collector));
            // The folder stays locked while this thread may write to it.
            drop(claim);
        })
        .map_err(|error| {
            begun.abandon();
            limits::no_thread(&error, "the training thread cannot be started")
        })?;
    let outcome = tokio::select! {
        outcome = training_end => Some(outcome),
        () = async { stop.cancelled().await; tokio::time::sleep(STOP_BUDGET).await } => None,
    };
    if args.stay && matches!(outcome, Some(Ok(Ok(TrainOutcome::Finished(_))))) {
        tracing::info!("the run is complete; serving its weights until shutdown");
        tokio::select! {
            () = stop.cancelled() => {}
            () = handle.stop_signal() => {}
        }
    } else if let Some(live) = showing.filter(|_| !stop.is_cancelled()) {
        live.farewell().await;
    }
    // Notifies the actors, ends the streams and closes the port.
    stop.cancel();
    let served = serving.await.map_err(|error| Failure::new(exit::INTERNAL, error))?;
    served.map_err(|error| Failure::new(exit::INTERNAL, error))?;
    if let Some(page) = page {
        // Ends no later than the server, which has the same grace period.
        let _ = page.await;
    }
    log_ledger(&handle.status());
    let Some(outcome) = outcome else { return Ok(None) };
    let panicked = |_| Failure::new(exit::INTERNAL, "the training thread panicked; its message is in the log above");
    outcome.map_err(panicked)?.map(Some).map_err(failed)
}

fn log_ledger(status: &v1::RunStatus) {
    for (counted, totals) in [("shards", &status.ledger), ("episodes", &status.episodes)] {
        let Some(b) = totals else { continue };
        tracing::info!(
            counted,
            leased = b.leased,
            trained = b.trained,
            duplicate = b.duplicate,
            expired = b.expired,
            rejected = b.rejected,
            failed = b.failed,
            outstanding = b.outstanding,
            residual = b.residual,
            "ledger"
        );
    }
}

/// The configuration in effect: flags over environment over file; without a file the run's own, or that of the run whose weights
/// it begins from.
fn configure(args: &LearnerArgs, parent: Option<&Parent>) -> Result<RunConfig, Failure> {
    if args.resume {
        checkpoint::check_format(&args.out).map_err(Failure::usage)?;
    }
    let own = || args.resume.then(|| args.out.join(CONFIG_FILE));
    let option = if args.config.is_some() { "--config" } else { "" };
    let mut config = match (args.config.clone().or_else(own), parent) {
        (Some(path), _) => {
            let named = |error| Failure::usage(format!("{option} {}: {error}", path.display()).trim_start());
            RunConfig::from_toml(&options::text_file(option, &path)?).map_err(named)?
        }
        (None, Some(parent)) => parent.config(),
        (None, None) => RunConfig::from_toml("").map_err(Failure::usage)?,
    };
    if let Some(seed) = args.seed {
        config.run.seed = seed;
    }
    match parent {
        Some(parent) => parent.recorded(config, args.keep_optimiser).map_err(failed),
        None => Ok(config),
    }
}

fn failed(error: TrainError) -> Failure {
    let code = match &error {
        error if error.is_usage() => exit::USAGE,
        TrainError::Gone(_) => exit::CANNOT_CREATE,
        _ => exit::FAILURE,
    };
    Failure::new(code, error)
}

/// Why there is no trainer.
struct Unprepared {
    failure: Failure,
    /// The disk of a run that continues takes no writes for now.
    passing: bool,
}

impl From<Failure> for Unprepared {
    fn from(failure: Failure) -> Self {
        Self { failure, passing: false }
    }
}

/// What `prepare` prepares. A run that continues waits for its disk, as one does that trains: a restart policy would only repeat
/// the attempt. `None` if a stop is requested meanwhile.
async fn prepared<T>(
    stop: &CancellationToken,
    mut prepare: impl FnMut() -> Result<T, Unprepared>,
) -> Result<Option<T>, Failure> {
    let mut waited = false;
    loop {
        match prepare() {
            Ok(prepared) => {
                if waited {
                    tracing::info!("the run folder can be written again");
                }
                return Ok(Some(prepared));
            }
            Err(Unprepared { failure, passing: true }) => {
                if !waited {
                    tracing::error!(error = %failure, "the run folder cannot be written; waiting until it can");
                }
                waited = true;
            }
            Err(Unprepared { failure, .. }) => return Err(failure),
        }
        if stop.run_until_cancelled(tokio::time::sleep(DISK_RETRY)).await.is_none() {
            return Ok(None);
        }
    }
}

/// Locks the run folder, and creates the run or opens its newest usable checkpoint.
fn prepare(
    args: &LearnerArgs,
    config: &RunConfig,
    toml: &str,
    parent: Option<&Parent>,
) -> Result<(Claim, Trainer), Unprepared> {
    let unusable = |error: FolderError| Failure::new(exit::CANNOT_CREATE, format!("--out {error}"));
    let passing = |error: Option<&std::io::Error>| error.is_some_and(|error| PASSING.contains(&error.kind()));
    if args.resume && RunFolderState::of(&args.out) != RunFolderState::Begun {
        let claim = Claim::resume(&args.out, COMMAND, args.lock_descriptor)
            .map_err(|error| Unprepared { passing: passing(error.io()), failure: unusable(error) })?;
        let (trainer, skipped) = Trainer::resume(config, &args.out, args.threads)
            .map_err(|error| Unprepared { passing: passing(error.io()), failure: failed(error) })?;
        for problem in skipped {
            tracing::warn!(error = %problem, "skipped a checkpoint");
        }
        return Ok((claim, trainer));
    }
    let claim = Claim::begin(&args.out, toml, COMMAND, args.resume || args.resume_or_create).map_err(unusable)?;
    let run_id = RunId(format!("{:016x}", random_id()));
    match Trainer::create_from(parent, config, run_id, &args.out, args.threads) {
        Ok(trainer) => Ok((claim, trainer)),
        Err(error) => {
            claim.abandon();
            Err(if error.is_output() { Failure::new(exit::CANNOT_CREATE, error) } else { failed(error) }.into())
        }
    }
}
