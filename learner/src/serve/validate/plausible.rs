//! Whether the numbers of a trajectory can be what the task gives: ranges of states and rewards, costs computed anew, metrics that
//! agree with the arrays.

use super::Limits;
use crate::train::commander_ppo::stage_goals;
use magex_assign::{cost_of_points, distance, exact_points};
use magex_core::joint_state::group_positions;
use magex_core::metrics_table::{COST_RATIO, METRICS, REWARD, SECOND_COST_RATIO};
use magex_core::statics::LANDMARKS;
use magex_core::task::Group;
use magex_core::trajectory::Trajectory;
use magex_proto::convert::ConvertError;

/// Teams up to this size are assigned again to check the exact cost.
const EXACT_AGENTS: usize = 64;
/// Teams up to this size have their exact cost compared with the distance from every agent to its nearest goal.
const NEAREST_AGENTS: usize = 1024;

pub(super) fn check(limits: &Limits, t: &Trajectory) -> Result<(), ConvertError> {
    let bounds = limits.task.bounds();
    within("positions", &t.positions, bounds.position)?;
    within("velocities", &t.velocities, bounds.velocity)?;
    within("agent_state", &t.agent_state, bounds.agent_state)?;
    within("statics.landmarks", t.statics.get(LANDMARKS), bounds.position)?;
    check_rewards(limits, t)?;
    check_costs(limits, t)
}

fn within(field: &str, values: &[f32], bound: f32) -> Result<(), ConvertError> {
    // The maximum first: it vectorises, the search does not.
    if values.iter().fold(0.0f32, |most, value| most.max(value.abs())) <= bound {
        return Ok(());
    }
    let place = values.iter().position(|value| value.abs() > bound).unwrap_or_default();
    let problem = format!("{} is beyond \u{b1}{bound}, which this task cannot reach", values[place]);
    Err(ConvertError::new(format!("trajectory.{field}[{place}]"), problem))
}

fn check_rewards(limits: &Limits, t: &Trajectory) -> Result<(), ConvertError> {
    let shape = &t.shape;
    let largest = |values: &[f32]| values.iter().fold(0.0f32, |most, value| most.max(value.abs()));
    let extent = 2.0 * largest(&t.positions).max(largest(t.statics.get(LANDMARKS))) * (shape.dims as f32).sqrt();
    let [low, high] = limits.task.reward_range(extent);
    if let Some(place) = t.rewards.iter().position(|reward| !(low..=high).contains(reward)) {
        let problem = format!("{} is outside {low}..={high}, which the reward's coefficients give", t.rewards[place]);
        return Err(ConvertError::new(format!("trajectory.rewards[{place}]"), problem));
    }
    // An external environment's metrics are of the first episode of each world.
    let whole = shape.marks == 0;
    for (b, metrics) in t.metrics.iter().enumerate().filter(|_| whole) {
        let row = |step: usize| &t.rewards[(step * shape.episodes + b) * shape.agents..][..shape.agents];
        let sum: f64 = (0..shape.steps).flat_map(row).map(|&reward| f64::from(reward)).sum();
        let mean = sum / (shape.steps * shape.agents).max(1) as f64;
        let said = f64::from(metrics[REWARD]);
        if (said - mean).abs() > 1e-3 * (1.0 + mean.abs()) {
            let problem = format!("{said} where the rewards have the mean {mean}");
            return Err(ConvertError::new(format!("trajectory.metrics[{b}].{}", METRICS[REWARD].name), problem));
        }
    }
    Ok(())
}

fn check_costs(limits: &Limits, t: &Trajectory) -> Result<(), ConvertError> {
    let (stages, points) = (limits.task.stages(), (&*t.positions, t.statics.get(LANDMARKS)));
    for b in 0..t.shape.episodes {
        for (k, stage) in stages.iter().enumerate() {
            let side = |group: Group| group_positions(&t.shape, points, group, b);
            let (from, to, dims, at) = (side(stage.from), side(stage.to), t.shape.dims, b * stages.len() + k);
            let (cost, exact) = (t.costs[at], t.exact_costs[at]);
            let wrong =
                |field: &str, problem: String| Err(ConvertError::new(format!("trajectory.{field}[{at}]"), problem));
            let Some(goals) = stage_goals(t, b, k) else {
                return wrong("goals", "the goals of a stage are not one-to-one".to_owned());
            };
            let expected = cost_of_points(from, to, dims, &goals) as f32;
            if cost != expected {
                return wrong("costs", format!("{cost} where the goals of stage {k} cost {expected}"));
            }
            if !(0.0..=cost * (1.0 + 1e-6)).contains(&exact) {
                return wrong("exact_costs", format!("{exact} is outside 0..={cost}, the cost of a valid assignment"));
            }
            if t.shape.agents <= EXACT_AGENTS {
                let least = exact_points(from, to, dims).map(|(_, cost)| cost as f32);
                if least.is_ok_and(|least| least != exact) {
                    return wrong("exact_costs", format!("{exact} is not the cost of the exact assignment"));
                }
            } else if t.shape.agents <= NEAREST_AGENTS {
                let nearest =
                    |agent: &[f32]| to.chunks_exact(dims).map(|goal| distance(agent, goal)).fold(f64::MAX, f64::min);
                let bound = from.chunks_exact(dims).map(nearest).sum::<f64>() * (1.0 - 1e-6);
                if f64::from(exact) < bound {
                    return wrong("exact_costs", format!("{exact} is below {bound}, the way to the nearest goals"));
                }
            }
            let metric = [COST_RATIO, SECOND_COST_RATIO].get(k).copied().unwrap_or(COST_RATIO);
            let (said, ratio) = (t.metrics[b][metric], cost / exact.max(1e-9));
            if said != ratio {
                let field = format!("trajectory.metrics[{b}].{}", METRICS[metric].name);
                return Err(ConvertError::new(field, format!("{said} where the costs give {ratio}")));
            }
        }
    }
    Ok(())
}
