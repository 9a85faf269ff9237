//! `magex train`

use crate::artifacts::{write_curve, write_recorded_replay};
use crate::cli::Global;
use crate::failure::{coded, usage};
use crate::folder;
use crate::local::LocalCollector;
use crate::output::{Output, note, program, seconds, share, thousands};
use crate::progress::Progress;
use crate::settings::{self, Overrides};
use crate::supervise::{self, Crew};
use anyhow::Context as _;
use magex_core::config::{ExecutorKind, RunConfig};
use magex_core::ids::RunId;
use magex_learner::page::{LivePage, RunInfo};
use magex_learner::trainer::{Outcome, TrainError, Trainer};
use magex_runtime::{backoff, exit, http, server, shutdown};
use serde::Deserialize;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::time::Instant;
use tokio_util::sync::CancellationToken;

const AFTER_HELP: &str = "\
Examples:
  magex train                                   the default run: 50 agents, MAGE-X, two actors
  magex train --executor local --seed 2         the small network, another seed
  magex train my.toml --out runs/mine           a configuration of your own
  magex train --resume --out runs/mine          continue after Ctrl-C or a crash
  magex train --in-process --json               no other processes; result as JSON
  magex train --http 127.0.0.1:8080             the live page on a port of your choice (off: no page)

The run folder gets config.toml, metrics.jsonl, checkpoints/, weights.safetensors, summary.json, curve.svg,
replay.html and tensorboard/. While the run goes, its live page says how it stands: the address is printed. The same configuration and seed give the same weights, in one process or with any number
of actors. Ctrl-C finishes the iteration, writes a checkpoint and says how to resume; a second Ctrl-C
stops at once.

Exit codes: 0 done, 1 training failed, 64 wrong usage or configuration, 73 --out exists or cannot be
written, 75 stopped before the end (--resume continues), 130 interrupted twice";

/// Train a team, and leave a run folder.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct TrainArgs {
    /// Configuration file (TOML); missing keys take their defaults.
    #[arg(value_name = "CONFIG.toml")]
    pub(crate) config: Option<PathBuf>,
    /// Run folder [default: runs/<task>-<N>-<executor>-s<seed>, with -2, -3, … if it exists].
    #[arg(long, short, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
    /// Continue the run in --out from its newest usable checkpoint.
    #[arg(long, requires = "out")]
    pub(crate) resume: bool,
    /// Actor processes.
    #[arg(long, value_name = "N", default_value = "2", value_parser = settings::actors)]
    pub(crate) actors: usize,
    /// Everything in this process: no services, no network; the same weights.
    #[arg(long)]
    pub(crate) in_process: bool,
    /// Training threads (and rollout threads with --in-process) [default: the cores of this machine].
    #[arg(long, value_name = "T", value_parser = settings::threads)]
    pub(crate) threads: Option<usize>,
    /// Address of the live page, or `off`; port 0 is any free one.
    #[arg(long, value_name = "HOST:PORT", default_value = "127.0.0.1:0")]
    pub(crate) http: String,
    /// Print the effective configuration as TOML and do nothing else.
    #[arg(long)]
    pub(crate) print_config: bool,
    #[command(flatten)]
    pub(crate) overrides: Overrides,
}

/// A run that is about to begin or to continue.
pub(crate) struct Job {
    pub(crate) config: RunConfig,
    pub(crate) folder: PathBuf,
    pub(crate) resume: bool,
    pub(crate) threads: usize,
    /// Where the live page is to be, if it is wanted.
    pub(crate) http: Option<String>,
}

/// How it ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum End {
    /// Target reached or budget spent; summary.json is there.
    Finished,
    /// Told to stop; the run resumes.
    Stopped,
}

pub(crate) fn run(args: &TrainArgs, global: &Global) -> anyhow::Result<u8> {
    let clock = Instant::now();
    let output = global.output();
    let config = effective(args)?;
    if args.print_config {
        output.say(config.to_toml()?.trim_end());
        output.result(&serde_json::to_value(&config)?);
        return Ok(exit::OK);
    }
    let http = (args.http != "off").then(|| args.http.clone());
    if let Some(listen) = &http {
        server::resolve(listen).map_err(|_| usage(format!("--http {listen}: give HOST:PORT, or off for no page")))?;
    }
    let folder = args.out.clone().unwrap_or_else(|| folder::default_out(&config, Path::exists));
    if !args.resume {
        folder::create(&folder, &config)?;
    }
    let threads = args.threads.unwrap_or_else(settings::cores);
    let job = Job { config, folder, resume: args.resume, threads, http };
    let out = job.folder.display().to_string();
    let title = match args.in_process {
        true => format!("one process, {threads} threads"),
        false => format!("learner, commander and {} actors on this machine", args.actors),
    };
    let crew = Crew { actors: args.actors, threads: (settings::cores() / args.actors).max(1) };
    let mut progress = Progress::start(&job.config, &title, &out);
    let end = match args.in_process {
        true => in_process(&job, &mut progress),
        false => supervise::run(&job, crew, &mut progress),
    };
    progress.end();
    let end = end?;
    if let Err(error) = write_curve(&job.folder, &job.config) {
        tracing::warn!("no curve.svg: {error:#}");
    }
    match end {
        End::Finished => {
            if let Err(error) = write_recorded_replay(&job.folder, &job.config) {
                tracing::warn!("no replay.html: {error:#}");
            }
            let span = |end: Instant| (end - clock).as_secs_f64();
            let walls = Walls { command_s: span(Instant::now()), training_s: progress.last_iteration().map(span) };
            finished(&job, args.in_process, walls, progress.page_url(), output)
        }
        End::Stopped => Ok(stopped(&job, output)),
    }
}

