//! `tables.md`, `tables.csv` and what the command prints.

use super::budget::{Budget, BudgetName};
use super::summary::{Measured, OverSeeds, THRESHOLDS, aggregates};
use super::systems::PaperTable;
use crate::artifacts;
use crate::output::{Table, seconds, thousands};
use magex_stats::Interval;
use std::fmt::Write as _;

/// A share with three decimals, never rounded up to 1.
fn share(value: f64) -> String {
    if value < 1.0 { format!("{:.3}", value.min(0.999)) } else { format!("{value:.3}") }
}

fn optional(value: Option<String>) -> String {
    value.unwrap_or_else(|| "–".into())
}

/// `0.998 (0.002)`: mean and standard deviation.
fn spread(value: OverSeeds) -> String {
    format!("{} ({})", share(value.mean), optional(value.deviation.map(|deviation| format!("{deviation:.3}"))))
}

fn ends(interval: Option<Interval>) -> String {
    optional(interval.map(|interval| format!("[{}, {}]", share(interval.low), share(interval.high))))
}

fn paper([mean, deviation]: [f64; 2]) -> String {
    format!("{mean:.2} ({deviation:.2})")
}

/// What is printed: a row per cell, in 80 columns. A system has the name that `--systems` takes.
pub(crate) fn printed(measured: &[Measured]) -> Table {
    let mut table = Table::new(2, &["table", "system", "N", "greedy", "sampled", "paper", "steps", "ended by"]);
    for one in measured {
        table.row(vec![
            one.cell.table.name.into(),
            one.cell.system.id.into(),
            one.cell.agents().to_string(),
            optional(one.greedy().map(|value| share(value.mean))),
            optional(one.sampled().map(|value| share(value.mean))),
            optional(one.paper().map(|paper| format!("{:.2}", paper.success[0]))),
            thousands(one.steps()),
            one.ended_by(),
        ]);
    }
    table
}

/// A row of a Markdown table.
fn row(text: &mut String, cells: &[String]) {
    // Writing to a string cannot fail.
    let _ = writeln!(text, "| {} |", cells.join(" | "));
}

fn heading(text: &mut String, names: &[&str]) {
    let names: Vec<String> = names.iter().map(|&name| name.to_owned()).collect();
    row(text, &names);
    row(text, &vec!["---".to_owned(); names.len()]);
}

