//! Reluctance: pairs that are in force are made cheaper, and a wish that knows nothing of them is followed only where it
//! is worth the switches.

use super::pairs;
use crate::UNASSIGNED;
use magex_assign::{AssignError, Solver};

/// Part of a pair's own cost that leaving it must gain at least: more than the rounding of sums.
const WORTH: f64 = 1e-9;

/// Makes the costs of the pairs in force smaller by the switching cost, and by enough that they win a tie. Each by its
/// own size: a pair that is far away or dear says nothing about what the others are worth.
pub(super) fn favour(adjusted: &mut [f64], cols: usize, current: &[u32], switching_cost: f64) {
    let smallest = smallest(adjusted);
    for (agent, goal) in pairs(current) {
        let row = &adjusted[agent * cols..(agent + 1) * cols];
        let cost = row[goal];
        // Forbidden now.
        if cost == f64::INFINITY {
            continue;
        }
        // What costs nothing is measured by the least that something costs, for this agent or for anybody.
        let scale = if cost != 0.0 { cost.abs() } else { self::smallest(row).or(smallest).unwrap_or(1.0) };
        adjusted[agent * cols + goal] = cost - switching_cost.max(WORTH * scale);
    }
}

/// The smallest cost that is not nothing.
fn smallest(costs: &[f64]) -> Option<f64> {
    let sizes = costs.iter().filter(|cost| cost.is_finite() && **cost != 0.0).map(|cost| cost.abs());
    sizes.min_by(f64::total_cmp)
}

/// Follows `wish`, as full a matching as there can be, only where it is worth leaving the pairs in force.
///
/// What is compared with it keeps all pairs in force that are still possible, gives the other agents what the wish gives
/// them where that is free, and the rest to the exact solver. The two differ in groups that share no agent and no goal:
/// an exchange, or a row of agents each of whom takes the next one's goal. Every group is decided by itself, by the
/// `adjusted` costs, and agents of other groups stay out of it. More pairs always win.
pub(super) fn follow(
    wish: &[u32],
    adjusted: &[f64],
    cols: usize,
    current: &[u32],
    solver: &mut Solver,
    go_on: &dyn Fn() -> bool,
) -> Result<Vec<u32>, AssignError> {
    let kept = keep(wish, adjusted, cols, current, solver, go_on)?;
    let rows = wish.len();
    let mut groups = Groups::new(rows + cols);
    let apart: Vec<usize> = (0..rows).filter(|&agent| kept[agent] != wish[agent]).collect();
    for &agent in &apart {
        for goal in [kept[agent], wish[agent]].into_iter().filter(|&goal| goal != UNASSIGNED) {
            groups.join(agent, rows + goal as usize);
        }
    }
    // Of each group: how many more pairs the wish has, and how much more they cost.
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

/// The pairs in force, and for everybody else what the wish has for them or the best of what is left.
fn keep(
    wish: &[u32],
    adjusted: &[f64],
    cols: usize,
    current: &[u32],
    solver: &mut Solver,
    go_on: &dyn Fn() -> bool,
) -> Result<Vec<u32>, AssignError> {
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

/// Which agents and goals belong together.
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
