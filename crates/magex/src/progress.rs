//! Progress of a run: a table (80 columns for Simple Spread) with a live status line on a terminal, log lines elsewhere.

use crate::logging::set_live_line;
use crate::output::{colours, note, thousands};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use magex_core::config::RunConfig;
use magex_core::metrics_table::{
    ARRIVAL_STEP, COLLISION_RATE, COLLISIONS_PER_AGENT_STEP, COST_RATIO, METRICS, SECOND_COST_RATIO, SUCCESS_RATE,
    as_written,
};
use magex_learner::run_events::RunEvent;
use magex_runtime::telemetry;
use serde::Deserialize;
use serde_json::Value;
use std::io::IsTerminal as _;
use std::time::{Duration, Instant};

const PAGE: u32 = 40;

/// The part of a line of metrics.jsonl that is shown.
#[derive(Debug, Clone, PartialEq, Deserialize)]
struct Row {
    iteration: u32,
    joint_env_steps: u64,
    timing: Shares,
    joint_steps_per_s: f64,
    wall_s: f64,
    /// The columns of the episodes' metrics, among others.
    #[serde(flatten)]
    columns: serde_json::Map<String, Value>,
}

impl Row {
    /// A metric under its name in metrics.jsonl.
    fn metric(&self, metric: usize) -> Option<f64> {
        self.columns.get(METRICS[metric].name)?.as_f64()
    }

    fn sampled(&self, metric: usize) -> Option<f64> {
        self.columns.get(METRICS[metric].sampled?)?.as_f64()
    }
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
struct Shares {
    collect_s: f64,
    executor_s: f64,
    commander_s: f64,
    checkpoint_s: f64,
}

impl Shares {
    /// Percent of the iteration: collect, update, commander, checkpoint.
    fn percent(&self) -> [f64; 4] {
        let all = [self.collect_s, self.executor_s, self.commander_s, self.checkpoint_s];
        let total = all.iter().sum::<f64>().max(1e-9);
        all.map(|seconds| 100.0 * seconds / total)
    }
}

pub(crate) struct Progress {
    bar: Option<ProgressBar>,
    rows: u32,
    target: f64,
    metrics: Vec<usize>,
    colours: bool,
    /// Time at which the last iteration was reported.
    pub(crate) last_iteration: Option<Instant>,
    /// Address of the live page, if there is one.
    pub(crate) page: Option<String>,
}

impl Progress {
    pub(crate) fn start(config: &RunConfig, title: &str, out: &str) -> Self {
        let target = as_written(config.run.target_success.into());
        let shown = |row: &usize| METRICS[*row].progress && METRICS[*row].applies(&config.task);
        let metrics = (0..METRICS.len()).filter(shown).collect();
        let mut progress =
            Self { bar: None, rows: 0, target, metrics, colours: false, last_iteration: None, page: None };
        if !std::io::stderr().is_terminal() || telemetry::is_json() {
            tracing::info!(
                out,
                task = %config.task.name,
                agents = config.task.agents,
                spawn = %config.task.spawn,
                executor = %config.executor.kind,
                scheduler = %config.commander.kind,
                seed = config.run.seed,
                max_steps = config.run.max_steps,
                target_success = rounded(target),
                "training"
            );
            return progress;
        }
        progress.colours = colours();
        let [bold, plain] = if progress.colours { ["\x1b[1m", "\x1b[0m"] } else { [""; 2] };
        note(format!("{bold}{}{plain}", crate::artifacts::describe(config)));
        note(format!("{title} · {out}\n"));
        let bar = ProgressBar::with_draw_target(Some(config.run.max_steps), ProgressDrawTarget::stderr_with_hz(10));
        let template = "{spinner:.cyan} {bar:12.cyan/dim} {human_pos}/{human_len} steps · {msg} · {elapsed}";
        if let Ok(style) = ProgressStyle::with_template(template) {
            bar.set_style(style.progress_chars("━━─"));
        }
        bar.set_message("waiting for the first iteration");
        bar.enable_steady_tick(Duration::from_millis(100));
        set_live_line(Some(bar.clone()));
        progress.bar = Some(bar);
        progress
    }

    pub(crate) fn event(&mut self, event: &RunEvent) {
        match event {
            RunEvent::Iteration(report) => match serde_json::from_str::<Row>(&report.metrics_json) {
                Ok(row) => {
                    self.last_iteration = Some(Instant::now());
                    self.row(&row);
                }
                Err(error) => tracing::warn!(%error, "the metrics of an iteration are malformed"),
            },
            RunEvent::Log(text) => tracing::info!("{text}"),
            RunEvent::Checkpoint(e) => tracing::debug!(iteration = e.iteration, path = e.path, "checkpoint"),
            RunEvent::Finished(_) => self.status("finished"),
        }
    }

    pub(crate) fn page(&mut self, address: &str) {
        let url = format!("http://{address}/");
        match &self.bar {
            Some(_) => note(format!("live page: {url}\n")),
            None => tracing::info!(url, "live page"),
        }
        self.page = Some(url);
    }

    pub(crate) fn status(&self, text: &str) {
        if let Some(bar) = &self.bar {
            bar.set_message(text.to_owned());
        }
    }

    pub(crate) fn end(&mut self) {
        set_live_line(None);
        if let Some(bar) = self.bar.take() {
            bar.finish_and_clear();
        }
    }

