//! Progress of a run: a table as wide as the terminal allows, with a live status line below it; log lines elsewhere.

mod columns;
mod live;

use crate::output::{colours, note};
use columns::{Column, heading, line};
pub(crate) use live::LiveLine;
use magex_core::config::{COLLISIONS_ANY, RETURN_ANY, RunConfig, RunSection};
use magex_core::metrics_table::{
    ARRIVAL_STEP, COLLISION_RATE, COLLISIONS_PER_AGENT_STEP, COST_RATIO, METRICS, REWARD, SECOND_COST_RATIO,
    SUCCESS_RATE, as_written,
};
use magex_core::task::TaskConfig;
use magex_learner::run_events::RunEvent;
use magex_runtime::telemetry;
use serde::Deserialize;
use serde_json::Value;
use std::io::IsTerminal as _;
use std::time::Instant;

/// Rows below a heading.
const PAGE: u32 = 40;

/// The part of a line of metrics.jsonl that is shown.
#[derive(Debug, Clone, Deserialize)]
struct Row {
    iteration: u32,
    joint_env_steps: u64,
    timing: Shares,
    joint_steps_per_s: f64,
    wall_s: f64,
    /// What the update of the executor reports; null on a line that does not train.
    executor: Option<serde::de::IgnoredAny>,
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
    /// On a terminal.
    live: Option<LiveLine>,
    /// Whether iterations have neither rows nor log lines.
    quiet: bool,
    /// Rows since the last heading, and the columns that it has.
    rows: u32,
    columns: Vec<Column>,
    target: f64,
    metrics: Vec<usize>,
    horizon: u32,
    colours: bool,
    /// Time at which the last iteration was reported.
    pub(crate) last_iteration: Option<Instant>,
    /// Address of the live page, if there is one.
    pub(crate) page: Option<String>,
}

impl Progress {
    pub(crate) fn start(config: &RunConfig, title: &str, out: &str) -> Self {
        let run = &config.run;
        let target = as_written(run.target_success.into());
        let shown = |row: &usize| METRICS[*row].progress && METRICS[*row].applies(&config.task);
        let mut progress = Self {
            live: None,
            quiet: false,
            rows: 0,
            columns: Vec::new(),
            target,
            metrics: (0..METRICS.len()).filter(shown).collect(),
            horizon: config.task.horizon,
            colours: false,
            last_iteration: None,
            page: None,
        };
        if !std::io::stderr().is_terminal() || telemetry::is_json() {
            tracing::info!(
                out,
                task = %config.task.name,
                agents = config.task.agents,
                spawn = %config.task.spawn,
                executor = %config.executor.kind,
                scheduler = %config.commander.kind,
                seed = run.seed,
                max_steps = run.max_steps,
                target_success = rounded(target),
                target_sampled_success = rounded(run.target_sampled_success.into()),
                target_collisions = rounded(run.target_collisions.into()),
                "training"
            );
            return progress;
        }
        progress.colours = colours();
        let [bold, plain] = if progress.colours { ["\x1b[1m", "\x1b[0m"] } else { [""; 2] };
        note(format!("{bold}{}{plain}", crate::artifacts::describe(config)));
        note(format!("{title} · {out}"));
        note(format!("{}\n", until(run, &config.task)));
        progress.live = Some(LiveLine::start(run.max_steps, config.steps_per_iteration()));
        progress
    }

    /// For one of many runs: only the status line, and only on a terminal.
    pub(crate) fn live_line(config: &RunConfig) -> Self {
        let terminal = std::io::stderr().is_terminal() && !telemetry::is_json();
        Self {
            live: terminal.then(|| LiveLine::start(config.run.max_steps, config.steps_per_iteration())),
            quiet: true,
            rows: 0,
            columns: Vec::new(),
            target: 0.0,
            metrics: Vec::new(),
            horizon: config.task.horizon,
            colours: false,
            last_iteration: None,
            page: None,
        }
    }

    /// The status line, if there is a terminal, for what reports shards within an iteration.
    pub(crate) fn live(&self) -> Option<LiveLine> {
        self.live.clone()
    }

