//! Assignment from a list of allowed pairs with their costs; every other pair is forbidden.

use super::candidates::Candidates;
use super::tree::Found;
use super::{Order, solve};
use crate::ties::Exact;
use crate::{
    AssignError, Assignment, GoOn, LARGEST_COST, Result, Span, Switching, UNASSIGNED, check_shape, compensated_sum,
};

/// The pairs that may be, and what they cost.
#[derive(Debug, Clone, Copy)]
pub struct AllowedPairs<'a> {
    /// Rows; some may have no pair.
    pub rows: usize,
    /// Columns; some may have no pair.
    pub cols: usize,
    /// (row, column, cost), in any order; +∞ forbids a pair after all. The last one of a pair counts.
    pub pairs: &'a [(u32, u32, f64)],
    /// Pairs in force.
    pub switching: Switching<'a>,
}

/// As many pairs as possible, then the smallest summed cost + switching cost × switches, then the fewest switches, then the
/// lowest matching, as [`crate::Solver::solve_switching`] of the matrix with +∞ for the other pairs, in memory that grows with
/// the list. Stops as soon as `go_on` returns false.
/// Fails for pairs beyond the shape and costs that are NaN, −∞ or beyond 1e300.
pub fn solve_pairs(problem: &AllowedPairs<'_>, go_on: GoOn<'_>) -> Result<Assignment> {
    let &AllowedPairs { rows, cols, .. } = problem;
    check_shape(rows, cols)?;
    problem.switching.check(rows, cols)?;
    let turned = rows > cols;
    let list = List::new(problem, turned)?;
    let order = Order { row_at: (0..list.rows as u32).collect(), col_at: (0..list.cols as u32).collect() };
    let col_of_row = solve(&list, &order, &list, go_on)?;
    let mut answer = vec![UNASSIGNED; rows];
    for (row, &col) in (0u32..).zip(&col_of_row).filter(|(_, col)| (**col as usize) < list.cols) {
        let (agent, goal) = if turned { (col, row) } else { (row, col) };
        answer[agent as usize] = goal;
    }
    let cost = compensated_sum(crate::pairs(&answer).map(|(agent, goal)| {
        let (row, col) = if turned { (goal, agent) } else { (agent, goal) };
        list.terms(row, col)[0]
    }));
    Ok(Assignment { col_of_row: answer, cost })
}

/// The pairs by rows, which are the shorter side.
struct List {
    rows: usize,
    cols: usize,
    start: Vec<usize>,
    /// (column, cost), ascending by column.
    pairs: Vec<(u32, f64)>,
    /// `[rows]` the current column of each row, if that pair is allowed; the number of columns otherwise.
    current: Vec<u32>,
    switching_cost: f64,
    sink: f64,
    turned: bool,
}

impl List {
    fn new(problem: &AllowedPairs<'_>, turned: bool) -> Result<Self> {
        let (rows, cols) = (problem.rows.min(problem.cols), problem.rows.max(problem.cols));
        let mut pairs = Vec::with_capacity(problem.pairs.len());
        for (k, &(row, col, cost)) in problem.pairs.iter().enumerate() {
            if row as usize >= problem.rows || col as usize >= problem.cols {
                let text =
                    format!("pair ({row}, {col}) is not within {} rows and {} columns", problem.rows, problem.cols);
                return Err(AssignError::invalid(format!("pairs[{k}]"), text));
            }
            if cost.is_nan() || cost < -LARGEST_COST || (cost > LARGEST_COST && cost < f64::INFINITY) {
                let text = format!("{cost} is neither a number up to 1e300 nor +inf, which forbids the pair");
                return Err(AssignError::invalid(format!("pairs[{k}]"), text));
            }
            let (row, col) = if turned { (col, row) } else { (row, col) };
            pairs.push((row, col, cost));
        }
        pairs.reverse();
        pairs.sort_by_key(|&(row, col, _)| (row, col));
        pairs.dedup_by_key(|&mut (row, col, _)| (row, col));
        pairs.retain(|&(_, _, cost)| cost < f64::INFINITY);
        let mut start: Vec<usize> = vec![0; rows + 1];
        pairs.iter().for_each(|pair| start[pair.0 as usize + 1] += 1);
        (0..rows).for_each(|row| start[row + 1] += start[row]);
        let mut list = Self {
            rows,
            cols,
            start,
            pairs: pairs.into_iter().map(|(_, col, cost)| (col, cost)).collect(),
            current: vec![cols as u32; rows],
            switching_cost: problem.switching.cost,
            sink: 0.0,
            turned,
        };
        for (agent, goal) in crate::pairs(problem.switching.current) {
            let (row, col) = if turned { (goal, agent) } else { (agent, goal) };
            if list.get(row, col).is_some() {
                list.current[row] = col as u32;
            }
        }
        list.sink = list.penalty();
        Ok(list)
    }

