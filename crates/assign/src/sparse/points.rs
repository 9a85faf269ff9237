//! Assignment of agents to goals by distance, without a cost matrix.

mod source;

use super::costs::{Metric, OwnCost, OwnCosts};
use super::{line, places, solve};
use crate::points::{check_points, check_power};
use crate::ties::Exact;
use crate::{
    AssignError, Assignment, GoOn, LARGEST_COST, Result, Solver, Span, Switching, UNASSIGNED, compensated_sum,
    costs_into,
};

pub(super) use source::Points;

/// Members of the longer side from which on the matrix is left out: below, reading it is faster.
pub(super) const WORTH_IT: usize = 1000;

/// Agents and goals; a pair costs distance^power, unless it has a cost of its own.
#[derive(Debug, Clone, Copy)]
pub struct PointProblem<'a, T> {
    /// `[rows, dims]`
    pub agents: &'a [T],
    /// `[cols, dims]`
    pub goals: &'a [T],
    /// Coordinates of a point.
    pub dims: usize,
    /// Exponent of the distance, 1 to 16.
    pub power: f64,
    /// (row, column, cost) of pairs that cost something else; +∞ forbids a pair. The last one of a pair counts.
    pub costs: &'a [(u32, u32, f64)],
    /// Pairs in force.
    pub switching: Switching<'a>,
}

impl<'a, T> PointProblem<'a, T> {
    /// Distances, to the power of 1.
    pub fn new(agents: &'a [T], goals: &'a [T], dims: usize) -> Self {
        Self { agents, goals, dims, power: 1.0, costs: &[], switching: Switching::default() }
    }

    /// The same problem of these positions.
    pub(super) fn with<U>(&self, agents: &'a [U], goals: &'a [U]) -> PointProblem<'a, U> {
        let &Self { dims, power, costs, switching, .. } = self;
        PointProblem { agents, goals, dims, power, costs, switching }
    }
}

/// As many pairs as possible, then the smallest summed cost + switching cost × switches, then the fewest switches, then the
/// lowest matching, as [`Solver::solve_switching`] of the matrix of costs, in memory that grows with the points only.
/// Positions have 1 to 3 coordinates; more are solved by the matrix. Stops as soon as `go_on` returns false.
///
/// Points on a line along an axis (as many agents as goals, power 1, no costs of their own and no pairs in force, and
/// differences of coordinates that are doubles) take n log n steps, although nearly all their pairs are equally good.
///
/// Where several points share a place, with equal coordinates and without costs of their own or pairs in force, their number is
/// what takes time, not their pairs: many points of few places are solved faster than as many places.
///
/// The one exception to the last two keys of the order, and to sums without rounding: where more than 2^25 pairs in all are
/// equally good within 10^-12 of the largest costs (more than 5,792 points on an oblique line, or on any line with unequal
/// numbers), the answer is as cheap as doubles can tell and deterministic, but not always the lowest one. Where points share
/// places so often that these are counted (four points for each place of one side, or two of both), pairs of places count.
pub fn solve_points<T: Copy + Into<f64>>(problem: &PointProblem<'_, T>, go_on: GoOn<'_>) -> Result<Assignment> {
    let (rows, cols) = check(problem)?;
    if rows.max(cols) < WORTH_IT || problem.dims > 3 {
        let cost = matrix(problem)?;
        return Solver::default().solve_switching(&cost, rows, cols, &problem.switching, go_on);
    }
    let (agents, goals) = (in_doubles(problem.agents), in_doubles(problem.goals));
    solve_sparse(&problem.with(&agents, &goals), rows, cols, Limit::NONE, go_on)
}

/// Largest cost of a pair.
#[derive(Debug, Clone, Copy)]
pub(super) struct Limit {
    pub(super) cost: f64,
    /// Whether it leaves a matching of the whole shorter side.
    pub(super) complete: bool,
}

impl Limit {
    pub(super) const NONE: Self = Self { cost: f64::INFINITY, complete: false };
}

/// The matrix of all costs.
pub(super) fn matrix<T: Copy + Into<f64>>(problem: &PointProblem<'_, T>) -> Result<Vec<f64>> {
    let mut cost = Vec::new();
    let (_, cols) = costs_into(problem.agents, problem.goals, problem.dims, problem.power, &mut cost)?;
    for &(row, col, own) in problem.costs {
        cost[row as usize * cols + col as usize] = own;
    }
    Ok(cost)
}

