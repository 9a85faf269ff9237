//! The metrics of an episode, one row each: name, meaning, range and where it is displayed.
//!
//! Every consumer loops over [`METRICS`]: environments, the wire, validation, metrics.jsonl, summary.json, plots, pages and
//! tables. A new metric is a row here, the code that computes it, and a row in docs/metrics.md.

mod kind;

pub use kind::{Kind, Look};

/// A row of the table.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Metric {
    /// Its name on the wire, in files and in TensorBoard.
    pub name: &'static str,
    /// Unit of the value.
    pub unit: &'static str,
    /// What the unit counts. Over several episodes every metric is their mean.
    pub help: &'static str,
    /// Smallest and largest value that the learner accepts; every value is finite.
    pub range: [f32; 2],
    /// Which tasks have it.
    pub scope: Scope,
    /// Its column over an iteration's training episodes (sampled actions), if metrics.jsonl has one. If that column has the
    /// metric's own name, metrics.jsonl does not have the one of the greedy evaluation.
    pub sampled: Option<&'static str>,
    /// Heading of its column or plot.
    pub label: &'static str,
    /// How tables write a value.
    pub format: Format,
    /// Whether `magex train` has a column for it. (`magex eval` has one for every metric of the task.)
    pub progress: bool,
    /// Vertical axis of its plot in curve.svg and on the live page, if it has one.
    pub plot: Option<Scale>,
    /// What the head of its plot adds to the unit; empty for most.
    pub remark: &'static str,
    /// Whether a replay lists it beside the episode. (A replay computes arrival and collisions from the states.)
    pub replay: bool,
}

/// Which tasks have a metric. A task without it leaves it absent (NaN in an episode, null in JSON) or writes a constant, and
/// tables and plots leave it out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scope {
    /// All.
    EveryTask,
    /// Tasks with landmarks: all but external environments.
    Landmarks,
    /// Tasks that know a success: external environments may not.
    Success,
    /// External environments.
    External,
    /// Tasks whose agents can crash.
    Crashes,
    /// Tasks with a second assignment stage.
    SecondStage,
}

/// How a value is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// See [`share`].
    Share,
    /// Digits after the point.
    Decimals(usize),
}

/// How the vertical axis of a plot is chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scale {
    /// 0 to 1.
    Share,
    /// 0 to a little above the largest value.
    FromZero,
    /// 1 (or the smallest value, if that is less) to a little above the largest value.
    FromOne,
    /// The smallest to the largest value.
    Free,
}

/// What most rows have in common.
const SHARE: Metric = Metric {
    name: "",
    unit: "share of landmarks",
    help: "",
    range: [0.0, 1.0],
    scope: Scope::EveryTask,
    sampled: None,
    label: "",
    format: Format::Share,
    progress: false,
    plot: None,
    remark: "",
    replay: false,
};

