//! `magex train --seeds`: one run after the other, each in a folder of its own.

use super::report::{Finished, say_stopped};
use super::{TrainArgs, prepare_process, read, train};
use crate::failure::usage;
use crate::folder;
use crate::output::{Output, Table, note, program, seconds, thousands};
use crate::training::continues;
use magex_core::metrics_table::{METRICS, SUCCESS_RATE};
use magex_learner::run_folder::{FolderError, RunFolderState};
use magex_runtime::exit;
use magex_stats::aggregate::{average, standard_deviation};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Trains every seed; the configurations and the folders of all are checked before the first one starts.
pub(super) fn run(args: &TrainArgs, output: Output) -> anyhow::Result<u8> {
    let seeds = &args.seeds;
    if let Some((_, twice)) = seeds.iter().enumerate().find(|(k, seed)| seeds[..*k].contains(seed)) {
        return Err(usage(format!("--seeds: {twice} is named twice; name every seed once")));
    }
    let out = match &args.out {
        Some(out) if args.resume && !out.exists() => {
            let remedy = "leave out --resume to start new runs";
            return Err(usage(format!("--out {} does not exist: {remedy}", out.display())));
        }
        Some(out) => out.clone(),
        None => free_folder(args)?,
    };
    let runs: Vec<TrainArgs> = seeds.iter().map(|&seed| of_seed(args, &out, seed)).collect();
    for run in &runs {
        read(run)?;
        check_folder(run)?;
    }
    let (runtime, interrupted) = prepare_process()?;
    let mut finished = Vec::new();
    for (k, run) in runs.iter().enumerate() {
        let started = Instant::now();
        let stopped = interrupted.is_cancelled();
        if !stopped {
            note(format!("seed {} ({} of {})", seeds[k], k + 1, runs.len()));
        }
        let end = if stopped { None } else { train(run, read(run)?, &runtime, &interrupted, started)?.ok() };
        let Some(one) = end else {
            runtime.shutdown_background();
            return Ok(say_stopped(&out, again(args, &out), output));
        };
        finished.push(one);
    }
    runtime.shutdown_background();
    report(&out, &finished, output);
    Ok(exit::OK)
}

/// This command with what makes it continue: seeds that have not begun need every option again.
fn again(args: &TrainArgs, out: &Path) -> String {
    let plain = |word: &str| word.chars().all(|c| c.is_ascii_alphanumeric() || "-_=./:,".contains(c));
    let quoted = |word: String| if plain(&word) { word } else { format!("'{}'", word.replace('\'', "'\\''")) };
    let mut words: Vec<String> = std::env::args().skip(1).map(quoted).collect();
    if !args.resume {
        words.push("--resume".into());
    }
    if !words.iter().any(|word| word == "--name" || word == "-o" || word.starts_with("--out")) {
        words.push(format!("--out {}", out.display()));
    }
    format!("{} {}", program(), words.join(" "))
}

/// The run of one seed. A seed whose run has begun continues; the weights that it began from are in its folder.
fn of_seed(args: &TrainArgs, out: &Path, seed: u64) -> TrainArgs {
    let folder = folder::of_seed(out, seed);
    let mut run = args.clone();
    run.seeds = Vec::new();
    run.overrides.seed = Some(seed);
    run.resume = args.resume && RunFolderState::of(&folder) != RunFolderState::Empty;
    if run.resume && continues(&folder) {
        (run.from, run.keep_optimiser) = (None, false);
    }
    run.out = Some(folder);
    run
}

/// `runs/<task>-<N>-<executor>`, with -2, -3, … if it is taken.
fn free_folder(args: &TrainArgs) -> anyhow::Result<PathBuf> {
    let mut first = args.clone();
    first.seeds = Vec::new();
    let name = folder::group_name(&read(&first)?.config);
    let mut number = 1u32;
    loop {
        let suffix = if number == 1 { String::new() } else { format!("-{number}") };
        let folder = Path::new(folder::RUNS).join(format!("{name}{suffix}"));
        if folder.symlink_metadata().is_err() {
            return Ok(folder);
        }
        number += 1;
    }
}

/// Fails where the run of a seed would, because something is in its folder.
fn check_folder(run: &TrainArgs) -> anyhow::Result<()> {
    let Some(folder) = run.out.as_deref().filter(|_| !run.resume) else { return Ok(()) };
    match RunFolderState::of(folder) {
        RunFolderState::Empty => Ok(()),
        state => Err(folder::refused(FolderError::Exists(folder.to_owned(), state))),
    }
}

/// A row for every seed, and their mean.
fn report(out: &Path, runs: &[Finished], output: Output) {
    let success = &METRICS[SUCCESS_RATE];
    let greedy = |run: &Finished| run.summary.episodes.greedy[SUCCESS_RATE].unwrap_or_default();
    let sampled = |run: &Finished| run.summary.episodes.sampled_success_rate.unwrap_or_default();
    let mut table = Table::new(1, &["seed", "greedy", "sampled", "joint steps", "training", "target"]);
    for run in runs {
        let s = &run.summary;
        table.row(vec![
            s.seed.to_string(),
            success.write(greedy(run)),
            success.write(sampled(run)),
            thousands(s.joint_env_steps as f64),
            seconds(s.wall_s),
            if s.target_reached { "reached" } else { "not reached" }.into(),
        ]);
    }
    let mut summary = serde_json::Map::new();
    let mut last = vec!["mean".to_owned()];
    for (name, of) in [("success_rate", &greedy as &dyn Fn(&Finished) -> f64), ("sampled_success_rate", &sampled)] {
        let values: Vec<f64> = runs.iter().map(of).collect();
        let (mean, deviation) = (average(&values), standard_deviation(&values));
        summary.insert(name.into(), json!({ "mean": mean, "standard_deviation": deviation }));
        last.push(success.write(mean));
    }
    let steps: Vec<f64> = runs.iter().map(|run| run.summary.joint_env_steps as f64).collect();
    last.push(thousands(average(&steps)));
    table.row(last);
    let episodes = runs.first().map_or(0, |run| run.summary.final_episodes);
    output.say(format!("\n{} runs, success on {episodes} episodes with unseen starts each:\n\n{table}", runs.len()));
    output.say(format!("\nNext:\n  {} compare {}", program(), out.display()));
    let values: Vec<&Value> = runs.iter().map(|run| &run.value).collect();
    output.result(&json!({ "out": out, "runs": values, "mean": summary }));
}
