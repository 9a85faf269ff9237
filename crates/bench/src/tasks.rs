//! `tasks`: Push Ball and the drones trained with their configurations, then evaluated on their own and on other starts.

use crate::report::Report;
use crate::runs::{Keep, magex, number, strings};
use magex::failure::usage;
use magex::output::{note, seconds, share, thousands};
use magex::settings::named;
use magex_core::config::ExecutorKind;
use magex_core::metrics_table::{METRICS, SUCCESS_RATE};
use serde_json::{Value, json};
use std::path::PathBuf;

/// Options of `tasks`.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct TasksArgs {
    /// Tasks: push-ball-5, push-ball-20, drones-2, drones-4.
    #[arg(
        long,
        value_name = "NAME,…",
        value_delimiter = ',',
        default_value = "push-ball-5,push-ball-20,drones-2,drones-4"
    )]
    tasks: Vec<String>,
    /// Folder with TASK.toml
    #[arg(long, value_name = "DIR", default_value = "deploy/configs")]
    configs: PathBuf,
    /// Executors.
    #[arg(long, value_name = "KIND,…", value_delimiter = ',', value_parser = named::<ExecutorKind>, default_value = "magex,local")]
    executors: Vec<ExecutorKind>,
    /// Seeds.
    #[arg(long, value_name = "S,…", value_delimiter = ',', default_value = "1,2,3")]
    seeds: Vec<u64>,
    /// Episodes of each evaluation.
    #[arg(long, value_name = "K", default_value_t = 100)]
    episodes: u32,
    #[command(flatten)]
    keep: Keep,
}

/// What a task's weights are evaluated on: name, options of `magex eval`, and how much of the mean over starts it is.
type Variant = (&'static str, &'static str, f64);

const TASKS: [(&str, &[Variant]); 4] = [
    ("push-ball-5", &[("own starts", "", 0.0), ("N = 20", "--agents 20", 0.0), ("N = 50", "--agents 50", 0.0)]),
    (
        "push-ball-20",
        &[
            ("uniform", "--spawn uniform", 1.0),
            ("four layouts, jittered", "--spawn lines --per-layout", 4.0),
            ("four layouts, unjittered", "--spawn authors --per-layout", 4.0),
        ],
    ),
    ("drones-2", &[("assigned goals", "", 0.0), ("random goals", "--scheduler random", 0.0)]),
    (
        "drones-4",
        &[
            ("assigned goals", "", 0.0),
            ("random goals", "--scheduler random", 0.0),
            ("N = 2", "--agents 2", 0.0),
            ("N = 6", "--agents 6", 0.0),
            ("N = 8", "--agents 8", 0.0),
        ],
    ),
];

pub(crate) fn tasks(args: &TasksArgs) -> anyhow::Result<Report> {
    let place = args.keep.place()?;
    let title = format!(
        "Training with services and two actor processes, then {} unseen greedy episodes per seed; seeds {:?}",
        args.episodes, args.seeds
    );
    let shown = || METRICS.iter().filter(|metric| metric.greedy());
    let heading: Vec<&str> = ["task", "executor", "measured on", "joint steps", "wall", "worst seed"]
        .into_iter()
        .chain(shown().map(|metric| metric.label))
        .collect();
    let mut report = Report::new("tasks", title, 3, &heading);
    for task in &args.tasks {
        let variants = TASKS.iter().find(|(name, _)| name == task).map(|(_, variants)| *variants);
        let Some(variants) = variants else {
            return Err(usage(format!(
                "--tasks: '{task}' is not one of push-ball-5, push-ball-20, drones-2, drones-4"
            )));
        };
        let config = args.configs.join(format!("{task}.toml")).display().to_string();
        for &executor in &args.executors {
            let (mut runs, mut folders) = (Vec::new(), Vec::new());
            for &seed in &args.seeds {
                let out = place.path.join(format!("{task}-{executor}-s{seed}")).display().to_string();
                let (seed, kind) = (seed.to_string(), executor.to_string());
                let run = magex(&strings(&["train", &config, "--out", &out, "--seed", &seed, "--executor", &kind]))?;
                note(format!(
                    "{task}, {executor}, seed {seed}: {} steps, {}, success {}",
                    thousands(number(&run, "joint_env_steps")),
                    seconds(number(&run, "target_wall_s")),
                    share(number(&run, "success_rate"))
                ));
                runs.push(run);
                folders.push(out);
            }
            let worst = |key: &str| runs.iter().map(|r| number(r, key)).fold(f64::NEG_INFINITY, f64::max);
            let (steps, wall) = (worst("joint_env_steps"), worst("target_wall_s"));
            let (mut mean, mut weight) = (0.0, 0.0);
            for &(name, options, part) in variants {
                let count = args.episodes.to_string();
                let evaluations = folders
                    .iter()
                    .map(|out| {
                        let line = ["eval", out, "--episodes", &count, "--mode", "greedy"];
                        let line = line.into_iter().chain(options.split_whitespace());
                        magex(&strings(&line.collect::<Vec<_>>()))
                    })
                    .collect::<anyhow::Result<Vec<Value>>>()?;
                let greedy = |e: &Value, key: &str| number(&e["mean"]["greedy"], key);
                let average = |key: &str| {
                    evaluations.iter().map(|e| greedy(e, key)).sum::<f64>() / evaluations.len().max(1) as f64
                };
                let success = METRICS[SUCCESS_RATE].name;
                let lowest = evaluations.iter().map(|e| greedy(e, success)).fold(f64::INFINITY, f64::min);
                (mean, weight) = (mean + part * average(success), weight + part);
                let mut cells = vec![
                    task.clone(),
                    executor.to_string(),
                    name.to_owned(),
                    thousands(steps),
                    seconds(wall),
                    share(lowest),
                ];
                cells.extend(shown().map(|metric| match average(metric.name) {
                    absent if absent.is_nan() => String::new(),
                    value => metric.write(value),
                }));
                report.row(
                    cells,
                    json!({
                        "task": task, "executor": executor, "measured_on": name, "joint_env_steps": steps,
                        "wall_s": wall, "worst_success_rate": lowest, "runs": runs, "evaluations": evaluations,
                    }),
                );
            }
            if weight > 0.0 {
                report.notes.push(format!(
                    "{task}, {executor}: {:.4} success over uniform, four jittered and four unjittered layouts",
                    mean / weight
                ));
            }
        }
    }
    report.notes.push("joint steps and wall time are the worst seed's, the rest are means over the seeds".into());
    Ok(report)
}

#[cfg(test)]
mod tests {
    use super::*;
    use magex::settings;
    use std::path::Path;

    #[test]
    fn every_task_has_its_configuration() {
        for (task, variants) in TASKS {
            let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/configs").join(format!("{task}.toml"));
            let config = settings::read(Some(&path)).unwrap();
            assert_eq!(task, format!("{}-{}", config.task.name, config.task.agents));
            assert!(!variants.is_empty());
        }
    }
}
