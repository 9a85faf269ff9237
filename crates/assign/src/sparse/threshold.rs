//! The bottleneck assignment of points without a cost matrix.
//!
//! The smallest largest cost by bisection over costs that occur. Whether a threshold is enough is decided by augmenting paths in
//! rounds (Pothen & Fan 1990), in which every column is taken from a tree of the columns when it is met, so that a round looks at
//! every column once (Efrat, Itai & Katz 2001, "Geometry helps in bottleneck matching"). Where it is not enough, the cheapest
//! pair that leads out of what was reached is the next candidate.

use super::NONE;
use super::costs::{Metric, OwnCosts};
use super::growing::{Growing, Seeker};
use super::places::{Counted, Shares};
use super::points::{Limit, PointProblem, WORTH_IT, check, in_doubles, matrix, own_costs, solve_sparse};
use crate::{AssignError, Assignment, BottleneckSolver, GoOn, Result, UNASSIGNED, pairs};

/// As many pairs as possible, then the smallest largest cost, then as [`super::solve_points`]: the answer of
/// [`BottleneckSolver::solve_switching`] of the matrix of costs, in memory that grows with the points only.
/// With pairs in force and a switching cost, and with more than three coordinates, the matrix is used.
pub fn bottleneck_points<T: Copy + Into<f64>>(problem: &PointProblem<'_, T>, go_on: GoOn<'_>) -> Result<Assignment> {
    let (rows, cols) = check(problem)?;
    let switching = &problem.switching;
    let switches = switching.cost > 0.0 && pairs(switching.current).next().is_some();
    if rows.max(cols) < WORTH_IT || problem.dims > 3 || switches {
        let cost = matrix(problem)?;
        return BottleneckSolver::default().solve_switching(&cost, rows, cols, switching, go_on);
    }
    let (agents, goals) = (in_doubles(problem.agents), in_doubles(problem.goals));
    bottleneck_sparse(&problem.with(&agents, &goals), rows, cols, go_on)
}

/// Without the matrix, and without regard to a switching cost.
pub(super) fn bottleneck_sparse(
    problem: &PointProblem<'_, f64>,
    rows: usize,
    cols: usize,
    go_on: GoOn<'_>,
) -> Result<Assignment> {
    let limit = match problem.dims {
        1 => threshold::<1>(problem, go_on)?,
        2 => threshold::<2>(problem, go_on)?,
        _ => threshold::<3>(problem, go_on)?,
    };
    match limit {
        Some(limit) => solve_sparse(problem, rows, cols, limit, go_on),
        None => Ok(Assignment { col_of_row: vec![UNASSIGNED; rows], cost: 0.0 }),
    }
}

/// The smallest largest cost; nothing if all pairs are forbidden.
fn threshold<const D: usize>(problem: &PointProblem<'_, f64>, go_on: GoOn<'_>) -> Result<Option<Limit>> {
    let metric = Metric { power: problem.power, limit: f64::INFINITY };
    let (agents, goals) = (problem.agents.as_chunks::<D>().0, problem.goals.as_chunks::<D>().0);
    let own = own_costs(problem, agents, goals, metric);
    let (short, long) = if agents.len() > goals.len() { (goals, agents) } else { (agents, goals) };
    match Counted::new(short, long, &own) {
        Some(counted) => Shares::new(&counted, metric).search(go_on),
        None => Matching::new(short, long, metric, &own).search(go_on),
    }
}

/// A matching of points.
pub(super) struct Matching<const D: usize> {
    pub(super) seeker: Seeker<D>,
    col_of_row: Vec<u32>,
    row_of_col: Vec<u32>,
    reached: Vec<u32>,
}

impl<const D: usize> Matching<D> {
    /// Without pairs; no more points `from` than points `to`.
    pub(super) fn new(from: &[[f64; D]], to: &[[f64; D]], metric: Metric, own: &OwnCosts) -> Self {
        Self {
            seeker: Seeker::new(from, to, metric, own).0,
            col_of_row: vec![NONE; from.len()],
            row_of_col: vec![NONE; to.len()],
            reached: Vec::new(),
        }
    }
}

impl<const D: usize> Growing<D> for Matching<D> {
    fn seeker(&mut self) -> &mut Seeker<D> {
        &mut self.seeker
    }

    fn whole(&self) -> usize {
        self.col_of_row.len()
    }

    fn rows_are_shorter(&self) -> bool {
        true
    }

    fn reached(&mut self) -> &mut Vec<u32> {
        &mut self.reached
    }

    /// Makes the matching a largest one of pairs up to the limit; returns its size.
    fn grow(&mut self, limit: f64, go_on: GoOn<'_>) -> Result<usize> {
        let rows = self.col_of_row.len() as u32;
        for row in 0..rows {
            let col = self.col_of_row[row as usize];
            if col != NONE && self.seeker.cost(row, col) > limit {
                (self.col_of_row[row as usize], self.row_of_col[col as usize]) = (NONE, NONE);
            }
        }
        let mut path: Vec<(u32, u32)> = Vec::new();
        loop {
            if !go_on() {
                return Err(AssignError::Interrupted);
            }
            self.seeker.left.restore();
            self.seeker.free.restore();
            for col in 0..self.row_of_col.len() as u32 {
                if self.row_of_col[col as usize] != NONE {
                    self.seeker.free.close(col);
                }
            }
            self.reached.clear();
            let (mut free, mut grown) = (0, 0);
            for row in 0..rows {
                if self.col_of_row[row as usize] != NONE {
                    continue;
                }
                free += 1;
                path.clear();
                path.push((row, NONE));
                while let Some(&(row, _)) = path.last() {
                    let Some(col) = self.seeker.reach(row, limit) else {
                        self.reached.push(row);
                        path.pop();
                        continue;
                    };
                    let owner = self.row_of_col[col as usize];
                    if let Some(last) = path.last_mut() {
                        last.1 = col;
                    }
                    if owner == NONE {
                        for &(row, col) in &path {
                            (self.col_of_row[row as usize], self.row_of_col[col as usize]) = (col, row);
                        }
                        grown += 1;
                        break;
                    }
                    path.push((owner, NONE));
                }
            }
            if grown == 0 || grown == free {
                return Ok(rows as usize - free + grown);
            }
        }
    }

    fn largest(&mut self) -> f64 {
        let pairs = (0u32..).zip(&self.col_of_row).filter(|(_, col)| **col != NONE);
        pairs.map(|(row, &col)| self.seeker.cost(row, col)).fold(f64::NEG_INFINITY, f64::max)
    }
}
