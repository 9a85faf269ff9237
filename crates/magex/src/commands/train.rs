//! `magex train`: read the configuration, prepare the run folder, run, report.

use crate::artifacts::{run_name, write_curve, write_recorded_replay};
use crate::failure::{cannot_create, code_of, coded, usage};
use crate::folder;
use crate::local::LocalCollector;
use crate::options::CommonOptions;
use crate::output::{Output, note, program, seconds, thousands};
use crate::progress::Progress;
use crate::settings::{self, Overrides};
use crate::supervise::{self, ActorPlan, ServicesPlan, TrainEnd};
use anyhow::Context as _;
use magex_core::config::RunConfig;
use magex_core::ids::RunId;
use magex_core::metrics_table::{METRICS, Metric, NEVER, SUCCESS_RATE};
use magex_learner::report::records::Summary;
use magex_learner::run_folder::{Claim, RunFolderState};
use magex_learner::run_start::Parent;
use magex_learner::trainer::{TrainOutcome, Trainer};
use magex_runtime::process::processors;
use magex_runtime::{backoff, exit, http, limits, server, shutdown};
use magex_viewer::page::{LivePage, RunInfo};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::time::Instant;
use tokio::runtime::Runtime;
use tokio_util::sync::CancellationToken;

const AFTER_HELP: &str = "\
Examples:
  magex train                              the default run: 50 agents, two actors
  magex train --executor local --seed 2    the small network, another seed
  magex train my.toml --name mine          a configuration of your own, in runs/mine
  magex train --resume --out runs/mine     continue after Ctrl-C or a crash
  magex train --resume --out runs/mine --max-steps 50000    train on
  magex train new.toml --from runs/mine    begin from the weights of a run
  magex train --in-process --json          one process; result as JSON
  magex train --http 127.0.0.1:8080        fixed port for the live page

The run folder gets config.toml, metrics.jsonl, checkpoints/, weights.safetensors, summary.json, recordings.json, \
    curve.svg, replay.html, tensorboard/, logs/ and .lock; README.md explains each. \
    The address of the live page is printed at the start. The same configuration and seed give the same weights, in one \
    process or with any number of actors. The first Ctrl-C finishes the iteration, writes a checkpoint and prints how to \
    resume; a second Ctrl-C, half a second later or more, stops at once. SIGTERM, SIGUSR1 and SIGHUP are like the first \
    Ctrl-C.

Exit codes: 0 success, 1 training failed, 64 wrong usage or configuration, 69 the port of the page is in use, \
    73 --out exists, cannot be written or is written by another process, 75 stopped before the end (--resume continues), \
    130 interrupted twice";

/// Threads of this process besides those that train.
const OWN_THREADS: usize = 4;

/// Success of a run that has learned next to nothing.
const LITTLE: f64 = 0.1;

/// The name of this process in the lock of a run folder.
const COMMAND: &str = "magex train";

/// Train a team and write a run folder.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct TrainArgs {
    /// Configuration file (TOML); missing keys take their defaults.
    #[arg(value_name = "CONFIG.toml")]
    config: Option<PathBuf>,
    /// Run folder [default: runs/<task>-<N>-<executor>-s<seed>, with -2, -3, … if it exists].
    #[arg(long, short, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Name of the run: its folder is runs/NAME.
    #[arg(long, value_name = "NAME", conflicts_with = "out", value_parser = folder::name)]
    name: Option<String>,
    /// Continue the run in --out (or with --name) from its newest usable checkpoint; keys of [run] may change (budget, target,
    /// evaluations, checkpoints).
    #[arg(long)]
    resume: bool,
    /// Begin from the weights of another run: its newest checkpoint. Team size, rewards and step sizes may differ; without a
    /// configuration file, that run's configuration is used.
    #[arg(long, value_name = "RUN")]
    from: Option<PathBuf>,
    /// With --from: begin with the state of its optimiser, too.
    #[arg(long, requires = "from")]
    keep_optimiser: bool,
    /// Actor processes.
    #[arg(long, value_name = "N", default_value = "2", value_parser = settings::actors)]
    actors: usize,
    /// Run everything in this process, without services and network; the weights are the same.
    #[arg(long)]
    in_process: bool,
    /// Training threads (and rollout threads with --in-process) [default: the cores of this machine].
    #[arg(long, value_name = "T", value_parser = settings::threads)]
    threads: Option<usize>,
    /// Address of the live page, or `off`; port 0 picks a free port.
    #[arg(long, value_name = "HOST:PORT", default_value = "127.0.0.1:0")]
    http: String,
    /// Print the effective configuration as TOML and exit.
    #[arg(long)]
    print_config: bool,
    #[command(flatten)]
    overrides: Overrides,
}