/// Defaults < file < options; a resumed run keeps the configuration that it began with.
fn effective(args: &TrainArgs) -> anyhow::Result<RunConfig> {
    let Some(folder) = args.out.as_deref().filter(|_| args.resume) else {
        return Ok(args.overrides.apply(settings::read(args.config.as_deref())?)?);
    };
    if !folder.exists() {
        return Err(usage(format!("--out {} does not exist: leave out --resume to start a new run", folder.display())));
    }
    let own = folder::config_of(folder)?;
    let asked = match &args.config {
        Some(path) => args.overrides.apply(settings::read(Some(path))?)?,
        None => args.overrides.apply(own.clone())?,
    };
    if asked != own {
        let (asked, own) = (serde_json::to_value(&asked)?, serde_json::to_value(&own)?);
        let differences = differences("", &own, &asked).join(", ");
        return Err(usage(format!(
            "--resume continues a run with the configuration that it began with ({}/config.toml), but {differences}; \
             leave these out, or start a new run with another --out",
            folder.display()
        )));
    }
    Ok(own)
}

/// `run.seed is 1 there and 2 here`
fn differences(path: &str, own: &Value, asked: &Value) -> Vec<String> {
    match (own, asked) {
        (Value::Object(own), Value::Object(asked)) => own
            .iter()
            .flat_map(|(key, value)| {
                let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
                differences(&path, value, asked.get(key).unwrap_or(&Value::Null))
            })
            .collect(),
        _ if own == asked => Vec::new(),
        _ => vec![format!("{path} is {own} there and {asked} here")],
    }
}

/// Learner, commander and rollouts as threads of this process.
fn in_process(job: &Job, progress: &mut Progress) -> anyhow::Result<End> {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
    let stop = Arc::new(AtomicBool::new(false));
    let token = runtime.block_on(async { shutdown::on_signal() })?;
    let flag = stop.clone();
    runtime.spawn(async move {
        token.cancelled().await;
        flag.store(true, Ordering::Relaxed);
        note("finishing the iteration, then writing a checkpoint");
    });
    let showing = match &job.http {
        Some(listen) => {
            Some(runtime.block_on(http::bind(listen)).map_err(|e| coded(exit::UNAVAILABLE, e.to_string()))?)
        }
        None => None,
    };
    let name = job.folder.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
    let closing = CancellationToken::new();
    let page = showing.map(|showing| {
        progress.page(&showing.address().to_string());
        let info = RunInfo { name, ..RunInfo::default() };
        let page = Arc::new(LivePage::new(&job.config, info));
        let _entered = runtime.enter();
        (page.clone(), showing.serve(page.routes(|| None), closing.clone()))
    });
    let (shown, serving) = page.unzip();
    let watched = shown.clone();
    let (events, received) = mpsc::channel();
    let mut collector = LocalCollector::new(&job.config, job.threads, events, stop);
    let outcome = std::thread::scope(|scope| {
        let training = std::thread::Builder::new().name("magex-train".into()).stack_size(64 << 20).spawn_scoped(
            scope,
            move || {
                let mut trainer = trainer(job)?;
                if let Some(page) = shown {
                    trainer.show(page);
                }
                trainer.run(&mut collector)
            },
        )?;
        received.iter().for_each(|event| progress.event(&event));
        training.join().map_err(|_| coded(exit::INTERNAL, "the training thread panicked; its last words are above"))
    })?;
    if let Some(page) = watched.filter(|_| outcome.is_ok()) {
        runtime.block_on(page.farewell());
    }
    closing.cancel();
    if let Some(serving) = serving {
        // It only logs what goes wrong, and ends soon.
        let _ = runtime.block_on(serving);
    }
    match outcome? {
        Outcome::Finished(_) => Ok(End::Finished),
        Outcome::Stopped(_) => Ok(End::Stopped),
    }
}

