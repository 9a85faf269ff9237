//! `magex eval`

use crate::artifacts;
use crate::evaluate::{Controller, Episodes, Modes, Subject, mode_name, roll_out};
use crate::failure::usage;
use crate::options::CommonOptions;
use crate::output::{Table, note, seconds};
use crate::settings;
use magex_core::config::SEED_MAX;
use magex_core::ids::Mode;
use magex_core::metrics_table::{METRICS, Metric};
use magex_core::task::{Spawn, TaskConfig};
use magex_core::trajectory::EpisodeMetrics;
use magex_learner::report::means::{EvalSummary, summarise};
use magex_runtime::exit;
use magex_runtime::options;
use magex_runtime::process::processors;
use serde::Serialize;
use serde_json::{Map, json};
use std::path::PathBuf;
use std::time::Instant;

const AFTER_HELP: &str = "\
Examples:
  magex eval runs/simple-spread-50-magex-s1        100 episodes per mode
  magex eval RUN --episode-seeds 1,2,3 --mode greedy    300 episodes
  magex eval RUN --agents 200 --scheduler exact    a larger team
  magex eval RUN --controller scripted             the scripted baseline
  magex eval CONFIG.toml --controller astar --scheduler greedy   without a run
  magex eval RUN --spawn lines --per-layout        one row per layout
  magex eval weights.safetensors --config config.toml   a weights file
  magex eval RUN --strict --json                   for scripts

success: share of landmarks with an agent within 0.15 at the end. matched: the \
    same with one agent per landmark. all covered: share of episodes with every \
    landmark covered. arrival: first step with 99 % covered. collisions: other \
    agents in contact, per agent and step. cost: summed distance to the goals over \
    the minimum. planning ms: what a controller without weights computes per episode.

Exit codes: 0 success, 1 evaluation failed, 64 wrong usage or configuration";

/// Evaluate a run on starts that training never saw.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct EvalArgs {
    /// Episodes per row.
    #[arg(long, value_name = "K", default_value_t = 100, value_parser = settings::count)]
    episodes: u32,
    /// Seeds of the episodes, one row per seed and mode [default: the seed of the run].
    #[arg(long, value_name = "S,…", value_delimiter = ',', value_parser = options::whole::<u64>(0, SEED_MAX))]
    episode_seeds: Vec<u64>,
    /// The former name of --episode-seeds.
    #[arg(long, value_name = "S,…", hide = true, value_parser = renamed)]
    seeds: Option<String>,
    /// How actions and goals are chosen [default: both; greedy for controllers without weights].
    #[arg(long, value_enum, value_name = "MODE")]
    mode: Option<Modes>,
    /// One row per layout (spawn modes lines and authors).
    #[arg(long)]
    per_layout: bool,
    /// Rollout threads [default: the cores of this machine].
    #[arg(long, value_name = "T", value_parser = settings::threads)]
    threads: Option<usize>,
    /// Write a replay of the first episode of the first row.
    #[arg(long, value_name = "FILE.html")]
    record: Option<PathBuf>,
    #[command(flatten)]
    subject: Subject,
}

/// Rejects `--seeds`, which could be mistaken for the seeds of training runs.
fn renamed(_: &str) -> Result<String, String> {
    Err("this option is now called --episode-seeds".into())
}

#[derive(Serialize)]
struct Row {
    seed: u64,
    mode: Mode,
    spawn: Spawn,
    #[serde(flatten)]
    summary: EvalSummary,
    /// Mean time that a controller without weights computed per episode; absent for the learned one.
    #[serde(skip_serializing_if = "Option::is_none")]
    planning_ms: Option<f64>,
    wall_s: f64,
}