impl TrainArgs {
    /// The same options with the folder that the run's name stands for. A run that continues needs one.
    fn with_folder(&self) -> anyhow::Result<Self> {
        let named = self.name.as_ref().map(|name| Path::new(folder::RUNS).join(name));
        let out = self.out.clone().or(named);
        if self.resume && out.is_none() {
            let newest = folder::newest().map(|folder| format!(" {}, the newest one", folder.display()));
            let newest = newest.unwrap_or_else(|| " FOLDER".to_owned());
            return Err(usage(format!("--resume: which run? add --out{newest}")));
        }
        Ok(Self { out, ..self.clone() })
    }
}

/// Reads the configuration, prepares the run folder, trains, and reports the result.
pub(crate) fn run(args: &TrainArgs, options: &CommonOptions) -> anyhow::Result<u8> {
    let (started, output) = (Instant::now(), options.output());
    let args = &args.with_folder()?;

    let configured = read(args)?;
    let config = &configured.config;
    if args.print_config {
        output.say(config.to_toml()?.trim_end());
        output.result(&as_json(config)?);
        return Ok(exit::OK);
    }

    // The page, the training thread and the threads of training or of the services.
    limits::require(limits::FILES, OWN_THREADS)?;
    // Before anything is created: from here on a signal leaves a run that can be resumed.
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
    let interrupted = runtime.block_on(async { shutdown::on_signal_or_hangup() })?;
    let plan = prepare(args, configured)?;
    let mut progress = Progress::start(&plan.config, &plan.title, &plan.folder.display().to_string());
    let end = train(&plan, &runtime, interrupted, &mut progress);
    runtime.shutdown_background();
    progress.end();
    let end = end.inspect_err(|error| {
        // Nothing was started: a corrected command finds nothing in its way.
        if [exit::USAGE, exit::UNAVAILABLE, exit::CANNOT_CREATE].contains(&code_of(error)) {
            plan.claim.abandon();
        }
    })?;

    if let Err(error) = write_curve(&plan.folder, &plan.config) {
        tracing::warn!("no curve.svg: {error:#}");
    }
    match end {
        TrainEnd::Finished => report_finished(&plan, started, &progress, output),
        TrainEnd::Stopped => Ok(report_stopped(&plan, output)),
    }
}

// --- Read -------------------------------------------------------------------------------------------------------------

/// What the files and options say.
struct Configured {
    config: RunConfig,
    parent: Option<Parent>,
    /// The budget before an option changed it.
    whole_budget: u64,
}

/// Defaults < file < options. A resumed run continues with its own configuration in place of the defaults, one that begins from
/// the weights of another run with that run's.
fn read(args: &TrainArgs) -> anyhow::Result<Configured> {
    let resumed = args.out.as_deref().filter(|_| args.resume);
    if let Some(folder) = resumed.filter(|folder| !folder.exists()) {
        return Err(usage(format!("--out {} does not exist: leave out --resume to start a new run", folder.display())));
    }
    let own = resumed.map(folder::config_of).transpose()?;
    if resumed.is_some_and(|folder| args.from.is_some() && RunFolderState::of(folder) != RunFolderState::Begun) {
        return Err(usage("--from: the run has begun; leave out --from to continue it, or choose another --out"));
    }
    let parent = args.from.as_deref().map(Parent::read).transpose()?;
    let base = match (&args.config, own) {
        (Some(path), _) => settings::read(Some(path))?,
        (None, Some(own)) => own,
        (None, None) => parent.as_ref().map_or_else(RunConfig::default, Parent::config),
    };
    let whole_budget = base.run.max_steps;
    let config = args.overrides.apply(base)?;
    let config = match &parent {
        Some(parent) => parent.recorded(config, args.keep_optimiser)?,
        None => config,
    };
    Ok(Configured { config, parent, whole_budget })
}

/// By its text: single-precision numbers print as they are written.
fn as_json(config: &RunConfig) -> anyhow::Result<Value> {
    Ok(serde_json::from_str(&serde_json::to_string(config)?)?)
}

// --- Prepare ----------------------------------------------------------------------------------------------------------

/// A run that is ready to start.
struct Plan {
    config: RunConfig,
    folder: PathBuf,
    /// The right to write to it.
    claim: Arc<Claim>,
    /// The run whose weights this one begins from.
    parent: Option<Parent>,
    /// Whether there is a checkpoint to continue from.
    resume: bool,
    threads: usize,
    /// Address of the live page, if there is one.
    http: Option<String>,
    /// The actor processes; `None` to train in this process.
    actors: Option<ActorPlan>,
    title: String,
    /// The budget before an option changed it.
    whole_budget: u64,
}