    fn penalty(&self) -> f64 {
        let mut span = Span { forbidden: 0, least: f64::INFINITY, largest: f64::NEG_INFINITY };
        for row in 0..self.rows {
            for &(col, cost) in self.of(row) {
                span.least = span.least.min(self.priced(row, col, cost));
                span.largest = span.largest.max(cost);
            }
        }
        span.penalty(self.rows)
    }

    fn of(&self, row: usize) -> &[(u32, f64)] {
        &self.pairs[self.start[row]..self.start[row + 1]]
    }

    fn get(&self, row: usize, col: usize) -> Option<f64> {
        let pairs = self.of(row);
        pairs.binary_search_by_key(&(col as u32), |pair| pair.0).ok().map(|place| pairs[place].1)
    }

    /// The cost less the switching cost of a current pair.
    fn priced(&self, row: usize, col: u32, cost: f64) -> f64 {
        if self.current[row] == col { cost - self.switching_cost } else { cost }
    }
}

impl Candidates for &List {
    fn rows(&self) -> usize {
        self.rows
    }

    fn cols(&self) -> usize {
        self.cols
    }

    fn largest_cost(&self) -> f64 {
        self.sink
    }

    fn sink(&self) -> Option<f64> {
        Some(self.sink)
    }

    /// All of them: a second look would find no more.
    fn nearest(&mut self, row: u32, _: usize, price: &[f64], found: &mut Vec<Found>) -> f64 {
        found.clear();
        found.extend(self.of(row as usize).iter().map(|&(col, cost)| {
            let cost = self.priced(row as usize, col, cost);
            Found { reduced: cost - price[col as usize], col, cost }
        }));
        f64::INFINITY
    }

    fn nearest_open(&mut self, row: u32, count: usize, price: &[f64], found: &mut Vec<Found>) -> f64 {
        self.nearest(row, count, price, found)
    }

    fn close(&mut self, _: u32) {}

    fn reopen(&mut self, _: u32) {}

    fn within(&mut self, row: u32, limit: f64, price: &[f64], found: &mut Vec<u32>) {
        let near = |&&(col, cost): &&(u32, f64)| self.priced(row as usize, col, cost) - price[col as usize] <= limit;
        found.extend(self.of(row as usize).iter().filter(near).map(|pair| pair.0));
    }

    fn reprice(&mut self, _: u32, _: f64, _: &[f64]) {}

    fn sample(&self, _: usize) -> Option<Self> {
        None
    }

    fn spread(&mut self, _: &Self, _: &[f64], _: &mut Vec<f64>, _: GoOn<'_>) -> Result<()> {
        Ok(())
    }

    fn cost(&self, row: u32, col: u32) -> f64 {
        let cost = self.get(row as usize, col as usize).unwrap_or(f64::INFINITY);
        self.priced(row as usize, col, cost)
    }
}

impl Exact for List {
    fn terms(&self, row: usize, col: usize) -> [f64; 2] {
        match self.get(row, col) {
            Some(cost) if self.current[row] as usize == col => [cost, -self.switching_cost],
            Some(cost) => [cost, 0.0],
            None => [self.sink, 0.0],
        }
    }

    fn current(&self, row: usize, col: usize) -> bool {
        col < self.cols && self.current[row] as usize == col
    }

    fn forbidden(&self, _: usize, col: usize) -> bool {
        col >= self.cols
    }

    fn by_columns(&self) -> bool {
        self.turned
    }
}
