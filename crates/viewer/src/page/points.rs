//! The numbers behind the curves of the page, one row per line of metrics.jsonl.

use serde::Serialize;
use serde_json::Value;

/// Limit of stored rows: when it is exceeded, every other row is dropped. A drawn curve has fewer pixels.
const KEPT: usize = 2048;

/// Name of a column and where it is in a line.
const COLUMNS: [(&str, &str); 26] = [
    ("iteration", "/iteration"),
    ("joint_env_steps", "/joint_env_steps"),
    ("wall_s", "/wall_s"),
    ("success_rate", "/success_rate"),
    ("sampled_success_rate", "/sampled_success_rate"),
    ("reward", "/reward"),
    ("cost_ratio", "/cost_ratio"),
    ("sampled_cost_ratio", "/sampled_cost_ratio"),
    ("second_cost_ratio", "/second_cost_ratio"),
    ("collisions_per_agent_step", "/collisions_per_agent_step"),
    ("collision_rate", "/collision_rate"),
    ("arrival_step", "/arrival_step"),
    ("policy_loss", "/executor/policy_loss"),
    ("value_loss", "/executor/value_loss"),
    ("entropy", "/executor/entropy"),
    ("divergence", "/executor/divergence"),
    ("actor_grad_norm", "/executor/actor_grad_norm"),
    ("critic_grad_norm", "/executor/critic_grad_norm"),
    ("commander_loss", "/commander/loss"),
    ("commander_entropy", "/commander/entropy"),
    ("greedy_cost_ratio", "/commander/greedy_cost_ratio"),
    ("collect_s", "/timing/collect_s"),
    ("executor_s", "/timing/executor_s"),
    ("commander_s", "/timing/commander_s"),
    ("checkpoint_s", "/timing/checkpoint_s"),
    ("joint_steps_per_s", "/joint_steps_per_s"),
];

/// One line; missing values are NaN.
#[derive(Debug, Clone, Copy)]
struct Row {
    /// Number of the line, from 1.
    line: u64,
    values: [f32; COLUMNS.len()],
}

/// Part of a curve, ready to be sent. JSON has no NaN: it becomes null.
#[derive(Debug, Serialize)]
pub(super) struct Rows<'a> {
    /// Identity of the process that serves them.
    pub(super) process: &'a str,
    /// The rows behind this line.
    pub(super) after: u64,
    last: u64,
    columns: [&'static str; COLUMNS.len()],
    rows: Vec<[f32; COLUMNS.len()]>,
}

/// Rows in order.
#[derive(Debug, Default)]
pub(super) struct Points {
    rows: Vec<Row>,
    last: u64,
}

impl Points {
    /// Adds a line of metrics.jsonl.
    pub(super) fn push(&mut self, line: &Value) {
        self.last += 1;
        let value = |place: &str| line.pointer(place).and_then(Value::as_f64).map_or(f32::NAN, |x| x as f32);
        self.rows.push(Row { line: self.last, values: COLUMNS.map(|(_, place)| value(place)) });
        if self.rows.len() > KEPT {
            // From the newest backwards, so that the newest stays.
            let newest = self.rows.len() - 1;
            let mut index = 0;
            self.rows.retain(|_| {
                index += 1;
                (newest + 1 - index).is_multiple_of(2)
            });
        }
    }

    /// Number of the last line.
    pub(super) fn last(&self) -> u64 {
        self.last
    }

    /// The rows after a line.
    pub(super) fn after<'a>(&self, process: &'a str, after: u64) -> Rows<'a> {
        let from = self.rows.partition_point(|row| row.line <= after);
        let rows = self.rows[from..].iter().map(|row| row.values).collect();
        Rows { process, after, last: self.last, columns: COLUMNS.map(|(name, _)| name), rows }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn after(curve: &Points, line: u64) -> Value {
        serde_json::to_value(curve.after("this", line)).unwrap()
    }

    fn line(iteration: u64) -> Value {
        json!({ "iteration": iteration, "success_rate": null, "executor": { "entropy": 1.5 } })
    }

    #[test]
    fn rows_hold_what_a_line_says_and_null_for_the_rest() {
        let mut curve = Points::default();
        curve.push(&line(1));
        curve.push(&line(2));
        let all = after(&curve, 0);
        let column = |name: &str| COLUMNS.iter().position(|(n, _)| *n == name).unwrap();
        assert_eq!(all["rows"].as_array().unwrap().len(), 2);
        assert_eq!(all["rows"][1][column("iteration")], 2.0);
        assert_eq!(all["rows"][1][column("entropy")], 1.5);
        assert_eq!(all["rows"][1][column("success_rate")], Value::Null);
        assert_eq!(all["rows"][1][column("value_loss")], Value::Null);
        let news = after(&curve, 1);
        assert_eq!((news["rows"].as_array().unwrap().len(), &news["last"]), (1, &json!(2)));
        assert_eq!(after(&curve, 2)["rows"], json!([]));
        assert!(serde_json::to_string(&curve.after("this", 0)).unwrap().contains("[1.0,null,null,null"));
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