/// Every metric of an episode, in the order of the wire and of metrics.jsonl.
pub const METRICS: &[Metric] = &[
    Metric {
        name: "success_rate",
        help: "covered at the last step: by an agent within 0.15, by a ball within 0.30 (Push Ball), by a drone within 0.15 \
               that has not crashed; external environments: 1 for an episode that the environment calls a success",
        scope: Scope::Success,
        sampled: Some("sampled_success_rate"),
        label: "success",
        progress: true,
        plot: Some(Scale::Share),
        replay: true,
        ..SHARE
    },
    Metric {
        name: "matched_success_rate",
        help: "matched one-to-one to what covers them at the last step; Push Ball: covered by their own ball",
        scope: Scope::Landmarks,
        label: "matched",
        replay: true,
        ..SHARE
    },
    Metric {
        name: "all_covered_rate",
        unit: "share of episodes",
        help: "1 if every landmark is covered at the last step, otherwise 0",
        scope: Scope::Landmarks,
        label: "all covered",
        ..SHARE
    },
    Metric {
        name: "arrival_step",
        unit: "steps",
        help: "first step after which at least 99 % of the landmarks were covered; the horizon + 1 if that never happened",
        range: [1.0, f32::MAX],
        scope: Scope::Landmarks,
        label: "arrival",
        format: Format::Decimals(1),
        progress: true,
        plot: Some(Scale::FromZero),
        remark: "never counts as horizon + 1",
        ..SHARE
    },
    Metric {
        name: "collisions_per_agent_step",
        unit: "per agent and step",
        help: "other agents closer than two radii; drones: agents that crashed",
        range: [0.0, f32::MAX],
        scope: Scope::Landmarks,
        sampled: Some("sampled_collisions_per_agent_step"),
        label: "collisions",
        format: Format::Decimals(4),
        progress: true,
        plot: Some(Scale::FromZero),
        ..SHARE
    },
    Metric {
        name: "collision_rate",
        unit: "share of agents",
        help: "crashed; 0 in tasks where nothing crashes",
        scope: Scope::Crashes,
        sampled: Some("sampled_collision_rate"),
        label: "crashed",
        format: Format::Decimals(4),
        progress: true,
        plot: Some(Scale::FromZero),
        replay: true,
        ..SHARE
    },
    Metric {
        name: "spawn_success_rate",
        help: "covered before the first step: the success of a team that does nothing",
        scope: Scope::Landmarks,
        label: "at spawn",
        replay: true,
        ..SHARE
    },
    Metric {
        name: "cost_ratio",
        help: "C_c / C_h, at the start of the episode: summed distance of the commander's assignment over that of the exact \
               one, from agents to their (first) goals",
        scope: Scope::Landmarks,
        sampled: Some("sampled_cost_ratio"),
        label: "cost",
        ..COST
    },
    Metric {
        name: "second_cost_ratio",
        help: "C_c / C_h of the second stage, from balls to landmarks; null in tasks with one assignment",
        scope: Scope::SecondStage,
        label: "second cost",
        ..COST
    },
    Metric {
        name: "reward",
        unit: "per agent and step",
        help: "mean reward",
        range: [f32::MIN, f32::MAX],
        sampled: Some("reward"),
        label: "reward",
        format: Format::Decimals(3),
        progress: true,
        plot: Some(Scale::Free),
        replay: true,
        ..SHARE
    },
    Metric {
        name: "episode_return",
        unit: "per agent",
        help: "sum of the rewards of the first episode of a world, mean over the agents (external environments)",
        range: [f32::MIN, f32::MAX],
        scope: Scope::External,
        sampled: Some("sampled_episode_return"),
        label: "return",
        format: Format::Decimals(2),
        progress: true,
        plot: Some(Scale::Free),
        ..SHARE
    },
    Metric {
        name: "episode_length",
        unit: "steps",
        help: "steps of the first episode of a world, at most the horizon (external environments)",
        range: [0.0, f32::MAX],
        scope: Scope::External,
        sampled: Some("sampled_episode_length"),
        label: "length",
        format: Format::Decimals(1),
        progress: true,
        plot: Some(Scale::FromZero),
        ..SHARE
    },
];

/// What both cost ratios have in common.
const COST: Metric = Metric {
    unit: "ratio",
    range: [0.0, f32::MAX],
    format: Format::Decimals(4),
    progress: true,
    plot: Some(Scale::FromOne),
    replay: true,
    ..SHARE
};

/// How tables write an arrival after the horizon.
pub const NEVER: &str = "never";

/// Row of the metric that decides when a run stops.
pub const SUCCESS_RATE: usize = row("success_rate");
/// Row of the one-to-one matched share.
pub const MATCHED_SUCCESS_RATE: usize = row("matched_success_rate");
/// Row of the share of completely covered episodes.
pub const ALL_COVERED_RATE: usize = row("all_covered_rate");
/// Row of the arrival step.
pub const ARRIVAL_STEP: usize = row("arrival_step");
/// Row of the contacts.
pub const COLLISIONS_PER_AGENT_STEP: usize = row("collisions_per_agent_step");
/// Row of the crashed share.
pub const COLLISION_RATE: usize = row("collision_rate");
/// Row of the share that the spawn covers.
pub const SPAWN_SUCCESS_RATE: usize = row("spawn_success_rate");
/// Row of the first stage's cost ratio.
pub const COST_RATIO: usize = row("cost_ratio");
/// Row of the second stage's cost ratio.
pub const SECOND_COST_RATIO: usize = row("second_cost_ratio");
/// Row of the reward.
pub const REWARD: usize = row("reward");
/// Row of the return of an episode.
pub const EPISODE_RETURN: usize = row("episode_return");
/// Row of the length of an episode.
pub const EPISODE_LENGTH: usize = row("episode_length");

