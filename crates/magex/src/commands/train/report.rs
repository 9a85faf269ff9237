//! What `magex train` says at the end.

use crate::folder;
use crate::output::{Output, program, seconds, thousands};
use crate::progress::Progress;
use crate::training::Plan;
use anyhow::Context as _;
use magex_core::config::RunConfig;
use magex_core::metrics_table::{METRICS, Metric, NEVER, SUCCESS_RATE};
use magex_learner::report::records::Summary;
use magex_runtime::exit;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Success of a run that has learned next to nothing.
const LITTLE: f64 = 0.1;

/// A run that is complete.
pub(super) struct Finished {
    pub(super) summary: Summary,
    /// The summary and what this command adds to it.
    pub(super) value: Value,
    config: RunConfig,
    folder: PathBuf,
    /// The budget before an option changed it.
    whole_budget: u64,
    command_s: f64,
    /// The option that names the environment, if there is one.
    environment: String,
}

impl Finished {
    pub(super) fn read(plan: &Plan, whole_budget: u64, started: Instant, progress: &Progress) -> anyhow::Result<Self> {
        let command_s = started.elapsed().as_secs_f64();
        // Until the last iteration was reported: the one that reached the target, if it was reached.
        let training_s = progress.last_iteration.map(|end| (end - started).as_secs_f64());
        let path = plan.folder.join(folder::SUMMARY);
        let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
        let mut value: Value = serde_json::from_str(&text).with_context(|| path.display().to_string())?;
        let summary: Summary = serde_json::from_str(&text).with_context(|| path.display().to_string())?;
        if let Value::Object(map) = &mut value {
            map.insert("command_wall_s".into(), json!(command_s));
            map.insert("target_wall_s".into(), json!(training_s));
            map.insert("out".into(), json!(plan.folder));
            map.insert("in_process".into(), json!(plan.means.actors.is_none()));
            map.insert("page".into(), json!(progress.page));
        }
        let (config, folder) = (plan.config.clone(), plan.folder.clone());
        let environment = environment(&plan.means.environment.1);
        Ok(Self { summary, value, config, folder, whole_budget, command_s, environment })
    }

    pub(super) fn report(&self, output: Output) -> u8 {
        let (s, horizon) = (&self.summary, self.config.task.horizon);
        let sampled = s.episodes.sampled_success_rate.map(|success| METRICS[SUCCESS_RATE].write(success));
        let metrics = METRICS.iter().zip(s.episodes.greedy).filter(|(metric, _)| metric.applies(&self.config.task));
        let row = |metric: &Metric, mean: f64| match metric.write_within(mean, horizon) {
            never if never == NEVER => (metric.label, never),
            value => (metric.label, format!("{value} {}", metric.unit)),
        };
        let mut rows: Vec<(&str, String)> = metrics.filter_map(|(metric, mean)| Some(row(metric, mean?))).collect();
        if let Some(sampled) = sampled {
            rows.insert(SUCCESS_RATE + 1, ("sampled", sampled));
        }
        rows.extend([
            ("joint env steps", format!("{} in {} iterations", thousands(s.joint_env_steps as f64), s.iterations)),
            ("training time", seconds(s.wall_s)),
            ("this command", seconds(self.command_s)),
        ]);
        let has_success = METRICS[SUCCESS_RATE].applies(&self.config.task);
        let why = match s.target_reached {
            true => "Done: target reached",
            false if self.config.run.target_success > 1.0 || !has_success => "Done: budget spent",
            false => "Budget spent before the target was reached",
        };
        output.say(format!("\n{why}.\nEvaluated on {} episodes with unseen starts:\n", s.final_episodes));
        for (name, value) in rows {
            output.say(format!("  {name:<16} {value}"));
        }
        // Beside its name it would be wider than 80 columns.
        output.say(format!("  SHA-256 of the weights:\n    {}", s.weights_sha256));
        if let Some(hint) = not_learned(&self.config, self.whole_budget, s) {
            output.say(format!("\n{hint}"));
        }
        let (magex, out) = (program(), self.folder.display());
        let with = &self.environment;
        output.say(format!("\nNext:\n  {magex} eval {out}{with}"));
        if !self.config.executor.kind.fixed_team_size() {
            output.say(format!("  {magex} eval {out} --agents {} --scheduler exact", 4 * self.config.task.agents));
        }
        let replay =
            if self.folder.join("replay.html").exists() { format!("{out}/replay.html and ") } else { String::new() };
        output.say(format!("  open {replay}{out}/curve.svg"));
        output.result(&self.value);
        exit::OK
    }
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

/// The option that names the environment, as a shell reads it; empty if there is none.
pub(super) fn environment(arguments: &[String]) -> String {
    arguments.get(1).map_or_else(String::new, |text| format!(" --environment '{}'", text.replace('\'', "'\\''")))
}

/// The command that continues a run.
pub(super) fn resume(out: &Path, environment: &str) -> String {
    format!("{} train --resume --out {}{environment}", program(), out.display())
}

/// Says how a run continues.
pub(super) fn say_stopped(out: &Path, command: String, output: Output) -> u8 {
    output.say(format!("\nStopped before the end. Continue with\n  {command}"));
    output.result(&json!({ "stopped": true, "out": out, "resume": command, "exit_code": exit::TEMPORARY }));
    exit::TEMPORARY
}