    pub(crate) fn event(&mut self, event: &RunEvent) {
        match event {
            RunEvent::Iteration(report) => match serde_json::from_str::<Row>(&report.metrics_json) {
                Ok(row) => {
                    self.last_iteration = Some(Instant::now());
                    if !self.quiet {
                        self.row(&row);
                    }
                    if let Some(live) = &self.live {
                        let over = row.executor.is_none();
                        live.iteration(report.iterations_completed, report.joint_env_steps_trained, over);
                    }
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
        match &self.live {
            Some(_) => note(format!("live page: {url}\n")),
            None => tracing::info!(url, "live page"),
        }
        self.page = Some(url);
    }

    /// Words that stay in the status line, whatever is reported later.
    pub(crate) fn status(&self, text: &str) {
        if let Some(live) = &self.live {
            live.keep(text);
        }
    }

    pub(crate) fn end(&mut self) {
        if let Some(live) = self.live.take() {
            live.end();
        }
    }

    fn row(&mut self, row: &Row) {
        let Some(live) = &self.live else { return self.log(row) };
        let columns = Column::fitting(&self.metrics, live.width());
        if self.rows.is_multiple_of(PAGE) || columns != self.columns {
            let heading = heading(&columns);
            note(if self.colours { format!("\x1b[2m{heading}\x1b[0m") } else { heading });
            (self.rows, self.columns) = (0, columns);
        }
        self.rows += 1;
        let reached = row.metric(SUCCESS_RATE).is_some_and(|success| success >= self.target);
        note(line(row, &self.columns, self.horizon, reached && self.colours));
    }

    /// A log line has fixed fields: those worth following without the file.
    fn log(&self, row: &Row) {
        let [collect, update, commander, _] = row.timing.percent();
        let crashed = row.metric(COLLISION_RATE).filter(|_| self.metrics.contains(&COLLISION_RATE));
        tracing::info!(
            iteration = row.iteration,
            joint_env_steps = row.joint_env_steps,
            success_rate = row.metric(SUCCESS_RATE).map(rounded),
            sampled_success_rate = row.sampled(SUCCESS_RATE).map(rounded),
            reward = row.metric(REWARD).map(rounded),
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
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.end();
    }
}

/// What ends the run, in lines for 80 columns.
fn until(run: &RunSection, task: &TaskConfig) -> String {
    let budget = format!("{} joint steps", crate::output::thousands(run.max_steps as f64));
    let success = METRICS[SUCCESS_RATE].applies(task) && run.target_success <= 1.0;
    let mut goals = Vec::new();
    if run.target_return < RETURN_ANY {
        goals.push(format!("return {}{}", run.target_return, if success { " or" } else { "" }));
    }
    if !success {
        return match goals.first() {
            Some(goal) => format!("ends with {goal} twice in a row,\nor after {budget}"),
            None => format!("ends after {budget}"),
        };
    }
    goals.push(format!("success {}", run.target_success));
    if run.target_sampled_success > 0.0 {
        goals.push(format!("sampled {}", run.target_sampled_success));
    }
    if run.target_collisions < COLLISIONS_ANY {
        goals.push(format!("collisions {}", run.target_collisions));
    }
    format!("ends with {} twice in a row,\nor after {budget}", goals.join(", ").replace(" or,", " or"))
}

/// To four decimals, for log lines.
fn rounded(value: f64) -> f64 {
    (value * 1e4).round() / 1e4
}

#[cfg(test)]
mod tests {
    use super::*;
    use magex_core::task::Spawn;

    #[test]
    fn what_ends_a_run_is_said_first() {
        let mut run = RunSection { max_steps: 1_000_000, ..RunSection::default() };
        let task = TaskConfig::simple_spread(5, Spawn::Uniform);
        assert_eq!(until(&run, &task), "ends with success 0.995 twice in a row,\nor after 1,000,000 joint steps");
        (run.target_sampled_success, run.target_collisions) = (0.95, 0.05);
        let text = until(&run, &task);
        assert!(text.starts_with("ends with success 0.995, sampled 0.95, collisions 0.05 twice in a row,\n"));
        assert!(text.lines().all(|line| line.len() <= 80));
        run.target_success = 2.0;
        assert_eq!(until(&run, &task), "ends after 1,000,000 joint steps");
        run.target_return = 475.0;
        assert_eq!(until(&run, &task), "ends with return 475 twice in a row,\nor after 1,000,000 joint steps");
    }
}