/// Row of a name; a name without a row does not compile.
const fn row(name: &str) -> usize {
    let mut row = 0;
    while !same(METRICS[row].name.as_bytes(), name.as_bytes()) {
        row += 1;
    }
    row
}

/// `==` of slices is not const yet.
const fn same(a: &[u8], b: &[u8]) -> bool {
    let mut at = 0;
    while at < a.len() && at < b.len() && a[at] == b[at] {
        at += 1;
    }
    at == a.len() && at == b.len()
}

impl Metric {
    /// Whether metrics.jsonl and summary.json have it of the greedy evaluation.
    pub fn greedy(&self) -> bool {
        self.sampled != Some(self.name)
    }

    /// Its columns in metrics.jsonl, and what each is of.
    pub fn series(&self) -> impl Iterator<Item = (&'static str, Kind)> {
        let greedy = self.greedy().then_some((self.name, Kind::Greedy));
        greedy.into_iter().chain(self.sampled.map(|column| (column, Kind::Sampled)))
    }

    /// A value as tables show it, in a task with this horizon: an arrival after it never happened.
    pub fn write_within(&self, value: f64, horizon: u32) -> String {
        let never = self.name == METRICS[ARRIVAL_STEP].name && value > f64::from(horizon);
        if never { NEVER.to_owned() } else { self.write(value) }
    }

    /// A value as tables show it.
    pub fn write(&self, value: f64) -> String {
        match self.format {
            Format::Share => share(value),
            Format::Decimals(digits) => format!("{value:.digits$}"),
        }
    }
}

/// A mean of single-precision numbers as the shortest decimal number that is the same in single precision: 0.69 in place of
/// 0.6900000135600567. What a mean has beyond that is rounding.
pub fn as_written(mean: f64) -> f64 {
    (mean as f32).to_string().parse().unwrap_or(mean)
}

/// A share between 0 and 1: four decimals, and never rounded up to 1.
pub fn share(value: f64) -> String {
    if value < 1.0 { format!("{:.4}", value.min(0.9999)) } else { format!("{value:.4}") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::task::{TaskConfig, TaskName};
    use std::collections::BTreeSet;

    #[test]
    fn columns_of_metrics_jsonl_have_different_names() {
        let columns: Vec<&str> = METRICS.iter().flat_map(Metric::series).map(|(column, _)| column).collect();
        assert_eq!(columns.iter().collect::<BTreeSet<_>>().len(), columns.len(), "{columns:?}");
        assert_eq!(METRICS[SECOND_COST_RATIO].name, "second_cost_ratio");
        assert!(METRICS.iter().all(|metric| metric.range[0] <= 1.0 && 1.0 <= metric.range[1]), "fixtures are 1");
    }

    #[test]
    fn the_documentation_has_a_row_for_every_metric() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/metrics.md");
        let text = std::fs::read_to_string(path).unwrap();
        let section = text.split("\n## ").find(|section| section.starts_with("Metrics of an episode")).unwrap();
        let table: Vec<&str> = section.lines().filter(|line| line.starts_with("| `")).collect();
        let expected: Vec<String> = METRICS
            .iter()
            .map(|metric| {
                let greedy = if metric.greedy() { "yes" } else { "no" };
                let sampled = metric.sampled.map_or("no".to_owned(), |name| format!("`{name}`"));
                format!("| `{}` | {} | {} | {greedy} | {sampled} |", metric.name, metric.unit, metric.help)
            })
            .collect();
        assert_eq!(table, expected, "docs/metrics.md must have these rows:\n{}", expected.join("\n"));
    }

    #[test]
    fn tasks_have_the_metrics_of_their_scope() {
        use crate::task::Spawn;
        let without = |name| {
            let task = TaskConfig::of(name, 5, Spawn::Uniform);
            METRICS.iter().filter(|m| !m.applies(&task)).map(|m| m.name).collect::<Vec<_>>()
        };
        let own = ["episode_return", "episode_length"];
        assert_eq!(without(TaskName::SimpleSpread), [&["collision_rate", "second_cost_ratio"], &own[..]].concat());
        assert_eq!(without(TaskName::PushBall), [&["collision_rate"], &own[..]].concat());
        assert_eq!(without(TaskName::Drones), [&["second_cost_ratio"], &own[..]].concat());
        assert!(without(TaskName::External).iter().all(|name| !own.contains(name) && *name != "reward"));
    }
}