pub(crate) fn run(args: &EvalArgs, options: &CommonOptions) -> anyhow::Result<u8> {
    let output = options.output();
    args.record.as_deref().map_or(Ok(()), artifacts::check)?;
    let (trained, config) = args.subject.load()?;
    let vary = &args.subject.vary;
    let scheduler = vary.scheduler_of(&config);
    let modes = args.mode.unwrap_or(vary.controller.modes());
    let seeds = if args.episode_seeds.is_empty() { vec![config.run.seed] } else { args.episode_seeds.clone() };
    let spawns = layouts(config.task.spawn, args.per_layout)?;
    let threads = args.threads.unwrap_or_else(processors);
    let driver = match vary.controller {
        Controller::Learned => format!("executor {}", config.executor.kind),
        controller => format!("{controller} controller"),
    };
    let weights = match trained.sha256.get(..12) {
        Some(hash) => format!("weights {hash}"),
        None => "no weights".to_owned(),
    };
    let external = config.task.external().ok().map(|external| external.environment.clone());
    let goals = if external.is_some() { String::new() } else { format!(" · scheduler {scheduler}") };
    note(format!(
        "{} · {weights} · N = {} · {driver}{goals} · {} episodes per row",
        trained.name, config.task.agents, args.episodes
    ));

    let mut rows: Vec<Row> = Vec::new();
    let mut all: Vec<(Mode, Vec<EpisodeMetrics>)> = Vec::new();
    for &spawn in &spawns {
        for &seed in &seeds {
            let mut config = config.clone();
            (config.run.seed, config.task.spawn) = (seed, spawn);
            let (policy, planning) = args.subject.policy(&config, &trained.weights)?;
            for &mode in modes.list() {
                let clock = Instant::now();
                let record = u32::from(args.record.is_some() && rows.is_empty());
                let episodes = Episodes { count: args.episodes, set: args.subject.eval_set, mode, record };
                let (metrics, recordings) = roll_out(&policy, &config, episodes, threads)?;
                if let (Some(path), Some(recording)) = (&args.record, recordings.into_iter().next()) {
                    let subtitle = format!("{} · {} evaluation", artifacts::describe(&config), mode_name(mode));
                    let episode = [(recording, metrics.first().copied())];
                    artifacts::write_replay(path, &trained.name, &subtitle, &config, &episode)?;
                    note(format!("replay: {}", path.display()));
                }
                let planning_ms = planning.as_ref().map(|clock| clock.take_ms() / f64::from(args.episodes));
                if let Some(summary) = summarise(&metrics) {
                    let wall_s = clock.elapsed().as_secs_f64();
                    rows.push(Row { seed, mode, spawn, summary, planning_ms, wall_s });
                }
                all.push((mode, metrics));
            }
        }
    }

    let mut means = Map::new();
    let columns = METRICS.iter().filter(|metric| metric.applies(&config.task)).map(|metric| metric.label);
    let timed = rows.iter().any(|row| row.planning_ms.is_some());
    let starts = if external.is_some() { "environment" } else { "spawn" };
    let heading = [starts, "seed", "mode", "episodes"].into_iter().chain(columns);
    let heading: Vec<&str> = heading.chain(timed.then_some("planning ms")).collect();
    let mut table = Table::new(3, &heading);
    for row in &rows {
        let starts = external.clone().unwrap_or_else(|| row.spawn.to_string());
        let mut cells = cells(&config.task, [starts, row.seed.to_string()], row.mode, &row.summary);
        cells.extend(row.planning_ms.map(|ms| format!("{ms:.2}")));
        table.row(cells);
    }
    for &mode in modes.list() {
        let of_mode = all.iter().filter(|(m, _)| *m == mode).flat_map(|(_, metrics)| metrics);
        let Some(summary) = summarise(of_mode) else { continue };
        let planning_ms = planning_ms(&rows, mode);
        if rows.len() > modes.list().len() {
            let mut cells = cells(&config.task, ["all".into(), String::new()], mode, &summary);
            cells.extend(planning_ms.map(|ms| format!("{ms:.2}")));
            table.row(cells);
        }
        let mut mean = serde_json::to_value(summary)?;
        if let (Some(ms), Some(mean)) = (planning_ms, mean.as_object_mut()) {
            mean.insert("planning_ms".into(), json!(ms));
        }
        means.insert(mode_name(mode).into(), mean);
    }
    output.say(table.within(80).to_string());
    note(format!("{} with {threads} threads", seconds(rows.iter().map(|row| row.wall_s).sum())));
    output.result(&json!({
        "run": args.subject.run,
        "weights_sha256": (!trained.weights.is_empty()).then_some(&trained.sha256),
        "weights_final": trained.is_final,
        "warnings": trained.notes,
        "task": config.task.name,
        "agents": config.task.agents,
        "horizon": config.task.horizon,
        "executor": config.executor.kind,
        "scheduler": scheduler,
        "controller": vary.controller.to_string(),
        "eval_set": args.subject.eval_set,
        "rows": rows,
        "mean": means,
    }));
    Ok(exit::OK)
}

/// Mean over the rows of a mode, which have equally many episodes.
fn planning_ms(rows: &[Row], mode: Mode) -> Option<f64> {
    let of_mode: Vec<f64> = rows.iter().filter(|row| row.mode == mode).filter_map(|row| row.planning_ms).collect();
    (!of_mode.is_empty()).then(|| of_mode.iter().sum::<f64>() / of_mode.len() as f64)
}

fn layouts(spawn: Spawn, each: bool) -> anyhow::Result<Vec<Spawn>> {
    match spawn {
        _ if !each => Ok(vec![spawn]),
        Spawn::Lines(_) => Ok((0..4).map(|k| Spawn::Lines(Some(k))).collect()),
        Spawn::Authors(_) => Ok((0..4).map(|k| Spawn::Authors(Some(k))).collect()),
        Spawn::Uniform => Err(usage("--per-layout: the uniform spawn has no layouts; add --spawn lines or authors")),
    }
}

/// The numbers of a row: episodes, then the metrics of the task.
fn cells(task: &TaskConfig, [spawn, seed]: [String; 2], mode: Mode, summary: &EvalSummary) -> Vec<String> {
    let metrics = METRICS.iter().zip(summary.means).filter(|(metric, _)| metric.applies(task));
    let written = |metric: &Metric, mean: f64| metric.write_within(mean, task.horizon);
    let values = metrics.map(|(metric, mean)| mean.map_or_else(String::new, |mean| written(metric, mean)));
    [spawn, seed, mode_name(mode).into(), summary.episodes.to_string()].into_iter().chain(values).collect()
}
