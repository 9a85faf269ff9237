//! Switching costs: current pairs are cheaper, and a preferred matching is followed only where it saves more than they cost.

use crate::UNASSIGNED;
use magex_assign::{GoOn, Result, Solver, pairs};

/// Minimum gain of leaving a pair, relative to its own cost: more than the rounding of sums.
const WORTH: f64 = 1e-9;

/// Reduces the costs of the current pairs by the switching cost, or by enough to win a tie. The tie margin is relative to each
/// pair's own cost, so that one expensive pair does not affect the others.
pub(super) fn favour(adjusted: &mut [f64], cols: usize, current: &[u32], switching_cost: f64) {
    let smallest = smallest(adjusted);
    for (agent, goal) in pairs(current) {
        let row = &adjusted[agent * cols..(agent + 1) * cols];
        let cost = row[goal];
        // The pair is forbidden now.
        if cost == f64::INFINITY {
            continue;
        }
        // The scale of a pair of cost 0 is the smallest non-zero cost of its agent, or else of the problem.
        let scale = if cost != 0.0 { cost.abs() } else { self::smallest(row).or(smallest).unwrap_or(1.0) };
        adjusted[agent * cols + goal] = cost - switching_cost.max(WORTH * scale);
    }
}

/// The smallest non-zero magnitude.
fn smallest(costs: &[f64]) -> Option<f64> {
    let sizes = costs.iter().filter(|cost| cost.is_finite() && **cost != 0.0).map(|cost| cost.abs());
    sizes.min_by(f64::total_cmp)
}

/// Follows `wish`, a maximum matching, only where it saves more than leaving the current pairs costs.
///
/// The alternative keeps all current pairs that are still allowed, gives the other agents their goal in `wish` if it is free,
/// and assigns the rest exactly. The two matchings differ in groups that share no agent and no goal: an exchange, or a chain of
/// agents that each take the next one's goal. Every group is decided by its `adjusted` costs; more pairs always win.
pub(super) fn follow(
    wish: &[u32],
    adjusted: &[f64],
    cols: usize,
    current: &[u32],
    solver: &mut Solver,
    go_on: GoOn<'_>,
) -> Result<Vec<u32>> {
    let kept = keep(wish, adjusted, cols, current, solver, go_on)?;
    let rows = wish.len();
    let mut groups = Groups::new(rows + cols);
    let apart: Vec<usize> = (0..rows).filter(|&agent| kept[agent] != wish[agent]).collect();
    for &agent in &apart {
        for goal in [kept[agent], wish[agent]].into_iter().filter(|&goal| goal != UNASSIGNED) {
            groups.join(agent, rows + goal as usize);
        }
    }
    // Per group: additional pairs of the wish, and their additional cost.
    let mut more = vec![(0i64, 0.0f64); rows + cols];
    for &agent in &apart {
        let (pairs, cost) = &mut more[groups.of(agent)];
        let cost_of = |goal: u32| adjusted[agent * cols + goal as usize];
        if wish[agent] != UNASSIGNED {
            (*pairs, *cost) = (*pairs + 1, *cost + cost_of(wish[agent]));
        }
        if kept[agent] != UNASSIGNED {
            (*pairs, *cost) = (*pairs - 1, *cost - cost_of(kept[agent]));
        }
    }
    let mut followed = kept;
    for &agent in &apart {
        let (pairs, cost) = more[groups.of(agent)];
        if pairs > 0 || (pairs == 0 && cost < 0.0) {
            followed[agent] = wish[agent];
        }
    }
    Ok(followed)
}

/// The current pairs; for the other agents their goal in `wish`, or the best of the remaining goals.
fn keep(
    wish: &[u32],
    adjusted: &[f64],
    cols: usize,
    current: &[u32],
    solver: &mut Solver,
    go_on: GoOn<'_>,
) -> Result<Vec<u32>> {
    let (mut kept, mut free) = (vec![UNASSIGNED; wish.len()], vec![true; cols]);
    for (agent, goal) in pairs(current) {
        if adjusted[agent * cols + goal] < f64::INFINITY {
            (kept[agent], free[goal]) = (goal as u32, false);
        }
    }
    for (agent, goal) in pairs(wish) {
        if kept[agent] == UNASSIGNED && free[goal] {
            (kept[agent], free[goal]) = (goal as u32, false);
        }
    }
    let agents: Vec<usize> = (0..wish.len()).filter(|&agent| kept[agent] == UNASSIGNED).collect();
    let goals: Vec<usize> = (0..cols).filter(|&goal| free[goal]).collect();
    if agents.is_empty() || goals.is_empty() {
        return Ok(kept);
    }
    let rest: Vec<f64> =
        agents.iter().flat_map(|agent| goals.iter().map(move |goal| adjusted[agent * cols + goal])).collect();
    let filled = solver.solve_allowed(&rest, agents.len(), goals.len(), go_on)?;
    for (row, col) in filled.pairs() {
        kept[agents[row]] = goals[col] as u32;
    }
    Ok(kept)
}

/// Disjoint sets of agents and goals.
struct Groups(Vec<usize>);

impl Groups {
    fn new(count: usize) -> Self {
        Self((0..count).collect())
    }

    fn of(&mut self, mut member: usize) -> usize {
        while self.0[member] != member {
            self.0[member] = self.0[self.0[member]];
            member = self.0[member];
        }
        member
    }

    fn join(&mut self, one: usize, other: usize) {
        let (one, other) = (self.of(one), self.of(other));
        self.0[one.max(other)] = one.min(other);
    }
}