/// Checks a problem; returns (rows, columns).
pub(super) fn check<T: Copy + Into<f64>>(problem: &PointProblem<'_, T>) -> Result<(usize, usize)> {
    check_power(problem.power)?;
    let (rows, cols) = check_points(problem.agents, problem.goals, problem.dims)?;
    problem.switching.check(rows, cols)?;
    for (k, &(row, col, cost)) in problem.costs.iter().enumerate() {
        if row as usize >= rows || col as usize >= cols {
            let text = format!("pair ({row}, {col}) is not within {rows} agents and {cols} goals");
            return Err(AssignError::invalid(format!("costs[{k}]"), text));
        }
        if cost.is_nan() || cost < -LARGEST_COST || (cost > LARGEST_COST && cost < f64::INFINITY) {
            let text = format!("{cost} is neither a number up to 1e300 nor +inf, which forbids the pair");
            return Err(AssignError::invalid(format!("costs[{k}]"), text));
        }
    }
    Ok((rows, cols))
}

/// Assigns agents `[rows, dims]` to goals `[cols, dims]` by Euclidean distance (computed in f64): the goal of each
/// agent ([`UNASSIGNED`] if there are fewer goals) and the summed distance.
pub fn exact_points<T: Copy + Into<f64>>(agents: &[T], goals: &[T], dims: usize) -> Result<(Vec<u32>, f64)> {
    let answer = solve_points(&PointProblem::new(agents, goals, dims), &|| true)?;
    Ok((answer.col_of_row, answer.cost))
}

/// Without the matrix; pairs that cost more than the limit are forbidden.
pub(super) fn solve_sparse(
    problem: &PointProblem<'_, f64>,
    rows: usize,
    cols: usize,
    limit: Limit,
    go_on: GoOn<'_>,
) -> Result<Assignment> {
    match problem.dims {
        1 => solve_dims::<1>(problem, rows, cols, limit, go_on),
        2 => solve_dims::<2>(problem, rows, cols, limit, go_on),
        _ => solve_dims::<3>(problem, rows, cols, limit, go_on),
    }
}

fn solve_dims<const D: usize>(
    problem: &PointProblem<'_, f64>,
    rows: usize,
    cols: usize,
    limit: Limit,
    go_on: GoOn<'_>,
) -> Result<Assignment> {
    let turned = rows > cols;
    let metric = Metric { power: problem.power, limit: limit.cost };
    let (agents, goals) = (problem.agents.as_chunks::<D>().0, problem.goals.as_chunks::<D>().0);
    let own = own_costs(problem, agents, goals, metric);
    let plain = own.is_empty() && problem.power == 1.0 && limit.cost == f64::INFINITY;
    if plain && let Some(goal_of) = line::solve(agents, goals, go_on) {
        let goal_of = goal_of?;
        let cost = crate::pairs(&goal_of).map(|(agent, goal)| metric.cost(&agents[agent], &goals[goal]));
        return Ok(Assignment { cost: compensated_sum(cost), col_of_row: goal_of });
    }
    let (largest_cost, sink) = largest_costs(&own, agents, goals, metric)?;
    let sink = sink.filter(|_| !limit.complete);
    let (short, long) = if turned { (goals, agents) } else { (agents, goals) };
    let exact = PointCosts { from: short, to: long, metric, own: &own, sink: sink.unwrap_or(0.0), turned };
    let counted = places::Problem { short, long, metric, own: &own, largest_cost, sink, turned };
    if let Some(goal_of) = places::solve(&counted, go_on)? {
        return Ok(Assignment { cost: exact.sum(&goal_of), col_of_row: goal_of });
    }
    let (source, order) = Points::new(short, long, metric, &own, largest_cost, sink);
    let col_of_row = solve(source, &order, &exact, go_on)?;
    let mut goal_of = vec![UNASSIGNED; rows];
    for (row, &col) in (0u32..).zip(&col_of_row).filter(|(_, col)| (**col as usize) < long.len()) {
        let (agent, goal) = if turned { (col, row) } else { (row, col) };
        goal_of[agent as usize] = goal;
    }
    Ok(Assignment { cost: exact.sum(&goal_of), col_of_row: goal_of })
}

