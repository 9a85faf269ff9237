//! Whole runs, as a user would start them: `magex train` and `magex eval` as child processes.

use crate::report::Report;
use anyhow::{Context as _, bail};
use magex::failure::usage;
use magex::folder;
use magex::output::{note, seconds, share, thousands};
use magex::settings::named;
use magex_core::config::ExecutorKind;
use serde_json::{Value, json};
use std::os::unix::process::CommandExt as _;
use std::path::PathBuf;
use std::process::{Command, Stdio};

/// Where runs are kept, if they are.
#[derive(Debug, Clone, Default, clap::Args)]
pub(crate) struct Keep {
    /// Keep the run folders here [default: a temporary folder, removed at the end].
    #[arg(long, value_name = "DIR")]
    keep: Option<PathBuf>,
}

/// A folder for runs that cleans up after itself unless it is to be kept.
pub(crate) struct Place {
    pub(crate) path: PathBuf,
    temporary: bool,
}

impl Keep {
    pub(crate) fn place(&self) -> anyhow::Result<Place> {
        let own = || std::env::temp_dir().join(format!("magex-bench-{}", std::process::id()));
        let path = self.keep.clone().unwrap_or_else(own);
        std::fs::create_dir_all(&path)
            .map_err(|e| magex::failure::cannot_create(format!("{}: {e}", path.display())))?;
        Ok(Place { path, temporary: self.keep.is_none() })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        if self.temporary {
            let _ = std::fs::remove_dir_all(&self.path);
        }
    }
}

/// Runs `magex` and returns the JSON object that it prints.
pub(crate) fn magex(arguments: &[String]) -> anyhow::Result<Value> {
    let line = arguments.join(" ");
    // This executable contains `magex`, and behaves like it under that name.
    let output = Command::new(std::env::current_exe()?)
        .arg0("magex")
        .args(arguments)
        .arg("--json")
        .stdin(Stdio::null())
        .output()
        .with_context(|| format!("magex {line}"))?;
    let stdout = String::from_utf8_lossy(&output.stdout);
    let value: Value = serde_json::from_str(stdout.lines().last().unwrap_or_default()).unwrap_or_default();
    if !output.status.success() {
        let stderr = String::from_utf8_lossy(&output.stderr);
        bail!("magex {line}: {}: {}", output.status, stderr.lines().last().unwrap_or_default());
    }
    Ok(value)
}

/// A number of a JSON object.
pub(crate) fn number(value: &Value, key: &str) -> f64 {
    value[key].as_f64().unwrap_or(f64::NAN)
}

pub(crate) fn strings(parts: &[&str]) -> Vec<String> {
    parts.iter().map(|&part| part.to_owned()).collect()
}

/// Options of `distributed`.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct DistributedArgs {
    /// Configuration of the runs.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Executors.
    #[arg(long, value_name = "KIND,…", value_delimiter = ',', value_parser = named::<ExecutorKind>, default_value = "magex,local")]
    executors: Vec<ExecutorKind>,
    /// Joint steps of each run.
    #[arg(long, value_name = "M", default_value_t = 9600)]
    max_steps: u64,
    /// Actor processes.
    #[arg(long, value_name = "N", default_value_t = 2)]
    actors: usize,
    /// Pairs of runs; the median ratio counts.
    #[arg(long, value_name = "K", default_value_t = 3)]
    rounds: usize,
    #[command(flatten)]
    keep: Keep,
}