/// A new trainer, or one that continues; says what was wrong with newer checkpoints.
pub(crate) fn trainer(job: &Job) -> Result<Trainer, TrainError> {
    if !job.resume {
        let run_id = RunId(format!("{:016x}", backoff::incarnation()));
        return Trainer::create(&job.config, run_id, &job.folder, job.threads);
    }
    let (trainer, skipped) = Trainer::resume(&job.config, &job.folder, job.threads)?;
    let from = folder::continues_from(&job.folder, skipped.len()).unwrap_or_default();
    for error in &skipped {
        tracing::warn!("{}; continuing from {from}", folder::what_is_wrong(error));
    }
    if skipped.is_empty() {
        tracing::info!(checkpoint = from, "resuming");
    }
    Ok(trainer)
}

/// What `summary.json` says that people are told.
#[derive(Debug, Deserialize)]
struct Summary {
    success_rate: f64,
    sampled_success_rate: f64,
    all_covered_rate: f64,
    arrival_step: f64,
    collisions_per_agent_step: f64,
    collision_rate: f64,
    cost_ratio: f64,
    second_cost_ratio: Option<f64>,
    joint_env_steps: u64,
    iterations: u32,
    final_episodes: u32,
    target_reached: bool,
    wall_s: f64,
    weights_sha256: String,
}

/// Seconds since the command began.
struct Walls {
    /// Until its end.
    command_s: f64,
    /// Until the last iteration was reported, so until the target was reached if it was.
    training_s: Option<f64>,
}

fn finished(job: &Job, in_process: bool, walls: Walls, page: Option<&str>, output: Output) -> anyhow::Result<u8> {
    let path = job.folder.join(folder::SUMMARY);
    let bytes = std::fs::read(&path).with_context(|| path.display().to_string())?;
    let mut value: Value = serde_json::from_slice(&bytes).with_context(|| path.display().to_string())?;
    let s: Summary = serde_json::from_slice(&bytes).with_context(|| path.display().to_string())?;
    let (horizon, episodes) = (job.config.task.horizon, s.final_episodes);
    let why = if s.target_reached { "target reached" } else { "budget spent" };
    let rows = [
        ("success rate", format!("{} greedy   {} sampled", share(s.success_rate), share(s.sampled_success_rate))),
        ("all covered", share(s.all_covered_rate)),
        ("arrival step", format!("{:.1} of {horizon}", s.arrival_step)),
        ("collisions", format!("{:.4} per agent and step", s.collisions_per_agent_step)),
        ("collision rate", format!("{:.4} of the agents crashed", s.collision_rate)),
        (
            "assignment cost",
            match s.second_cost_ratio {
                None => format!("{:.4} of the exact one", s.cost_ratio),
                Some(second) => format!("{:.4} and {second:.4} of the exact ones", s.cost_ratio),
            },
        ),
        ("joint env steps", format!("{} in {} iterations", thousands(s.joint_env_steps as f64), s.iterations)),
        (
            "wall time",
            format!("{} ({} with start and closing evaluation)", seconds(s.wall_s), seconds(walls.command_s)),
        ),
        ("weights sha256", s.weights_sha256),
    ];
    let out = job.folder.display();
    output.say(format!("\nDone: {why}. On {episodes} episodes with starts that training never saw:\n"));
    let crashes = job.config.task.crashes();
    for (name, value) in rows.into_iter().filter(|(name, _)| crashes || *name != "collision rate") {
        output.say(format!("  {name:<16} {value}"));
    }
    let magex = program();
    output.say(format!("\nNext:\n  {magex} eval {out}"));
    if job.config.executor.kind != ExecutorKind::Mlp {
        output.say(format!("  {magex} eval {out} --agents {} --scheduler exact", 4 * job.config.task.agents));
    }
    output.say(format!("  open {out}/replay.html and {out}/curve.svg"));
    if let Value::Object(map) = &mut value {
        map.insert("command_wall_s".into(), json!(walls.command_s));
        map.insert("target_wall_s".into(), json!(walls.training_s));
        map.insert("out".into(), json!(job.folder));
        map.insert("in_process".into(), json!(in_process));
        map.insert("page".into(), json!(page));
    }
    output.result(&value);
    Ok(exit::OK)
}

fn stopped(job: &Job, output: Output) -> u8 {
    let command = format!("{} train --resume --out {}", program(), job.folder.display());
    output.say(format!("\nStopped before the end. Continue with\n  {command}"));
    output.result(&json!({ "stopped": true, "out": job.folder, "resume": command, "exit_code": exit::TEMPORARY }));
    exit::TEMPORARY
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_name_the_keys_and_both_values() {
        let own = serde_json::to_value(RunConfig::default()).unwrap();
        let mut other = RunConfig::default();
        (other.run.seed, other.mappo.gamma) = (2, 0.5);
        let asked = serde_json::to_value(&other).unwrap();
        let words = differences("", &own, &asked);
        assert_eq!(words.len(), 2);
        assert!(words.contains(&"run.seed is 1 there and 2 here".to_owned()), "{words:?}");
        assert!(differences("", &own, &own).is_empty());
    }
}