    fn row(&mut self, row: &Row) {
        let [collect, update, commander, checkpoint] = row.timing.percent();
        let Some(bar) = &self.bar else {
            // A log line has fixed fields: those worth following without the file.
            let crashed = row.metric(COLLISION_RATE).filter(|_| self.metrics.contains(&COLLISION_RATE));
            tracing::info!(
                iteration = row.iteration,
                joint_env_steps = row.joint_env_steps,
                success_rate = row.metric(SUCCESS_RATE).map(rounded),
                sampled_success_rate = row.sampled(SUCCESS_RATE).map(rounded),
                arrival_step = row.metric(ARRIVAL_STEP).map(rounded),
                collisions_per_agent_step = row.metric(COLLISIONS_PER_AGENT_STEP).map(rounded),
                collision_rate = crashed.map(rounded),
                cost_ratio = row.metric(COST_RATIO).map(rounded),
                second_cost_ratio = row.metric(SECOND_COST_RATIO).map(rounded),
                steps_per_s = row.joint_steps_per_s.round(),
                collect_percent = collect.round(),
                update_percent = update.round(),
                commander_percent = commander.round(),
                wall_s = rounded(row.wall_s),
                "iteration"
            );
            return;
        };
        if self.rows.is_multiple_of(PAGE) {
            let heading = heading(&self.metrics);
            note(if self.colours { format!("\x1b[2m{heading}\x1b[0m") } else { heading });
        }
        self.rows += 1;
        let reached = row.metric(SUCCESS_RATE).is_some_and(|success| success >= self.target);
        note(line(row, [collect, update, commander, checkpoint], &self.metrics, reached && self.colours));
        bar.set_position(row.joint_env_steps);
        let next = if row.sampled(SUCCESS_RATE).is_none() {
            "closing evaluation".into()
        } else {
            format!("iteration {}", row.iteration + 1)
        };
        bar.set_message(next);
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.end();
    }
}

fn width(metric: usize) -> usize {
    METRICS[metric].label.len().max(6)
}

/// The last column: percent of the time for rollouts, executor update and commander update.
fn heading(metrics: &[usize]) -> String {
    let mut text = format!("{:>4} {:>10}", "iter", "steps");
    for &metric in metrics {
        text += &format!(" {:>1$}", METRICS[metric].label, width(metric));
        if metric == SUCCESS_RATE {
            text += &format!(" {:>7}", "sampled");
        }
    }
    text + &format!(" {:>7} roll/exe/com %", "steps/s")
}

fn line(row: &Row, percent: [f64; 4], metrics: &[usize], highlight: bool) -> String {
    let cell = |metric: usize, value: Option<f64>| {
        let text = value.map_or_else(|| "-".to_owned(), |value| METRICS[metric].write(value));
        format!("{text:>0$}", width(metric))
    };
    let mut text = format!("{:>4} {:>10}", row.iteration, thousands(row.joint_env_steps as f64));
    for &metric in metrics {
        let value = cell(metric, row.metric(metric));
        let highlight = highlight && metric == SUCCESS_RATE;
        text += &if highlight { format!(" \x1b[32m{value}\x1b[0m") } else { format!(" {value}") };
        if metric == SUCCESS_RATE {
            text += &format!(" {}", cell(metric, row.sampled(metric)));
        }
    }
    let (speed, times) = match row.sampled(SUCCESS_RATE) {
        Some(_) => (thousands(row.joint_steps_per_s), format!("{:.0}/{:.0}/{:.0}", percent[0], percent[1], percent[2])),
        None => ("-".to_owned(), "evaluation".to_owned()),
    };
    text + &format!(" {speed:>7} {times}")
}

/// To four decimals, for log lines.
fn rounded(value: f64) -> f64 {
    (value * 1e4).round() / 1e4
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHOWN: [usize; 4] = [SUCCESS_RATE, ARRIVAL_STEP, COLLISIONS_PER_AGENT_STEP, COST_RATIO];

    #[test]
    fn a_line_of_the_metrics_file_becomes_a_row_below_its_heading() {
        let json = r#"{"iteration":12,"joint_env_steps":11520,"agent_steps":1,"success_rate":0.99996,
            "sampled_success_rate":0.97,"arrival_step":61.25,"collisions_per_agent_step":0.0123,"cost_ratio":1.0004,
            "timing":{"collect_s":3.0,"executor_s":6.0,"commander_s":1.0,"checkpoint_s":0.0},
            "joint_steps_per_s":1234.5,"wall_s":9.0}"#;
        let row: Row = serde_json::from_str(json).unwrap();
        let text = line(&row, row.timing.percent(), &SHOWN, false);
        assert_eq!(text, "  12     11,520  0.9999  0.9700    61.2     0.0123 1.0004   1,234 30/60/10");
        let heading = heading(&SHOWN);
        for (word, value) in [("success", "0.9999"), ("cost", "1.0004"), ("steps/s", "1,234")] {
            assert_eq!(heading.find(word).unwrap() + word.len(), text.find(value).unwrap() + value.len(), "{word}");
        }
        assert!(heading.len() <= 80 && text.len() <= 80);
    }

    #[test]
    fn missing_values_are_shown_as_a_dash() {
        let json = r#"{"iteration":3,"joint_env_steps":10,"success_rate":null,"sampled_success_rate":null,
            "arrival_step":null,"collisions_per_agent_step":null,"cost_ratio":null,
            "timing":{"collect_s":0,"executor_s":0,"commander_s":0,"checkpoint_s":0},"joint_steps_per_s":0,"wall_s":1}"#;
        let row: Row = serde_json::from_str(json).unwrap();
        assert!(line(&row, row.timing.percent(), &SHOWN, true).contains(" - "));
    }
}
