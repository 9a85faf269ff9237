//! `magex compare`

use crate::artifacts;
use crate::failure::usage;
use crate::options::CommonOptions;
use crate::output::{Table, note, thousands};
use crate::runs::{SeedRun, SystemRuns};
use crate::settings;
use magex_core::metrics_table::{METRICS, SUCCESS_RATE, share};
use magex_runtime::{exit, options as parse};
use magex_stats::aggregate::{average, iqm};
use magex_stats::bootstrap::{RESAMPLES, interval};
use magex_stats::{Interval, Scores, curves};
use magex_viewer::curve::systems::{Band, Panel, SystemCurve, systems_svg};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::PathBuf;

const AFTER_HELP: &str = "\
Examples:
  magex compare runs/a runs/b                 two runs
  magex compare runs/three-seeds runs/b       a folder of magex train --seeds counts as one system
  magex compare runs/* --csv all.csv --svg all.svg
  magex compare runs/a runs/b --target 0.99   steps to another success rate

greedy, sampled: success of the closing evaluation, mean over the seeds; of a run that is not complete, of its latest \
    evaluation. to X: joint steps until two evaluations in a row reach the target. IQM: interquartile mean over the seeds, \
    below four seeds their mean, with a 95 % bootstrap interval over the seeds.

Exit codes: 0 success, 1 a file of a run cannot be read, 64 wrong usage, no run folder or runs of different tasks, \
    73 a file cannot be written";

/// The seed of the bootstrap: intervals are the same whenever they are computed.
const SEED: u64 = 1;
/// Widest line of a table.
const WIDTH: usize = 80;
/// Longest value in the table of settings.
const VALUE: usize = 20;

/// Compare runs: settings that differ, success, steps to a target, curves.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct CompareArgs {
    /// Run folders, or folders with a run for every seed (seed-1, …).
    #[arg(value_name = "RUN", required = true)]
    runs: Vec<PathBuf>,
    /// Write one row per run as CSV.
    #[arg(long, value_name = "FILE.csv")]
    csv: Option<PathBuf>,
    /// Draw the learning curves: mean over the seeds, with a band from the lowest to the highest.
    #[arg(long, value_name = "FILE.svg")]
    svg: Option<PathBuf>,
    /// Greedy success rate that the steps are counted to.
    #[arg(long, value_name = "X", default_value_t = 0.95, value_parser = parse::number::<f32>(0.0, 1.0))]
    target: f32,
}

pub(crate) fn run(args: &CompareArgs, options: &CommonOptions) -> anyhow::Result<u8> {
    let output = options.output();
    for path in [&args.csv, &args.svg].into_iter().flatten() {
        artifacts::check(path)?;
    }
    let systems = read(args)?;
    let settings = systems.iter().map(SystemRuns::settings).collect::<anyhow::Result<Vec<_>>>()?;
    let keys = settings::differing(&settings);
    let target = magex_core::metrics_table::as_written(args.target.into());

    output.say(names(&systems));
    output.say(format!("\n{}", results(&systems, target)));
    match (keys.is_empty(), systems.len()) {
        (_, 1) => {}
        (true, _) => output.say("\nTheir settings are the same."),
        (false, _) => output.say(format!("\nSettings that differ:\n\n{}", differences(&keys, &settings))),
    }
    if let Some(path) = &args.csv {
        artifacts::write(path, csv(&systems, &keys, target)?.as_bytes())?;
        note(format!("table: {}", path.display()));
    }
    if let Some(path) = &args.svg {
        artifacts::write(path, picture(&systems)?.as_bytes())?;
        note(format!("curves: {}", path.display()));
    }
    let differing: BTreeMap<&String, Vec<Option<&String>>> =
        keys.iter().map(|key| (key, settings.iter().map(|one| one.get(key)).collect())).collect();
    let systems: Vec<Value> = systems.iter().map(|system| value(system, target)).collect();
    output.result(&json!({ "systems": systems, "target": target, "differing": differing }));
    Ok(exit::OK)
}

/// The systems, of one task and each named once.
fn read(args: &CompareArgs) -> anyhow::Result<Vec<SystemRuns>> {
    let mut systems: Vec<SystemRuns> = Vec::new();
    for path in &args.runs {
        let same = |other: &SystemRuns| other.folder.canonicalize().ok() == path.canonicalize().ok();
        if path.exists() && systems.iter().any(same) {
            return Err(usage(format!("RUN: {} is named twice", path.display())));
        }
        let system = SystemRuns::read(path)?;
        let task = |system: &SystemRuns| system.runs[0].config.task.name;
        if let Some(first) = systems.first().filter(|first| task(first) != task(&system)) {
            let (own, other) = (task(&system), task(first));
            let folder = first.folder.display();
            return Err(usage(format!(
                "RUN: {} is of {own}, {folder} of {other}; compare runs of one task",
                path.display()
            )));
        }
        systems.push(system);
    }
    // A name that two folders have tells nothing.
    let names: Vec<String> = systems.iter().map(|system| system.name.clone()).collect();
    for system in &mut systems {
        if names.iter().filter(|name| **name == system.name).count() > 1 {
            system.name = system.folder.display().to_string();
        }
    }
    Ok(systems)
}

/// A, B, …, Z, A2, B2, …
fn letter(place: usize) -> String {
    let letter = char::from(b'A' + (place % 26) as u8);
    if place < 26 { letter.to_string() } else { format!("{letter}{}", place / 26 + 1) }
}

/// What the letters stand for, and what is not complete.
fn names(systems: &[SystemRuns]) -> String {
    let mut lines = Vec::new();
    for (place, system) in systems.iter().enumerate() {
        let seeds: Vec<String> = system.runs.iter().map(|run| run.config.run.seed.to_string()).collect();
        let word = if seeds.len() == 1 { "seed" } else { "seeds" };
        lines.push(format!("  {}  {}, {word} {}", letter(place), system.folder.display(), seeds.join(", ")));
        for run in system.runs.iter().filter(|run| run.summary.is_none()) {
            let (steps, of) = (thousands(run.steps() as f64), thousands(run.config.run.max_steps as f64));
            lines.push(format!("     seed {} is unfinished: {steps} of {of} steps", run.config.run.seed));
        }
    }
    lines.join("\n")
}

fn results(systems: &[SystemRuns], target: f64) -> Table {
    let to = format!("to {target}");
    let heading = ["", "greedy", "sampled", "steps", &to, "IQM", "95 % interval", "state"];
    let mut table = Table::new(1, &heading);
    for (place, system) in systems.iter().enumerate() {
        let measured = Measured::of(system, target);
        let written = |value: Option<f64>| value.map_or_else(|| "–".into(), share);
        let interval = measured.interval.map_or_else(|| "–".into(), |i| format!("{} {}", share(i.low), share(i.high)));
        let done = system.runs.iter().filter(|run| run.summary.is_some()).count();
        let state = match (done, system.runs.len()) {
            (done, all) if done == all => "done".into(),
            (_, 1) => "unfinished".into(),
            (done, all) => format!("{done} of {all}"),
        };
        table.row(vec![
            letter(place),
            written(measured.greedy),
            written(measured.sampled),
            thousands(measured.steps),
            measured.to_target.map_or_else(|| "–".into(), thousands),
            written(measured.iqm),
            interval,
            state,
        ]);
    }
    table
}

/// The numbers of a system's row.
struct Measured {
    greedy: Option<f64>,
    sampled: Option<f64>,
    steps: f64,
    /// Mean over the seeds; `None` unless all reached it.
    to_target: Option<f64>,
    iqm: Option<f64>,
    interval: Option<Interval>,
}

impl Measured {
    fn of(system: &SystemRuns, target: f64) -> Self {
        let mean = |of: &dyn Fn(&SeedRun) -> Option<f64>| {
            let values: Option<Vec<f64>> = system.runs.iter().map(of).collect();
            values.map(|values| average(&values))
        };
        let greedy: Option<Vec<f64>> = system.runs.iter().map(|run| run.greedy(SUCCESS_RATE)).collect();
        let scores = greedy.and_then(|values| Scores::new(vec![values]).ok());
        Self {
            greedy: mean(&|run| run.greedy(SUCCESS_RATE)),
            sampled: mean(&SeedRun::sampled),
            steps: mean(&|run| Some(run.steps() as f64)).unwrap_or_default(),
            to_target: mean(&|run| run.steps_to(target).map(|steps| steps as f64)),
            iqm: scores.as_ref().map(iqm),
            interval: scores.as_ref().and_then(|scores| interval(scores, SEED, RESAMPLES, iqm)),
        }
    }
}

/// A row per key and a column per system, in as many tables as the width asks for.
fn differences(keys: &[String], settings: &[BTreeMap<String, String>]) -> String {
    let cell = |key: &String, system: usize| {
        let value = settings[system].get(key).map_or("–", |value| value.as_str());
        let value = if value.is_empty() { "\"\"" } else { value };
        let cut: String = value.chars().take(VALUE).collect();
        if cut.len() < value.len() { format!("{cut}…") } else { cut }
    };
    let table = |of: std::ops::Range<usize>| {
        let letters: Vec<String> = of.clone().map(letter).collect();
        let heading: Vec<&str> = std::iter::once("key").chain(letters.iter().map(String::as_str)).collect();
        let mut table = Table::new(1, &heading);
        for key in keys {
            table.row(std::iter::once(key.clone()).chain(of.clone().map(|system| cell(key, system))).collect());
        }
        table.to_string()
    };
    let fits = |text: &str| text.lines().all(|line| line.chars().count() <= WIDTH);
    let mut tables = Vec::new();
    let mut first = 0;
    while first < settings.len() {
        let most = (first + 1..=settings.len()).rev().find(|&end| fits(&table(first..end))).unwrap_or(first + 1);
        tables.push(table(first..most));
        first = most;
    }
    tables.join("\n\n")
}

fn value(system: &SystemRuns, target: f64) -> Value {
    let measured = Measured::of(system, target);
    let run = |run: &SeedRun| {
        json!({
            "folder": run.folder,
            "seed": run.config.run.seed,
            "finished": run.summary.is_some(),
            "joint_env_steps": run.steps(),
            "success_rate": run.greedy(SUCCESS_RATE),
            "sampled_success_rate": run.sampled(),
            "steps_to_target": run.steps_to(target),
            "wall_s": run.wall_s(),
        })
    };
    json!({
        "name": system.name,
        "runs": system.runs.iter().map(run).collect::<Vec<_>>(),
        "success_rate": measured.greedy,
        "sampled_success_rate": measured.sampled,
        "steps_to_target": measured.to_target,
        "iqm": measured.iqm,
        "interval": measured.interval.map(|interval| [interval.low, interval.high]),
    })
}

fn csv(systems: &[SystemRuns], keys: &[String], target: f64) -> anyhow::Result<String> {
    let mut rows = vec![
        "system,folder,seed,finished,joint_env_steps,success_rate,sampled_success_rate,collisions_per_agent_step,\
         collision_rate,steps_to_target,wall_s"
            .split(',')
            .map(str::to_owned)
            .chain(keys.iter().cloned())
            .collect::<Vec<_>>(),
    ];
    let number = |value: Option<f64>| value.map(|value| value.to_string()).unwrap_or_default();
    for system in systems {
        let settings = system.settings()?;
        for run in &system.runs {
            let [collisions, crashed] = run.collisions();
            let mut row = vec![
                system.name.clone(),
                run.folder.display().to_string(),
                run.config.run.seed.to_string(),
                run.summary.is_some().to_string(),
                run.steps().to_string(),
                number(run.greedy(SUCCESS_RATE)),
                number(run.sampled()),
                number(collisions),
                number(crashed),
                run.steps_to(target).map(|steps| steps.to_string()).unwrap_or_default(),
                number(Some(run.wall_s())),
            ];
            row.extend(keys.iter().map(|key| settings.get(key).cloned().unwrap_or_default()));
            rows.push(row);
        }
    }
    Ok(artifacts::csv(&rows))
}

fn picture(systems: &[SystemRuns]) -> anyhow::Result<String> {
    let success = &METRICS[SUCCESS_RATE];
    let panel = |title: &str, place: &str| Panel {
        title: title.to_owned(),
        curves: systems
            .iter()
            .map(|system| {
                let runs: Vec<Vec<[f64; 2]>> = system.runs.iter().map(|run| run.curve(place)).collect();
                let point = |p: &curves::BandPoint| Band { steps: p.x, mean: p.mean, low: p.low, high: p.high };
                let points = curves::band(&runs).iter().map(point).collect();
                SystemCurve { name: system.name.clone(), points, mark: None }
            })
            .collect(),
    };
    let panels = [
        panel("Success rate, greedy evaluation", success.name),
        panel("Success rate, sampled in training", success.sampled.unwrap_or(success.name)),
    ];
    let task = &systems[0].runs[0].config.task;
    let note = "Line: mean over the seeds. Band: from the lowest seed to the highest. A run that has ended keeps its last value.";
    Ok(systems_svg("Comparison of runs", task.definition().title, &panels, note)?)
}
