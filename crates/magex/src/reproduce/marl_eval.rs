//! `runs.json`: the runs in the layout of marl-eval (environment → task → algorithm → seed → step → metric).
//!
//! Its readers ask for more than the layout says. Names are lower case, without commas. Every algorithm of an environment has the
//! same seeds, and every run of it the same steps, so a seed that a system lacks is left out, and curves are read at common steps:
//! a run that ended early keeps its last value. A step is counted at the end of its interval; steps are numbered from 0.

use super::record::Record;
use super::summary::Measured;
use super::systems::PaperTable;
use magex_stats::aggregate::average;
use magex_stats::curves::value_at;
use serde_json::{Map, Value, json};
use std::collections::BTreeSet;

/// Evaluations of a run.
const STEPS: u32 = 20;

/// Of all tables.
pub(crate) fn runs(tables: &[(&'static PaperTable, Vec<Measured>)]) -> Value {
    let environments = tables.iter().filter(|(_, measured)| !measured.is_empty());
    Value::Object(environments.map(|(table, measured)| (plain(table.name), environment(measured))).collect())
}

fn plain(name: &str) -> String {
    name.to_lowercase().replace(['-', ','], "_")
}

fn environment(measured: &[Measured]) -> Value {
    let seeds_of = |one: &Measured| one.records.iter().map(|record| record.seed).collect::<BTreeSet<u64>>();
    let common = measured.iter().map(seeds_of).reduce(|a, b| &a & &b).unwrap_or_default();
    // One algorithm on every task, or the readers fail.
    let sizes: BTreeSet<usize> = measured.iter().map(|one| one.cell.agents()).collect();
    let whole = |id: &str| measured.iter().filter(|one| one.cell.system.id == id).count() == sizes.len();
    let mut tasks = Map::new();
    for agents in sizes.iter().copied() {
        let own = measured.iter().filter(|one| one.cell.agents() == agents && whole(one.cell.system.id));
        let own: Vec<&Measured> = own.collect();
        let steps = own.iter().flat_map(|one| &one.records).map(|record| record.joint_env_steps).max();
        let steps = steps.unwrap_or_default().max(u64::from(STEPS));
        let algorithm = |one: &&Measured| {
            let records = one.records.iter().filter(|record| common.contains(&record.seed));
            let runs = records.map(|record| (format!("seed_{}", record.seed), run(one, record, steps)));
            (plain(one.cell.system.id), Value::Object(runs.collect()))
        };
        tasks.insert(format!("n_{agents}"), Value::Object(own.iter().map(algorithm).collect()));
    }
    Value::Object(tasks)
}

fn run(measured: &Measured, record: &Record, steps: u64) -> Value {
    let crash = measured.cell.config.task.definition().crashes;
    let success = record.success_curve();
    let crashed: Vec<[f64; 2]> =
        record.curve.iter().filter_map(|p| Some([p.joint_env_steps as f64, p.collision_rate?])).collect();
    let mut run = Map::new();
    for k in 0..STEPS {
        let count = steps * u64::from(k + 1) / u64::from(STEPS);
        // A controller has no curve: it is as good as it is.
        let at = |curve: &[[f64; 2]], all: &[f64]| value_at(curve, count as f64).unwrap_or_else(|| average(all));
        let mut step = Map::new();
        step.insert("step_count".into(), json!(count));
        step.insert("success_rate".into(), json!([at(&success, &record.greedy.success_rate)]));
        if crash {
            step.insert("collision_rate".into(), json!([at(&crashed, &record.greedy.collision_rate)]));
        }
        run.insert(format!("step_{k}"), Value::Object(step));
    }
    let mut absolute = Map::new();
    absolute.insert("success_rate".into(), json!(record.greedy.success_rate));
    if crash {
        absolute.insert("collision_rate".into(), json!(record.greedy.collision_rate));
    }
    run.insert("absolute_metrics".into(), Value::Object(absolute));
    Value::Object(run)
}