/// The search is no generic code of the callers', whose profile may not optimise it.
pub(super) fn in_doubles<T: Copy + Into<f64>>(values: &[T]) -> Vec<f64> {
    values.iter().map(|&value| value.into()).collect()
}

/// The pairs with costs of their own as the solver sees them: its rows are the shorter side.
pub(super) fn own_costs<const D: usize>(
    problem: &PointProblem<'_, f64>,
    agents: &[[f64; D]],
    goals: &[[f64; D]],
    metric: Metric,
) -> OwnCosts {
    let limited = |cost: f64| if cost <= metric.limit { cost } else { f64::INFINITY };
    let place = |&(row, col, cost): &(u32, u32, f64)| OwnCost { row, col, terms: [limited(cost), 0.0], current: false };
    let listed = OwnCosts::new(problem.costs.iter().map(place).collect(), agents.len());
    let mut pairs = listed.pairs.clone();
    for (row, col) in crate::pairs(problem.switching.current) {
        let cost = listed.get(row, col).map_or_else(|| metric.cost(&agents[row], &goals[col]), |pair| pair.terms[0]);
        if cost < f64::INFINITY {
            let terms = [cost, -problem.switching.cost];
            pairs.push(OwnCost { row: row as u32, col: col as u32, terms, current: true });
        }
    }
    if agents.len() <= goals.len() {
        return OwnCosts::new(pairs, agents.len());
    }
    pairs.iter_mut().for_each(|pair| (pair.row, pair.col) = (pair.col, pair.row));
    OwnCosts::new(pairs, goals.len())
}

/// What no pair exceeds, and what a row without a column costs, above all that other pairs could save, if a pair is forbidden.
fn largest_costs<const D: usize>(
    own: &OwnCosts,
    agents: &[[f64; D]],
    goals: &[[f64; D]],
    metric: Metric,
) -> Result<(f64, Option<f64>)> {
    let (mut low, mut high) = ([f64::INFINITY; D], [f64::NEG_INFINITY; D]);
    for point in agents.iter().chain(goals) {
        for axis in 0..D {
            (low[axis], high[axis]) = (low[axis].min(point[axis]), high[axis].max(point[axis]));
        }
    }
    let diagonal = Metric { limit: f64::INFINITY, ..metric }.cost(&low, &high);
    if diagonal > LARGEST_COST {
        let problem = format!("distances to the power of {} are beyond 1e300; scale the positions", metric.power);
        return Err(AssignError::invalid("power", problem));
    }
    let forbidden = own.pairs.iter().filter(|pair| pair.terms[0] == f64::INFINITY).count();
    let mut span = Span { forbidden, least: 0.0, largest: diagonal.min(metric.limit) };
    for pair in own.pairs.iter().filter(|pair| pair.terms[0] < f64::INFINITY) {
        span.least = span.least.min(pair.cost());
        span.largest = span.largest.max(pair.terms[0]);
    }
    let any = forbidden > 0 || metric.limit < f64::INFINITY;
    Ok((span.largest, any.then(|| span.penalty(agents.len().min(goals.len())))))
}

/// The costs in the order of the problem; the solver's rows are the shorter side.
struct PointCosts<'a, const D: usize> {
    from: &'a [[f64; D]],
    to: &'a [[f64; D]],
    metric: Metric,
    own: &'a OwnCosts,
    sink: f64,
    turned: bool,
}

impl<const D: usize> PointCosts<'_, D> {
    /// Of the goals of all agents.
    fn sum(&self, goal_of: &[u32]) -> f64 {
        compensated_sum(crate::pairs(goal_of).map(|(agent, goal)| {
            let (row, col) = if self.turned { (goal, agent) } else { (agent, goal) };
            self.terms(row, col)[0]
        }))
    }
}

impl<const D: usize> Exact for PointCosts<'_, D> {
    fn terms(&self, row: usize, col: usize) -> [f64; 2] {
        let Some(to) = self.to.get(col) else {
            return [self.sink, 0.0];
        };
        match self.own.get(row, col) {
            Some(pair) => pair.terms,
            None => [self.metric.cost(&self.from[row], to), 0.0],
        }
    }

    fn current(&self, row: usize, col: usize) -> bool {
        self.own.get(row, col).is_some_and(|pair| pair.current)
    }

    fn forbidden(&self, _: usize, col: usize) -> bool {
        col >= self.to.len()
    }

    fn by_columns(&self) -> bool {
        self.turned
    }
}