pub(crate) fn distributed(args: &DistributedArgs) -> anyhow::Result<Report> {
    let place = args.keep.place()?;
    let title = format!(
        "{} joint steps with services and {} actor processes against one process, all cores; median of {}",
        thousands(args.max_steps as f64),
        args.actors,
        args.rounds
    );
    let heading = ["executor", "in process", "services", "ratio", "command ratio", "same weights"];
    let mut report = Report::new("distributed", title, 1, &heading);
    for executor in &args.executors {
        let (mut pairs, mut same) = (Vec::new(), true);
        for round in 0..args.rounds {
            let run = |how: &str, more: &[String]| {
                let out = place.path.join(format!("{executor}-{how}-{round}")).display().to_string();
                let steps = args.max_steps.to_string();
                let mut line = strings(&["train", "--out", &out, "--max-steps", &steps, "--target-success", "2"]);
                line.extend(strings(&["--executor", &executor.to_string()]));
                line.extend_from_slice(more);
                line.extend(args.config.iter().map(|path| path.display().to_string()));
                magex(&line)
            };
            let alone = run("alone", &strings(&["--in-process"]))?;
            let services = run("services", &strings(&["--actors", &args.actors.to_string()]))?;
            same &= alone["weights_sha256"] == services["weights_sha256"] && alone["weights_sha256"].is_string();
            note(format!(
                "{executor} {}: {} in process, {} with services",
                round + 1,
                seconds(number(&alone, "wall_s")),
                seconds(number(&services, "wall_s"))
            ));
            pairs.push((alone, services));
        }
        let median = |of: &dyn Fn(&(Value, Value)) -> f64| {
            let mut all: Vec<f64> = pairs.iter().map(of).collect();
            all.sort_unstable_by(f64::total_cmp);
            all.get(all.len() / 2).copied().unwrap_or(f64::NAN)
        };
        let alone = median(&|(alone, _)| number(alone, "wall_s"));
        let services = median(&|(_, services)| number(services, "wall_s"));
        let ratio = median(&|(a, s)| number(s, "wall_s") / number(a, "wall_s"));
        let command = median(&|(a, s)| number(s, "command_wall_s") / number(a, "command_wall_s"));
        let cells = vec![
            executor.to_string(),
            seconds(alone),
            seconds(services),
            format!("{ratio:.3}"),
            format!("{command:.3}"),
            if same { "yes" } else { "NO" }.into(),
        ];
        let value = json!({
            "executor": executor, "in_process_s": alone, "services_s": services, "ratio": ratio,
            "command_ratio": command, "same_weights": same, "actors": args.actors, "max_steps": args.max_steps,
        });
        report.failed |= !same;
        report.row(cells, value);
    }
    report
        .notes
        .push("ratio: training alone. command ratio: from the command to its end, closing evaluation included.".into());
    Ok(report)
}

/// Options of `generalisation`.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct GeneralisationArgs {
    /// Run folders, for example of several seeds.
    #[arg(value_name = "RUN", required = true)]
    runs: Vec<PathBuf>,
    /// Team sizes.
    #[arg(long, value_name = "N,…", value_delimiter = ',', default_value = "20,50,100,200,1000")]
    agents: Vec<usize>,
    /// Episodes per run and size; a tenth of it for 1,000 agents and more.
    #[arg(long, value_name = "K", default_value_t = 100)]
    episodes: u32,
    /// Starts.
    #[arg(long, value_name = "MODE", default_value = "uniform")]
    spawn: String,
}

pub(crate) fn generalisation(args: &GeneralisationArgs) -> anyhow::Result<Report> {
    let title =
        format!("Other team sizes without training: density of N = 50, exact scheduler, greedy, {} starts", args.spawn);
    let heading = ["run", "N", "episodes", "success", "matched", "all covered", "arrival", "collisions"];
    let mut report = Report::new("generalisation", title, 1, &heading);
    for run in &args.runs {
        folder::config_of(run).map_err(|error| usage(format!("{error:#}")))?;
        for &agents in &args.agents {
            let episodes = if agents >= 1000 { args.episodes.div_ceil(10) } else { args.episodes };
            let (path, count, size) = (run.display().to_string(), episodes.to_string(), agents.to_string());
            let eval = magex(&strings(&[
                "eval",
                &path,
                "--agents",
                &size,
                "--episodes",
                &count,
                "--scheduler",
                "exact",
                "--mode",
                "greedy",
                "--spawn",
                &args.spawn,
            ]))?;
            let mean = &eval["mean"]["greedy"];
            let cells = vec![
                path,
                size,
                count,
                share(number(mean, "success_rate")),
                share(number(mean, "matched_success_rate")),
                share(number(mean, "all_covered_rate")),
                format!("{:.1}", number(mean, "arrival_step")),
                format!("{:.4}", number(mean, "collisions_per_agent_step")),
            ];
            report.row(cells, json!({ "run": run, "agents": agents, "mean": mean }));
        }
    }
    Ok(report)
}
