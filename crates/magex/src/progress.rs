//! How a run shows itself while it goes: a table with a live status line on a terminal, log lines elsewhere.

use crate::logging::set_live_line;
use crate::output::{colours, note, share, thousands};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use magex_core::config::RunConfig;
use magex_learner::run_events::RunEvent;
use serde::Deserialize;
use std::io::IsTerminal as _;
use std::time::{Duration, Instant};

/// Rows between two headings of the table.
const PAGE: u32 = 40;

/// One line of metrics.jsonl, as far as it is shown.
#[derive(Debug, Clone, PartialEq, Deserialize)]
struct Row {
    iteration: u32,
    joint_env_steps: u64,
    success_rate: Option<f64>,
    sampled_success_rate: Option<f64>,
    arrival_step: Option<f64>,
    collisions_per_agent_step: Option<f64>,
    collision_rate: Option<f64>,
    cost_ratio: Option<f64>,
    second_cost_ratio: Option<f64>,
    timing: Shares,
    joint_steps_per_s: f64,
    wall_s: f64,
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

/// Shows a run.
pub(crate) struct Progress {
    bar: Option<ProgressBar>,
    rows: u32,
    target: f64,
    /// Agents of the task can crash.
    crashes: bool,
    colours: bool,
    last_iteration: Option<Instant>,
    page: Option<String>,
}

impl Progress {
    /// Announces the run.
    pub(crate) fn start(config: &RunConfig, title: &str, out: &str) -> Self {
        let target = f64::from(config.run.target_success);
        let crashes = config.task.crashes();
        let terminal = std::io::stderr().is_terminal();
        if !terminal {
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
            return Self { bar: None, rows: 0, target, crashes, colours: false, last_iteration: None, page: None };
        }
        let colours = colours();
        let [bold, plain] = if colours { ["\x1b[1m", "\x1b[0m"] } else { [""; 2] };
        note(format!("{bold}{}{plain}", crate::artifacts::describe(config)));
        note(format!("{title} · {out}\n"));
        let bar = ProgressBar::with_draw_target(Some(config.run.max_steps), ProgressDrawTarget::stderr_with_hz(10));
        let template = "{spinner:.cyan} {bar:20.cyan/dim} {human_pos} of {human_len} joint steps · {msg} · {elapsed}";
        if let Ok(style) = ProgressStyle::with_template(template) {
            bar.set_style(style.progress_chars("━━─"));
        }
        bar.set_message("waiting for the first iteration");
        bar.enable_steady_tick(Duration::from_millis(100));
        set_live_line(Some(bar.clone()));
        Self { bar: Some(bar), rows: 0, target, crashes, colours, last_iteration: None, page: None }
    }

    /// Something happened.
    pub(crate) fn event(&mut self, event: &RunEvent) {
        match event {
            RunEvent::Iteration(report) => match serde_json::from_str::<Row>(&report.metrics_json) {
                Ok(row) => {
                    self.last_iteration = Some(Instant::now());
                    self.row(&row);
                }
                Err(error) => tracing::warn!(%error, "metrics of an iteration cannot be read"),
            },
            RunEvent::Log(text) => tracing::info!("{text}"),
            RunEvent::Checkpoint { iteration, path } => tracing::debug!(%iteration, path, "checkpoint"),
            RunEvent::Finished { .. } => self.status("finished"),
        }
    }

    /// When the last iteration was reported: the one that reached the target, if it was reached.
    pub(crate) fn last_iteration(&self) -> Option<Instant> {
        self.last_iteration
    }

    /// Says where the live page is.
    pub(crate) fn page(&mut self, address: &str) {
        let url = format!("http://{address}/");
        match &self.bar {
            Some(_) => note(format!("live page: {url}\n")),
            None => tracing::info!(url, "live page"),
        }
        self.page = Some(url);
    }

    /// Where the live page is, or was.
    pub(crate) fn page_url(&self) -> Option<&str> {
        self.page.as_deref()
    }

    /// Text of the status line.
    pub(crate) fn status(&self, text: &str) {
        if let Some(bar) = &self.bar {
            bar.set_message(text.to_owned());
        }
    }

    /// Takes the status line away.
    pub(crate) fn end(&mut self) {
        set_live_line(None);
        if let Some(bar) = self.bar.take() {
            bar.finish_and_clear();
        }
    }