/// Checks the options and creates the folder of a new run.
fn prepare(args: &TrainArgs, configured: Configured) -> anyhow::Result<Plan> {
    let Configured { config, parent, whole_budget } = configured;
    let http = (args.http != "off").then(|| args.http.clone());
    if let Some(listen) = &http {
        server::resolve(listen).map_err(|_| usage(format!("--http {listen}: give HOST:PORT, or off for no page")))?;
    }
    let out = args.out.as_deref();
    let resumed = out.filter(|folder| args.resume && RunFolderState::of(folder) != RunFolderState::Begun);
    let (folder, claim) = match resumed {
        Some(folder) => (folder.to_owned(), Claim::resume(folder, COMMAND, None).map_err(folder::refused)?),
        None => {
            let (name, toml) = (folder::default_name(&config), config.to_toml()?);
            folder::begin(out, &name, &toml, COMMAND, args.resume).map_err(folder::refused)?
        }
    };
    let threads = args.threads.unwrap_or_else(processors);
    let (actors, title) = if args.in_process {
        (None, format!("one process, {threads} threads"))
    } else {
        let plan = ActorPlan { actors: args.actors, threads: (processors() / args.actors).max(1) };
        (Some(plan), format!("learner, commander and {} actors on this machine", args.actors))
    };
    let (claim, resume) = (Arc::new(claim), resumed.is_some());
    Ok(Plan { config, folder, claim, parent, resume, threads, http, actors, title, whole_budget })
}

// --- Run --------------------------------------------------------------------------------------------------------------

fn train(
    plan: &Plan,
    runtime: &Runtime,
    interrupted: CancellationToken,
    progress: &mut Progress,
) -> anyhow::Result<TrainEnd> {
    // With services too, the run is created or checked here: errors reach the terminal instead of a log file, and the
    // learner process always continues from a checkpoint.
    let trainer = open(plan)?;
    match plan.actors {
        None => train_in_process(plan, trainer, runtime, interrupted, progress),
        Some(actors) => {
            drop(trainer);
            let (folder, http) = (plan.folder.as_path(), plan.http.as_deref());
            let lock = &plan.claim.lock;
            let services = ServicesPlan { folder, lock, threads: plan.threads, http, actors };
            runtime.block_on(supervise::run(&services, &interrupted, progress))
        }
    }
}

