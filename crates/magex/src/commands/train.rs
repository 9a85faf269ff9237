//! `magex train`: read the configuration, prepare the run folder, run, report.

mod report;
mod seeds;

use crate::external::EnvironmentArgs;
use crate::failure::usage;
use crate::folder;
use crate::options::CommonOptions;
use crate::progress::Progress;
use crate::settings::{self, Overrides};
use crate::supervise::{ActorPlan, TrainEnd};
use crate::training::{Means, Plan, continues, require_limits};
use magex_core::config::{RunConfig, SEED_MAX};
use magex_learner::run_start::Parent;
use magex_runtime::process::processors;
use magex_runtime::{exit, options as parse, server, shutdown};
use report::{Finished, resume, say_stopped};
use std::path::{Path, PathBuf};
use std::time::Instant;
use tokio::runtime::Runtime;
use tokio_util::sync::CancellationToken;

const AFTER_HELP: &str = "\
Examples:
  magex train                              the default run: 50 agents, two actors
  magex train --executor local --seed 2    the small network, another seed
  magex train --seeds 1,2,3                three runs, one after the other
  magex train --set mappo.gamma=0.95 --set run.eval_every=5    any key
  magex train my.toml --name mine          a configuration of your own, in runs/mine
  magex train --resume --out runs/mine     continue after Ctrl-C or a crash
  magex train --resume --out runs/mine --max-steps 50000    train on
  magex train new.toml --from runs/mine    begin from the weights of a run
  magex train --in-process --json          one process; result as JSON
  magex train --http 127.0.0.1:8080        fixed port for the live page
  magex train my.toml --environment 'python my_env.py'    an environment of your own

The run folder gets config.toml, metrics.jsonl, checkpoints/, weights.safetensors, summary.json, recordings.json, \
    curve.svg, replay.html, tensorboard/, logs/ and .lock; README.md explains each. \
    The address of the live page is printed at the start. The same configuration and seed give the same weights, in one \
    process or with any number of actors. The first Ctrl-C finishes the iteration, writes a checkpoint and prints how to \
    resume; a second Ctrl-C, half a second later or more, stops at once. SIGTERM, SIGUSR1 and SIGHUP are like the first \
    Ctrl-C.

Exit codes: 0 success, 1 training failed, 64 wrong usage or configuration, 69 the port of the page is in use, \
    73 --out exists, cannot be written or is written by another process, 75 stopped before the end (--resume continues), \
    130 interrupted twice";

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
    /// Train once for each of these seeds, one after the other, in OUT/seed-S; with --resume, those that are not complete
    /// continue.
    #[arg(long, value_name = "S,…", value_delimiter = ',', conflicts_with_all = ["seed", "print_config"],
        value_parser = parse::whole::<u64>(0, SEED_MAX))]
    seeds: Vec<u64>,
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
    environment: EnvironmentArgs,
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

/// Reads the configuration, prepares the run folder, trains, and reports the result; or does so for every seed.
pub(crate) fn run(args: &TrainArgs, options: &CommonOptions) -> anyhow::Result<u8> {
    let (started, output) = (Instant::now(), options.output());
    let args = &args.with_folder()?;
    if !args.seeds.is_empty() {
        return seeds::run(args, output);
    }
    let configured = read(args)?;
    let config = &configured.config;
    if args.print_config {
        output.say(config.to_toml()?.trim_end());
        output.result(&settings::as_json(config)?);
        return Ok(exit::OK);
    }
    let (runtime, interrupted) = prepare_process()?;
    let end = train(args, configured, &runtime, &interrupted, started);
    runtime.shutdown_background();
    match end? {
        Ok(finished) => Ok(finished.report(output)),
        Err(folder) => {
            let environment = report::environment(&args.environment.arguments());
            Ok(say_stopped(&folder, resume(&folder, &environment), output))
        }
    }
}

/// The runtime of the services and of the page, and the token of an interruption. Before anything is created: from here on a
/// signal leaves a run that can be resumed.
pub(crate) fn prepare_process() -> anyhow::Result<(Runtime, CancellationToken)> {
    require_limits()?;
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
    let interrupted = runtime.block_on(async { shutdown::on_signal_or_hangup() })?;
    Ok((runtime, interrupted))
}

/// One run: complete, or the folder of one that was stopped.
fn train(
    args: &TrainArgs,
    configured: Configured,
    runtime: &Runtime,
    interrupted: &CancellationToken,
    started: Instant,
) -> anyhow::Result<Result<Finished, PathBuf>> {
    let Configured { config, parent, whole_budget } = configured;
    let (means, title) = means(args, &config)?;
    let plan = Plan::prepare(config, parent, args.out.as_deref(), args.resume, means)?;
    let mut progress = Progress::start(&plan.config, &title, &plan.folder.display().to_string());
    match plan.train(runtime, interrupted, &mut progress)? {
        TrainEnd::Finished => Ok(Ok(Finished::read(&plan, whole_budget, started, &progress)?)),
        TrainEnd::Stopped => Ok(Err(plan.folder)),
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

/// Defaults < file < settings of keys < options. A resumed run continues with its own configuration in place of the defaults, one that begins from
/// the weights of another run with that run's.
fn read(args: &TrainArgs) -> anyhow::Result<Configured> {
    let resumed = args.out.as_deref().filter(|_| args.resume);
    if let Some(folder) = resumed.filter(|folder| !folder.exists()) {
        return Err(usage(format!("--out {} does not exist: leave out --resume to start a new run", folder.display())));
    }
    let own = resumed.map(folder::config_of).transpose()?;
    if resumed.is_some_and(|folder| args.from.is_some() && continues(folder)) {
        return Err(usage("--from: the run has begun; leave out --from to continue it, or choose another --out"));
    }
    let parent = args.from.as_deref().map(Parent::read).transpose()?;
    // A run that has begun says itself what its environment is; its actors compare.
    let described = if own.is_some() { None } else { args.environment.describe()? };
    let described = described.as_ref();
    let base = match (&args.config, own) {
        (Some(path), _) => args.overrides.read(Some(path), described)?,
        (None, Some(own)) => args.overrides.set(own)?,
        (None, None) => match &parent {
            Some(parent) => args.overrides.set(parent.config())?,
            None => args.overrides.read(None, described)?,
        },
    };
    let whole_budget = base.run.max_steps;
    let config = args.overrides.apply(base)?;
    let config = match &parent {
        Some(parent) => parent.recorded(config, args.keep_optimiser)?,
        None => config,
    };
    Ok(Configured { config, parent, whole_budget })
}

/// What trains, and what the head of the run says of it.
fn means(args: &TrainArgs, config: &RunConfig) -> anyhow::Result<(Means, String)> {
    let environments = args.environment.of_run(config)?;
    let http = (args.http != "off").then(|| args.http.clone());
    if let Some(listen) = &http {
        server::resolve(listen).map_err(|_| usage(format!("--http {listen}: give HOST:PORT, or off for no page")))?;
    }
    let threads = args.threads.unwrap_or_else(processors);
    let (actors, title) = if args.in_process {
        (None, format!("one process, {threads} threads"))
    } else {
        let plan = ActorPlan { actors: args.actors, threads: (processors() / args.actors).max(1) };
        let services = if config.task.stages().is_empty() { "learner" } else { "learner, commander" };
        (Some(plan), format!("{services} and {} actors on this machine", args.actors))
    };
    let environment = (environments, args.environment.arguments());
    Ok((Means { threads, http, actors, command: COMMAND, environment }, title))
}
