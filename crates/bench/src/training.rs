//! `train`: the result table, every team size, executor and seed trained and evaluated.

use crate::report::Report;
use crate::runs::{Keep, magex, number, strings};
use magex::output::{note, seconds, share, thousands};
use magex::settings::named;
use magex_core::config::ExecutorKind;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Options of `train`.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct TrainArgs {
    /// Configuration of every run; team size, executor and seed are overridden.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Folder with spread-N-EXECUTOR.toml or spread-N.toml; without a file, the defaults
    #[arg(long, value_name = "DIR", default_value = "deploy/configs")]
    configs: PathBuf,
    /// Team sizes.
    #[arg(long, value_name = "N,…", value_delimiter = ',', default_value = "50,20,5")]
    agents: Vec<usize>,
    /// Executors.
    #[arg(long, value_name = "KIND,…", value_delimiter = ',', value_parser = named::<ExecutorKind>, default_value = "magex,local")]
    executors: Vec<ExecutorKind>,
    /// Seeds.
    #[arg(long, value_name = "S,…", value_delimiter = ',', default_value = "1,2,3")]
    seeds: Vec<u64>,
    /// Episodes of each evaluation.
    #[arg(long, value_name = "K", default_value_t = 100)]
    episodes: u32,
    /// Budget in joint steps [default: the configuration's].
    #[arg(long, value_name = "M")]
    max_steps: Option<u64>,
    /// Train to the end of the budget.
    #[arg(long)]
    whole_budget: bool,
    /// Train in one process.
    #[arg(long)]
    in_process: bool,
    #[command(flatten)]
    keep: Keep,
}

/// The configuration for a size and executor, if there is one.
fn config_for(folder: &Path, agents: usize, executor: ExecutorKind) -> Option<PathBuf> {
    [format!("spread-{agents}-{executor}.toml"), format!("spread-{agents}.toml")]
        .map(|name| folder.join(name))
        .into_iter()
        .find(|path| path.is_file())
}

pub(crate) fn train(args: &TrainArgs) -> anyhow::Result<Report> {
    let place = args.keep.place()?;
    let title = format!(
        "Training, then {} unseen episodes per seed; seeds {:?}; {}",
        args.episodes,
        args.seeds,
        if args.in_process { "one process" } else { "services and two actor processes" }
    );
    let heading = [
        "executor",
        "N",
        "joint steps",
        "to target",
        "success",
        "all covered",
        "sampled",
        "arrival",
        "scripted",
        "collisions",
        "cost",
    ];
    let mut report = Report::new("train", title, 1, &heading);
    for &agents in &args.agents {
        for &executor in &args.executors {
            let (mut runs, mut evals, mut yardsticks) = (Vec::new(), Vec::new(), Vec::new());
            for &seed in &args.seeds {
                let out = place.path.join(format!("{agents}-{executor}-s{seed}")).display().to_string();
                let seed = seed.to_string();
                let mut line = strings(&["train", "--out", &out, "--seed", &seed, "--agents", &agents.to_string()]);
                line.extend(strings(&["--executor", &executor.to_string()]));
                let config = args.config.clone().or_else(|| config_for(&args.configs, agents, executor));
                line.extend(config.map(|path| path.display().to_string()));
                line.extend(args.max_steps.into_iter().flat_map(|steps| strings(&["--max-steps", &steps.to_string()])));
                line.extend(args.whole_budget.then(|| strings(&["--target-success", "2"])).into_iter().flatten());
                line.extend(args.in_process.then(|| "--in-process".to_owned()));
                let run = magex(&line)?;
                let count = args.episodes.to_string();
                let eval = magex(&strings(&["eval", &out, "--episodes", &count]))?;
                yardsticks.push(magex(&strings(&[
                    "eval",
                    &out,
                    "--episodes",
                    &count,
                    "--controller",
                    "scripted",
                    "--scheduler",
                    "exact",
                ]))?);
                note(format!(
                    "N = {agents}, {executor}, seed {seed}: {} steps, {}, success {}",
                    thousands(number(&run, "joint_env_steps")),
                    seconds(number(&run, "target_wall_s")),
                    share(number(&eval["mean"]["greedy"], "success_rate"))
                ));
                runs.push(run);
                evals.push(eval);
            }
            let mean =
                |all: &[Value], get: &dyn Fn(&Value) -> f64| all.iter().map(get).sum::<f64>() / all.len().max(1) as f64;
            let worst =
                |all: &[Value], get: &dyn Fn(&Value) -> f64| all.iter().map(get).fold(f64::NEG_INFINITY, f64::max);
            let greedy = |key: &'static str| mean(&evals, &move |e| number(&e["mean"]["greedy"], key));
            let sampled = mean(&evals, &|e| number(&e["mean"]["sampled"], "success_rate"));
            let scripted = mean(&yardsticks, &|e| number(&e["mean"]["greedy"], "arrival_step"));
            let (steps, wall) =
                (worst(&runs, &|r| number(r, "joint_env_steps")), worst(&runs, &|r| number(r, "target_wall_s")));
            let reached = runs.iter().all(|run| run["target_reached"] == true);
            let cells = vec![
                executor.to_string(),
                agents.to_string(),
                thousands(steps),
                if reached { seconds(wall) } else { format!("({})", seconds(wall)) },
                share(greedy("success_rate")),
                share(greedy("all_covered_rate")),
                share(sampled),
                format!("{:.1}", greedy("arrival_step")),
                format!("{scripted:.1}"),
                format!("{:.4}", greedy("collisions_per_agent_step")),
                format!("{:.4}", greedy("cost_ratio")),
            ];
            let value = json!({ "agents": agents, "executor": executor, "runs": runs, "evaluations": evals, "scripted": yardsticks });
            report.row(cells, value);
        }
    }
    report.notes.push(
        "joint steps and time to target are the worst seed's, the rest are means. \
         scripted: arrival step of the scripted controller with exact goals."
            .into(),
    );
    Ok(report)
}
