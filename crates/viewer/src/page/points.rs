//! The numbers behind the curves of the page, one row per line of metrics.jsonl.

use crate::plots::{self, LOG_FROM};
use magex_core::metrics_table::{Kind, Look, Scale};
use serde::Serialize;
use serde_json::{Value, json};

/// Limit of stored rows: when it is exceeded, every other row is dropped. A drawn curve has fewer pixels.
const KEPT: usize = 2048;

/// Columns without a plot: their name and where they are in a line.
const COLUMNS: [(&str, &str); 10] = [
    ("iteration", "iteration"),
    ("joint_env_steps", "joint_env_steps"),
    ("wall_s", "wall_s"),
    ("commander_entropy", "commander/entropy"),
    ("greedy_cost_ratio", "commander/greedy_cost_ratio"),
    ("collect_s", "timing/collect_s"),
    ("executor_s", "timing/executor_s"),
    ("commander_s", "timing/commander_s"),
    ("checkpoint_s", "timing/checkpoint_s"),
    ("joint_steps_per_s", "joint_steps_per_s"),
];

/// Every column and where it is in a line, as a JSON pointer.
fn columns() -> Vec<(&'static str, String)> {
    let plotted = plots::all().into_iter().flat_map(|plot| plot.series).map(|one| (one.column, one.place));
    COLUMNS.into_iter().chain(plotted).map(|(column, place)| (column, format!("/{place}"))).collect()
}

/// The plots as the page's script draws them, JSON.
pub(super) fn plots() -> String {
    let plots = plots::all().into_iter().map(|plot| {
        let scale = match plot.scale {
            Scale::Share => json!({ "low": 0, "high": 1, "share": true }),
            Scale::FromOne => json!({ "line": 1 }),
            Scale::FromZero => json!({ "zero": true }),
            Scale::Free => json!({}),
        };
        let series = plot.series.iter().map(|one| (one.column, one.kind.look()));
        let series: Vec<_> = series.map(|(column, Look { class, label, .. })| [column, label, class]).collect();
        let log = plot.log.then_some(LOG_FROM);
        json!({ "name": plot.id, "title": plot.title, "unit": plot.unit, "scale": scale, "log": log, "series": series })
    });
    Value::Array(plots.collect()).to_string()
}

/// The colours of the series as variables of a style sheet.
pub(super) fn colours(dark: bool) -> String {
    let looks = Kind::ALL.map(Kind::look).into_iter();
    looks
        .map(|look| format!("--{}: {};", look.class, if dark { look.dark } else { look.light }))
        .collect::<Vec<_>>()
        .join(" ")
}

/// One line; missing values are NaN.
#[derive(Debug, Clone)]
struct Row {
    /// Number of the line, from 1.
    line: u64,
    values: Vec<f32>,
}

/// Part of a curve, ready to be sent. JSON has no NaN: it becomes null.
#[derive(Debug, Serialize)]
pub(super) struct Rows<'a> {
    /// Identity of the process that serves them.
    pub(super) process: &'a str,
    /// The rows behind this line.
    pub(super) after: u64,
    last: u64,
    columns: Vec<&'static str>,
    rows: Vec<Vec<f32>>,
}

/// Rows in order.
#[derive(Debug)]
pub(super) struct Points {
    columns: Vec<(&'static str, String)>,
    rows: Vec<Row>,
    last: u64,
}

impl Default for Points {
    fn default() -> Self {
        Self { columns: columns(), rows: vec![], last: 0 }
    }
}

impl Points {
    pub(super) fn push(&mut self, line: &Value) {
        self.last += 1;
        let number = |value: Option<&Value>| value.and_then(Value::as_f64).map_or(f32::NAN, |x| x as f32);
        let values = self.columns.iter().map(|(_, place)| number(line.pointer(place))).collect();
        self.rows.push(Row { line: self.last, values });
        if self.rows.len() > KEPT {
            // From the newest backwards, so that the newest stays.
            self.rows = self.rows.drain(..).rev().step_by(2).collect();
            self.rows.reverse();
        }
    }

    pub(super) fn last(&self) -> u64 {
        self.last
    }

    /// The rows after a line.
    pub(super) fn after<'a>(&self, process: &'a str, after: u64) -> Rows<'a> {
        let from = self.rows.partition_point(|row| row.line <= after);
        let rows = self.rows[from..].iter().map(|row| row.values.clone()).collect();
        let columns = self.columns.iter().map(|(name, _)| *name).collect();
        Rows { process, after, last: self.last, columns, rows }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn after(curve: &Points, line: u64) -> Value {
        serde_json::to_value(curve.after("this", line)).unwrap()
    }

    fn line(iteration: u64) -> Value {
        json!({ "iteration": iteration, "success_rate": null, "reward": -0.5, "executor": { "entropy": 1.5 } })
    }

    #[test]
    fn rows_hold_what_a_line_says_and_null_for_the_rest() {
        let mut curve = Points::default();
        curve.push(&line(1));
        curve.push(&line(2));
        let all = after(&curve, 0);
        let column = |name: &str| all["columns"].as_array().unwrap().iter().position(|n| n == name).unwrap();
        assert_eq!(all["rows"].as_array().unwrap().len(), 2);
        assert_eq!(all["rows"][1][column("iteration")], 2.0);
        assert_eq!(all["rows"][1][column("entropy")], 1.5);
        assert_eq!(all["rows"][1][column("reward")], -0.5);
        assert_eq!(all["rows"][1][column("success_rate")], Value::Null);
        assert_eq!(all["rows"][1][column("value_loss")], Value::Null);
        let news = after(&curve, 1);
        assert_eq!((news["rows"].as_array().unwrap().len(), &news["last"]), (1, &json!(2)));
        assert_eq!(after(&curve, 2)["rows"], json!([]));
        assert!(serde_json::to_string(&curve.after("this", 0)).unwrap().contains("[1.0,null,null,null"));
        let plots: Value = serde_json::from_str(&plots()).unwrap();
        for name in plots.as_array().unwrap().iter().flat_map(|plot| plot["series"].as_array().unwrap()) {
            column(name[0].as_str().unwrap());
        }
    }

    #[test]
    fn a_long_run_is_thinned_and_keeps_its_ends() {
        let mut curve = Points::default();
        for iteration in 1..=100_000 {
            curve.push(&line(iteration));
            assert_eq!(curve.rows.last().unwrap().line, iteration);
        }
        assert!(curve.rows.len() <= KEPT && curve.rows.len() >= KEPT / 2);
        assert!(curve.rows[0].line < 100 && curve.rows.is_sorted_by_key(|row| row.line));
        assert_eq!(curve.after("this", 99_999).rows.len(), 1);
    }
}
