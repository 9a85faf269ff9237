//! `<table>.svg`: the learning curves of a table, a panel for every team size.

use super::record::Record;
use super::summary::Measured;
use super::systems::{By, PaperTable};
use magex_stats::curves;
use magex_viewer::curve::systems::{Band, Panel, SystemCurve, systems_svg};
use std::collections::BTreeSet;

const NOTE: &str = "Line: mean over the seeds. Band: from the lowest seed to the highest. A run that has ended keeps its last \
    value; a controller is a level line.";

/// The picture of what was measured; `None` if that is nothing.
pub(crate) fn svg(table: &PaperTable, measured: &[Measured]) -> anyhow::Result<Option<String>> {
    let sizes: BTreeSet<usize> = measured.iter().map(|one| one.cell.agents()).collect();
    let panels: Vec<Panel> = sizes.into_iter().map(|agents| panel(measured, agents)).collect();
    if panels.is_empty() {
        return Ok(None);
    }
    Ok(Some(systems_svg(table.title, "success rate of the greedy evaluation while training", &panels, NOTE)?))
}

fn panel(measured: &[Measured], agents: usize) -> Panel {
    let own: Vec<&Measured> = measured.iter().filter(|one| one.cell.agents() == agents).collect();
    let steps = own.iter().flat_map(|one| &one.records).map(|record| record.joint_env_steps);
    let longest = steps.max().unwrap_or_default().max(1) as f64;
    let curve = |one: &&Measured| {
        let level = one.greedy().map_or(0.0, |value| value.mean);
        let points = match one.cell.system.by {
            By::Controller(..) => [0.0, longest].map(|steps| band(steps, [level; 3])).to_vec(),
            By::Learner { .. } => {
                let runs: Vec<_> = one.records.iter().map(Record::success_curve).collect();
                curves::band(&runs).iter().map(|p| band(p.x, [p.mean, p.low, p.high])).collect()
            }
        };
        SystemCurve { name: one.cell.system.name.to_owned(), points, mark: one.paper().map(|paper| paper.success[0]) }
    };
    Panel { title: format!("N = {agents}"), curves: own.iter().map(curve).collect() }
}

fn band(steps: f64, [mean, low, high]: [f64; 3]) -> Band {
    Band { steps, mean, low, high }
}