    fn row(&mut self, row: &Row) {
        let [collect, update, commander, checkpoint] = row.timing.percent();
        let Some(bar) = &self.bar else {
            tracing::info!(
                iteration = row.iteration,
                joint_env_steps = row.joint_env_steps,
                success = row.success_rate.map(rounded),
                sampled_success = row.sampled_success_rate.map(rounded),
                arrival_step = row.arrival_step.map(rounded),
                collisions_per_agent_step = row.collisions_per_agent_step.map(rounded),
                collision_rate = row.collision_rate.filter(|_| self.crashes).map(rounded),
                cost_ratio = row.cost_ratio.map(rounded),
                second_cost_ratio = row.second_cost_ratio.map(rounded),
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
            let heading = heading(self.crashes);
            note(if self.colours { format!("\x1b[2m{heading}\x1b[0m") } else { heading });
        }
        self.rows += 1;
        let reached = row.success_rate.is_some_and(|success| success >= self.target);
        note(line(row, [collect, update, commander, checkpoint], self.crashes, reached && self.colours));
        bar.set_position(row.joint_env_steps);
        let next = if row.sampled_success_rate.is_none() {
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

fn heading(crashes: bool) -> String {
    format!(
        "{:>5} {:>10} {:>8} {:>8} {:>8} {:>10} {:>7} {:>8}  {}",
        "iter",
        "steps",
        "success",
        "sampled",
        "arrival",
        if crashes { "crashed" } else { "collisions" },
        "cost",
        "steps/s",
        "time: collect update commander"
    )
}

fn line(row: &Row, percent: [f64; 4], crashes: bool, highlight: bool) -> String {
    let cell = |value: Option<f64>, show: &dyn Fn(f64) -> String| value.map_or_else(|| "-".to_owned(), show);
    let success = format!("{:>8}", cell(row.success_rate, &share));
    let success = if highlight { format!("\x1b[32m{success}\x1b[0m") } else { success };
    let speed = if row.sampled_success_rate.is_some() { thousands(row.joint_steps_per_s) } else { "-".to_owned() };
    let times = if row.sampled_success_rate.is_some() {
        format!("{:>11.0} % {:>4.0} % {:>7.0} %", percent[0], percent[1], percent[2])
    } else {
        "      evaluation only".to_owned()
    };
    format!(
        "{:>5} {:>10} {success} {:>8} {:>8} {:>10} {:>7} {speed:>8}  {times}",
        row.iteration,
        thousands(row.joint_env_steps as f64),
        cell(row.sampled_success_rate, &share),
        cell(row.arrival_step, &|x| format!("{x:.1}")),
        cell(row.collision_rate.filter(|_| crashes).or(row.collisions_per_agent_step), &|x| format!("{x:.4}")),
        cell(row.cost_ratio, &|x| format!("{x:.4}")),
    )
}

/// To four decimals, for log lines.
fn rounded(value: f64) -> f64 {
    (value * 1e4).round() / 1e4
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_of_the_metrics_file_becomes_a_row_below_its_heading() {
        let json = r#"{"iteration":12,"joint_env_steps":11520,"agent_steps":1,"success_rate":0.99996,
            "sampled_success_rate":0.97,"arrival_step":61.25,"collisions_per_agent_step":0.0123,"cost_ratio":1.0004,
            "timing":{"collect_s":3.0,"executor_s":6.0,"commander_s":1.0,"checkpoint_s":0.0},
            "joint_steps_per_s":1234.5,"wall_s":9.0}"#;
        let row: Row = serde_json::from_str(json).unwrap();
        let text = line(&row, row.timing.percent(), false, false);
        assert_eq!(
            text,
            "   12     11,520   0.9999   0.9700     61.2     0.0123  1.0004    1,234           30 %   60 %      10 %"
        );
        let heading = heading(false);
        assert_eq!(heading.find("success").unwrap() + 7, text.find("0.9999").unwrap() + 6);
        assert_eq!(heading.len(), "    iter".len() - 3 + text.len() - 5);
    }

    #[test]
    fn what_was_not_measured_is_a_dash() {
        let json = r#"{"iteration":3,"joint_env_steps":10,"success_rate":null,"sampled_success_rate":null,
            "arrival_step":null,"collisions_per_agent_step":null,"cost_ratio":null,
            "timing":{"collect_s":0,"executor_s":0,"commander_s":0,"checkpoint_s":0},"joint_steps_per_s":0,"wall_s":1}"#;
        let row: Row = serde_json::from_str(json).unwrap();
        assert!(line(&row, row.timing.percent(), false, true).contains(" - "));
    }
}