/// Creates the run, or opens the newest usable checkpoint; logs what is wrong with newer ones.
fn open(plan: &Plan) -> anyhow::Result<Trainer> {
    if !plan.resume {
        let run_id = RunId(format!("{:016x}", backoff::random_id()));
        let created = Trainer::create_from(plan.parent.as_ref(), &plan.config, run_id, &plan.folder, plan.threads);
        return created.map_err(|error| match error {
            error if error.is_output() => cannot_create(error),
            error => error.into(),
        });
    }
    let (trainer, skipped) = Trainer::resume(&plan.config, &plan.folder, plan.threads)?;
    let from = folder::continues_from(&plan.folder, skipped.len()).unwrap_or_default();
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
    plan: &Plan,
    mut trainer: Trainer,
    runtime: &Runtime,
    interrupted: CancellationToken,
    progress: &mut Progress,
) -> anyhow::Result<TrainEnd> {
    if interrupted.is_cancelled() {
        return Ok(TrainEnd::Stopped);
    }
    let stop = Arc::new(AtomicBool::new(false));
    let flag = stop.clone();
    let told = plan.claim.clone();
    runtime.spawn(async move {
        interrupted.cancelled().await;
        flag.store(true, Ordering::Relaxed);
        told.lock.stopping();
        note("finishing the iteration, then writing a checkpoint");
    });

    let closing = CancellationToken::new();
    let mut page = None;
    if let Some(listen) = &plan.http {
        let listener = runtime.block_on(http::bind(listen)).map_err(|e| coded(exit::UNAVAILABLE, e.to_string()))?;
        progress.page(&listener.address().to_string());
        let live =
            Arc::new(LivePage::new(&plan.config, RunInfo { name: run_name(&plan.folder), ..RunInfo::default() }));
        trainer.observe(live.clone());
        let _entered = runtime.enter();
        page = Some((live.clone(), listener.serve(live.routes(|| None), closing.clone())));
    }

    let (events, received) = mpsc::channel();
    trainer.observe(events);
    let mut collector = LocalCollector::new(&plan.config, plan.threads, stop).showing(progress.live());
    let outcome = std::thread::scope(|scope| {
        let thread = std::thread::Builder::new().name("magex-train".into()).stack_size(64 << 20);
        let training = thread.spawn_scoped(scope, move || trainer.run(&mut collector));
        let training = training.map_err(|error| limits::no_thread(&error, "the training thread cannot be started"))?;
        received.iter().for_each(|event| progress.event(&event));
        training.join().map_err(|_| coded(exit::INTERNAL, "the training thread panicked; its message is above"))
    })?;

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

// --- Report -----------------------------------------------------------------------------------------------------------

fn report_finished(plan: &Plan, started: Instant, progress: &Progress, output: Output) -> anyhow::Result<u8> {
    if let Err(error) = write_recorded_replay(&plan.folder, &plan.config) {
        tracing::warn!("no replay.html: {error:#}");
    }
    let command_s = started.elapsed().as_secs_f64();
    // Until the last iteration was reported: the one that reached the target, if it was reached.
    let training_s = progress.last_iteration.map(|end| (end - started).as_secs_f64());
    let path = plan.folder.join(folder::SUMMARY);
    let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    let mut value: Value = serde_json::from_str(&text).with_context(|| path.display().to_string())?;
    let s: Summary = serde_json::from_str(&text).with_context(|| path.display().to_string())?;

    let sampled = METRICS[SUCCESS_RATE].write(s.episodes.sampled_success_rate.unwrap_or_default());
    let (run, horizon) = (&plan.config.run, plan.config.task.horizon);
    let metrics = METRICS.iter().zip(s.episodes.greedy).filter(|(metric, _)| metric.applies(&plan.config.task));
    let row = |metric: &Metric, mean: f64| match metric.write_within(mean, horizon) {
        never if never == NEVER => (metric.label, never),
        value => (metric.label, format!("{value} {}", metric.unit)),
    };
    let mut rows: Vec<(&str, String)> = metrics.filter_map(|(metric, mean)| Some(row(metric, mean?))).collect();
    rows.insert(SUCCESS_RATE + 1, ("sampled", sampled));
    rows.extend([
        ("joint env steps", format!("{} in {} iterations", thousands(s.joint_env_steps as f64), s.iterations)),
        ("training time", seconds(s.wall_s)),
        ("this command", seconds(command_s)),
    ]);
    let why = match s.target_reached {
        true => "Done: target reached",
        false if run.target_success > 1.0 => "Done: budget spent",
        false => "Budget spent before the target was reached",
    };
    output.say(format!("\n{why}.\nEvaluated on {} episodes with unseen starts:\n", s.final_episodes));
    for (name, value) in rows {
        output.say(format!("  {name:<16} {value}"));
    }
    // Beside its name it would be wider than 80 columns.
    output.say(format!("  SHA-256 of the weights:\n    {}", s.weights_sha256));
    if let Some(hint) = not_learned(&plan.config, plan.whole_budget, &s) {
        output.say(format!("\n{hint}"));
    }
    let (magex, out) = (program(), plan.folder.display());
    output.say(format!("\nNext:\n  {magex} eval {out}"));
    if !plan.config.executor.kind.fixed_team_size() {
        output.say(format!("  {magex} eval {out} --agents {} --scheduler exact", 4 * plan.config.task.agents));
    }
    output.say(format!("  open {out}/replay.html and {out}/curve.svg"));

    if let Value::Object(map) = &mut value {
        map.insert("command_wall_s".into(), json!(command_s));
        map.insert("target_wall_s".into(), json!(training_s));
        map.insert("out".into(), json!(plan.folder));
        map.insert("in_process".into(), json!(plan.actors.is_none()));
        map.insert("page".into(), json!(progress.page));
    }
    output.result(&value);
    Ok(exit::OK)
}

/// What a run that has learned next to nothing lacks. `whole` is the budget of its configuration file.
fn not_learned(config: &RunConfig, whole: u64, summary: &Summary) -> Option<String> {
    let success = summary.episodes.greedy[SUCCESS_RATE].filter(|&success| success < LITTLE)?;
    let (run, budget) = (&config.run, thousands(config.run.max_steps as f64));
    let learned = format!("Little was learned: success {}", METRICS[SUCCESS_RATE].write(success));
    Some(if run.max_steps < whole {
        let percent = (100 * run.max_steps).div_ceil(whole);
        let whole = thousands(whole as f64);
        let decay =
            if config.mappo.linear_decay { ", and learning rates fall with it (mappo.linear_decay)" } else { "" };
        format!("{learned}.\nThe budget of {budget} steps is {percent} % of this configuration's {whole}{decay}.")
    } else {
        format!("{learned} after {budget} steps.\nA larger budget continues the run: --resume --max-steps M.")
    })
}

fn report_stopped(plan: &Plan, output: Output) -> u8 {
    let command = format!("{} train --resume --out {}", program(), plan.folder.display());
    output.say(format!("\nStopped before the end. Continue with\n  {command}"));
    output.result(&json!({ "stopped": true, "out": plan.folder, "resume": command, "exit_code": exit::TEMPORARY }));
    exit::TEMPORARY
}
