//! The columns of the table, as many as the terminal has room for.

use super::Row;
use crate::output::thousands;
use magex_core::metrics_table::{
    ARRIVAL_STEP, COLLISIONS_PER_AGENT_STEP, COST_RATIO, METRICS, REWARD, SECOND_COST_RATIO, SUCCESS_RATE,
};

/// Space of a terminal that does not tell its size.
pub(super) const USUAL_WIDTH: usize = 80;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Column {
    Iteration,
    Steps,
    /// Of the greedy evaluation, or of the training episodes if only they have it.
    Metric(usize),
    /// Of the training episodes.
    Sampled(usize),
    Speed,
    /// Percent of the time for rollouts, executor update and commander update.
    Time,
}

/// What a narrow terminal does without, in this order.
const DISPENSABLE: [Column; 8] = [
    Column::Time,
    Column::Speed,
    Column::Metric(SECOND_COST_RATIO),
    Column::Metric(COST_RATIO),
    Column::Metric(ARRIVAL_STEP),
    Column::Metric(REWARD),
    Column::Metric(COLLISIONS_PER_AGENT_STEP),
    Column::Sampled(SUCCESS_RATE),
];

impl Column {
    /// The columns for these metrics that fit into `width` characters.
    pub(super) fn fitting(metrics: &[usize], width: usize) -> Vec<Self> {
        let mut columns = vec![Self::Iteration, Self::Steps];
        for &metric in metrics {
            columns.push(Self::Metric(metric));
            if metric == SUCCESS_RATE {
                columns.push(Self::Sampled(metric));
            }
        }
        columns.extend([Self::Speed, Self::Time]);
        for dispensable in DISPENSABLE {
            if columns.iter().map(|column| column.width() + 1).sum::<usize>() - 1 <= width {
                break;
            }
            columns.retain(|&column| column != dispensable);
        }
        columns
    }

    fn label(self) -> &'static str {
        match self {
            Self::Iteration => "iter",
            Self::Steps => "steps",
            Self::Metric(metric) => METRICS[metric].label,
            Self::Sampled(_) => "sampled",
            Self::Speed => "steps/s",
            Self::Time => "roll/exe/com %",
        }
    }

    fn width(self) -> usize {
        let least = match self {
            Self::Steps => 10,
            _ => 6,
        };
        if self == Self::Iteration { 4 } else { self.label().len().max(least) }
    }

    fn value(self, row: &Row, horizon: u32) -> String {
        let written = |metric: usize, value: Option<f64>| {
            value.map_or_else(|| "-".to_owned(), |value| METRICS[metric].write_within(value, horizon))
        };
        match self {
            Self::Iteration => row.iteration.to_string(),
            Self::Steps => thousands(row.joint_env_steps as f64),
            Self::Metric(metric) => written(metric, row.metric(metric)),
            Self::Sampled(metric) => written(metric, row.sampled(metric)),
            Self::Speed if row.executor.is_none() => "-".to_owned(),
            Self::Speed => thousands(row.joint_steps_per_s),
            Self::Time if row.executor.is_none() => "evaluation".to_owned(),
            Self::Time => {
                let [collect, update, commander, _] = row.timing.percent();
                format!("{collect:.0}/{update:.0}/{commander:.0}")
            }
        }
    }
}

pub(super) fn heading(columns: &[Column]) -> String {
    let cells = columns.iter().map(|column| format!("{:>1$}", column.label(), column.width()));
    cells.collect::<Vec<_>>().join(" ")
}

/// A row. `highlight` colours its success.
pub(super) fn line(row: &Row, columns: &[Column], horizon: u32, highlight: bool) -> String {
    let cells = columns.iter().map(|&column| {
        let cell = format!("{:>1$}", column.value(row, horizon), column.width());
        if highlight && column == Column::Metric(SUCCESS_RATE) { format!("\x1b[32m{cell}\x1b[0m") } else { cell }
    });
    cells.collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use magex_core::metrics_table::COLLISION_RATE;

    const SHOWN: [usize; 5] = [SUCCESS_RATE, ARRIVAL_STEP, COLLISIONS_PER_AGENT_STEP, COST_RATIO, REWARD];

    fn row(json: &str) -> Row {
        let rest = r#""timing":{"collect_s":3.0,"executor_s":6.0,"commander_s":1.0,"checkpoint_s":0.0},
            "joint_steps_per_s":1234.5,"wall_s":9.0}"#;
        serde_json::from_str(&format!("{json},{rest}")).unwrap()
    }

    #[test]
    fn a_line_of_the_metrics_file_becomes_a_row_below_its_heading() {
        let row = row(r#"{"iteration":12,"joint_env_steps":11520,"agent_steps":1,"success_rate":0.99996,
            "sampled_success_rate":0.97,"arrival_step":61.25,"collisions_per_agent_step":0.0123,"cost_ratio":1.0004,
            "reward":-0.25,"executor":{}"#);
        for (width, text) in [
            (100, "  12     11,520  0.9999  0.9700    61.2     0.0123 1.0004 -0.250   1,234       30/60/10"),
            (80, "  12     11,520  0.9999  0.9700    61.2     0.0123 1.0004 -0.250   1,234"),
            (60, "  12     11,520  0.9999  0.9700    61.2     0.0123 -0.250"),
            (50, "  12     11,520  0.9999  0.9700     0.0123 -0.250"),
            (10, "  12     11,520  0.9999"),
        ] {
            let columns = Column::fitting(&SHOWN, width);
            assert_eq!(line(&row, &columns, 120, false), text);
            assert_eq!(heading(&columns).len(), text.len());
        }
        let columns = Column::fitting(&SHOWN, 80);
        assert_eq!(heading(&columns), "iter      steps success sampled arrival collisions   cost reward steps/s");
        assert!(line(&row, &columns, 120, true).contains(" \x1b[32m 0.9999\x1b[0m "));
    }

    #[test]
    fn every_table_fits_into_80_and_60_columns_and_keeps_the_reward() {
        let drones = [SUCCESS_RATE, ARRIVAL_STEP, COLLISIONS_PER_AGENT_STEP, COLLISION_RATE, COST_RATIO, REWARD];
        let balls = [SUCCESS_RATE, ARRIVAL_STEP, COLLISIONS_PER_AGENT_STEP, COST_RATIO, SECOND_COST_RATIO, REWARD];
        for (metrics, width) in [(&drones, 80), (&balls, 80), (&drones, 60), (&balls, 60)] {
            let columns = Column::fitting(metrics, width);
            assert!(heading(&columns).len() <= width && columns.contains(&Column::Metric(REWARD)), "{columns:?}");
        }
    }

    #[test]
    fn missing_values_are_a_dash_and_an_arrival_after_the_horizon_is_never() {
        let row =
            row(r#"{"iteration":3,"joint_env_steps":10,"success_rate":null,"arrival_step":121.0,"executor":null"#);
        let text = line(&row, &Column::fitting(&SHOWN, 100), 120, false);
        assert_eq!(text, "   3         10       -       -   never          -      -      -       -     evaluation");
    }
}
