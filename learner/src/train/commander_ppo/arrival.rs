//! The objective `arrival`: how soon the last agent arrived in the episode of a decision, and how often agents collided.
//!
//! The greedy decision's episode is not played, so the baseline is a forecast instead: a least-squares fit of the iteration's
//! rewards by what is known of each instance before the decision. Like any baseline that does not depend on the decision, it
//! takes variance out of the gradient and leaves its direction.

use magex_core::metrics_table::{ARRIVAL_STEP, COLLISION_RATE, COLLISIONS_PER_AGENT_STEP};
use magex_core::trajectory::EpisodeMetrics;
use magex_nets::commander::Team;

/// Of the features' variance: keeps features that say the same from making the fit singular.
const RIDGE: f64 = 1e-6;
/// Episodes per feature, at least; with fewer the fit would follow the decisions themselves.
const EPISODES: usize = 4;

/// −(step of the last arrival / horizon) − collision_cost × collisions per agent and step; NaN for a task that measures no arrival.
pub(super) fn reward(metrics: &EpisodeMetrics, horizon: u32, collision_cost: f32) -> f64 {
    let of = |metric| metrics.get(metric).map(f64::from);
    let collisions = of(COLLISIONS_PER_AGENT_STEP).or(of(COLLISION_RATE)).unwrap_or(0.0);
    let arrival = of(ARRIVAL_STEP).unwrap_or(f64::NAN);
    -arrival / f64::from(horizon) - f64::from(collision_cost) * collisions
}

/// The longest way of an assignment.
pub(super) fn longest(team: &Team<'_>, goals: &[u32]) -> f64 {
    let ways = goals.iter().enumerate().filter(|(_, goal)| **goal != u32::MAX).map(|(agent, &goal)| {
        let from = &team.agents[agent * team.dims..(agent + 1) * team.dims];
        let to = &team.goals[goal as usize * team.dims..(goal as usize + 1) * team.dims];
        from.iter().zip(to).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum::<f64>().sqrt()
    });
    ways.fold(0.0, f64::max)
}

/// Rewards less what the instances let expect: `rewards` [E], `known` [E][F] features of each instance.
pub(super) fn advantages(rewards: &[f64], known: &[Vec<f64>]) -> Vec<f64> {
    let count = rewards.len() as f64;
    let mean = |values: &mut dyn Iterator<Item = f64>| values.sum::<f64>() / count.max(1.0);
    let centre = mean(&mut rewards.iter().copied());
    let centred: Vec<f64> = rewards.iter().map(|reward| reward - centre).collect();
    let features = known.first().map_or(0, Vec::len);
    if rewards.len() < EPISODES * (features + 1) {
        return centred;
    }
    let centres: Vec<f64> = (0..features).map(|f| mean(&mut known.iter().map(|row| row[f]))).collect();
    let rows: Vec<Vec<f64>> =
        known.iter().map(|row| row.iter().zip(&centres).map(|(value, centre)| value - centre).collect()).collect();
    // The normal equations, [F][F + 1].
    let mut equations: Vec<Vec<f64>> = (0..features)
        .map(|f| {
            let product =
                |other: &dyn Fn(usize) -> f64| rows.iter().enumerate().map(|(e, row)| row[f] * other(e)).sum();
            let mut equation: Vec<f64> = (0..features).map(|g| product(&|e| rows[e][g])).collect();
            equation[f] *= 1.0 + RIDGE;
            equation.push(product(&|e| centred[e]));
            equation
        })
        .collect();
    let slopes = solve(&mut equations);
    let forecast = |row: &Vec<f64>| row.iter().zip(&slopes).map(|(value, slope)| value * slope).sum::<f64>();
    centred.iter().zip(&rows).map(|(reward, row)| reward - forecast(row)).collect()
}

/// Gauss–Jordan elimination of a positive semidefinite system, [F][F + 1]; 0 for a feature that never varies.
fn solve(equations: &mut [Vec<f64>]) -> Vec<f64> {
    for pivot in 0..equations.len() {
        let own = equations[pivot].clone();
        if own[pivot] <= 0.0 {
            continue;
        }
        for (_, equation) in equations.iter_mut().enumerate().filter(|(row, _)| *row != pivot) {
            let factor = equation[pivot] / own[pivot];
            equation.iter_mut().zip(&own).for_each(|(value, own)| *value -= factor * own);
        }
    }
    (0..equations.len())
        .map(|f| if equations[f][f] > 0.0 { equations[f][equations.len()] / equations[f][f] } else { 0.0 })
        .collect()
}