/// Every table with its statistics as Markdown. `missing` counts what was not measured.
pub(crate) fn markdown(budget: &Budget, tables: &[(&'static PaperTable, Vec<Measured>)], missing: usize) -> String {
    let mut text = String::from("# The paper's tables, reproduced\n\n");
    let seeds: Vec<String> = budget.seeds.iter().map(u64::to_string).collect();
    let name = format!("{:?}", budget.name).to_lowercase();
    let _ = writeln!(
        text,
        "Written by `magex reproduce --budget {name}`: training seeds {}, {} episodes per seed and mode on starts that training \
         never saw.",
        seeds.join(", "),
        budget.episodes
    );
    if budget.name == BudgetName::Smoke {
        text += "This budget shows that everything works; its numbers mean nothing.\n";
    }
    text += "Success: share of landmarks that are reached at the end of an episode.\n\
        \"Mean (standard deviation)\" is over the means of the seeds, with n − 1; a single seed has none.\n\
        IQM is the interquartile mean; below four numbers it is their mean.\n\
        Brackets: 95 % interval of the stratified percentile bootstrap over the seeds.\n\
        Arrival: first step after which (almost) all landmarks were covered, mean over the greedy episodes; the horizon + 1 \
        counts where that never happened.\n\
        Planning: wall time per episode in a controller without weights.\n\
        Steps: joint environment steps trained on, mean over the seeds; what ended the training stands beside it.\n\
        Converged: seeds that reached the target, or whose mean greedy success of the last quarter of the \
        evaluations differs by less than 0.01 from that of the quarter before; a dash: fewer than 8 evaluations.\n";
    if missing > 0 {
        let _ = writeln!(text, "{missing} trainings of this budget are not measured and are left out.");
    }
    for (table, measured) in tables.iter().filter(|(_, measured)| !measured.is_empty()) {
        let _ = write!(text, "\n## {}\n\nThe paper: {}.\n\n", table.title, table.source);
        cells(&mut text, measured);
        statistics(&mut text, table, measured);
    }
    text
}

fn cells(text: &mut String, measured: &[Measured]) {
    let crashes = measured.iter().any(|one| one.collisions().is_some());
    let mut names = vec!["system", "N", "greedy", "IQM", "sampled", "paper"];
    if crashes {
        names.extend(["collisions", "paper, collisions"]);
    }
    names.extend(["arrival", "steps", "ended by", "converged", "training"]);
    let plans = measured.iter().any(|one| one.planning_ms().is_some());
    names.extend(plans.then_some("planning, ms"));
    heading(text, &names);
    for one in measured {
        let greedy = one.greedy();
        let iqm = greedy.map(|value| match value.interval {
            Some(_) => format!("{} {}", share(value.iqm), ends(value.interval)),
            None => share(value.iqm),
        });
        let mut cells = vec![
            one.cell.system.name.to_owned(),
            one.cell.agents().to_string(),
            optional(greedy.map(spread)),
            optional(iqm),
            optional(one.sampled().map(spread)),
            optional(one.paper().map(|value| paper(value.success))),
        ];
        if crashes {
            cells.push(optional(one.collisions().map(spread)));
            cells.push(optional(one.paper().and_then(|value| value.collisions).map(paper)));
        }
        let arrival = format!("{:.1}", one.arrival());
        cells.extend([arrival, thousands(one.steps()), one.ended_by(), one.converged(), seconds(one.wall_s())]);
        cells.extend(plans.then(|| optional(one.planning_ms().map(|ms| format!("{ms:.2}")))));
        row(text, &cells);
    }
}

fn statistics(text: &mut String, table: &'static PaperTable, measured: &[Measured]) {
    let all = aggregates(table, measured);
    if all.is_empty() {
        return;
    }
    text.push_str(
        "\nOver all team sizes and seeds, greedy success; the last column is the probability that a run of MAGE-X \
         beats one of the system.\n\n",
    );
    heading(text, &["system", "numbers", "IQM", "interval", "median", "mean", "optimality gap", "MAGE-X improves"]);
    for one in &all {
        let improves = one.improvement.map(|(value, interval)| match interval {
            Some(_) => format!("{} {}", share(value), ends(interval)),
            None => share(value),
        });
        row(
            text,
            &[
                one.system.name.to_owned(),
                one.count.to_string(),
                share(one.iqm),
                ends(one.interval),
                share(one.median),
                share(one.mean),
                share(one.optimality_gap),
                optional(improves),
            ],
        );
    }
    text.push_str("\nPerformance profile: share of the runs whose greedy success is above the value.\n\n");
    let thresholds: Vec<String> = THRESHOLDS.iter().map(f64::to_string).collect();
    heading(text, &std::iter::once("system").chain(thresholds.iter().map(String::as_str)).collect::<Vec<_>>());
    for one in &all {
        let shares = one.profile.iter().map(|&value| format!("{value:.2}"));
        row(text, &std::iter::once(one.system.name.to_owned()).chain(shares).collect::<Vec<_>>());
    }
}

/// A row per cell with every number.
pub(crate) fn csv(tables: &[(&'static PaperTable, Vec<Measured>)]) -> String {
    let names = "table,system,agents,seeds,episodes,success_mean,success_sd,success_iqm,success_low,success_high,\
        sampled_mean,sampled_sd,collision_mean,collision_sd,paper_success,paper_success_sd,paper_collision,\
        paper_collision_sd,arrival_step,joint_env_steps,converged,ended_by,wall_s,planning_ms";
    let mut rows: Vec<Vec<String>> = vec![names.split(',').map(str::to_owned).collect()];
    let number = |value: Option<f64>| value.map(|value| value.to_string()).unwrap_or_default();
    for one in tables.iter().flat_map(|(_, measured)| measured) {
        let (greedy, sampled, collisions, paper) = (one.greedy(), one.sampled(), one.collisions(), one.paper());
        let interval = greedy.and_then(|value| value.interval);
        let seeds: Vec<String> = one.records.iter().map(|record| record.seed.to_string()).collect();
        let episodes: usize = one.records.iter().map(|record| record.greedy.success_rate.len()).sum();
        let crashed = paper.and_then(|paper| paper.collisions);
        rows.push(vec![
            one.cell.table.name.into(),
            one.cell.system.name.into(),
            one.cell.agents().to_string(),
            seeds.join(" "),
            episodes.to_string(),
            number(greedy.map(|value| value.mean)),
            number(greedy.and_then(|value| value.deviation)),
            number(greedy.map(|value| value.iqm)),
            number(interval.map(|interval| interval.low)),
            number(interval.map(|interval| interval.high)),
            number(sampled.map(|value| value.mean)),
            number(sampled.and_then(|value| value.deviation)),
            number(collisions.map(|value| value.mean)),
            number(collisions.and_then(|value| value.deviation)),
            number(paper.map(|paper| paper.success[0])),
            number(paper.map(|paper| paper.success[1])),
            number(crashed.map(|[mean, _]| mean)),
            number(crashed.map(|[_, deviation]| deviation)),
            number(Some(one.arrival())),
            number(Some(one.steps())),
            one.converged(),
            one.ended_by(),
            number(Some(one.wall_s())),
            number(one.planning_ms()),
        ]);
    }
    artifacts::csv(&rows)
}
