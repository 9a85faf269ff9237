//! The bottleneck assignment: minimise the largest cost (when the last agent arrives, if all fly at the same speed).
//!
//! Binary search over the sorted costs with Hopcroft & Karp's maximum matching (1973) on the pairs up to the threshold;
//! among the assignments with the smallest largest cost, the one with the smallest sum.

use crate::greedy::ascending;
use crate::{AssignError, Assignment, Solver, UNASSIGNED, check_allowed, cost_of};

const NONE: u32 = u32::MAX;

/// The solver's memory. Reusing one allocates nothing but the answers.
#[derive(Debug, Default)]
pub struct BottleneckSolver {
    solver: Solver,
    matcher: Matcher,
    /// The costs, sorted; later the costs up to the threshold.
    values: Vec<f64>,
}

impl BottleneckSolver {
    /// As many pairs of `cost`, row-major `[rows, cols]`, as possible where +∞ forbids a pair; among those the smallest largest
    /// cost, then the smallest sum. Stops as soon as `should_continue` returns false. Fails as [`Solver::solve_allowed`].
    pub fn solve_allowed(
        &mut self,
        cost: &[f64],
        rows: usize,
        cols: usize,
        should_continue: &dyn Fn() -> bool,
    ) -> Result<Assignment, AssignError> {
        check_allowed(cost, rows, cols)?;
        let Self { solver, matcher, values } = self;
        values.clear();
        values.extend(cost.iter().copied().filter(|&value| value < f64::INFINITY));
        if values.is_empty() {
            return Ok(Assignment { col_of_row: vec![UNASSIGNED; rows], cost: 0.0 });
        }
        let none_forbidden = values.len() == cost.len();
        values.sort_unstable_by_key(|&value| ascending(value));
        values.dedup();
        let pairs = match none_forbidden {
            true => rows.min(cols),
            false => matcher.run(cost, rows, cols, values[values.len() - 1], should_continue)?,
        };
        let (mut low, mut high) = (0, values.len() - 1);
        while low < high {
            let middle = low + (high - low) / 2;
            if matcher.run(cost, rows, cols, values[middle], should_continue)? == pairs {
                high = middle;
            } else {
                low = middle + 1;
            }
        }
        let largest = values[low];
        values.clear();
        values.extend(cost.iter().map(|&value| if value <= largest { value } else { f64::INFINITY }));
        let assignment = solver.solve_allowed(values, rows, cols, should_continue)?;
        // Rounding of a penalty could only matter at the edge of the number range; the matching is the safe answer.
        if assignment.pairs().count() == pairs {
            return Ok(assignment);
        }
        matcher.run(cost, rows, cols, largest, should_continue)?;
        let col_of_row = matcher.col_of_row.clone();
        let cost = cost_of(cost, cols, &col_of_row);
        Ok(Assignment { col_of_row, cost })
    }
}

/// Hopcroft–Karp on the pairs with a cost up to a threshold.
#[derive(Debug, Default)]
pub(crate) struct Matcher {
    edges: Vec<u32>,
    /// `[rows + 1]` where each row's edges start.
    start: Vec<usize>,
    pub(crate) col_of_row: Vec<u32>,
    row_of_col: Vec<u32>,
    layer: Vec<u32>,
    queue: Vec<u32>,
    /// `[rows]` next edge to try.
    cursor: Vec<usize>,
    path: Vec<u32>,
}

impl Matcher {
    /// Size of the largest matching. `should_continue` is called before every round of paths of the same length.
    pub(crate) fn run(
        &mut self,
        cost: &[f64],
        rows: usize,
        cols: usize,
        threshold: f64,
        should_continue: &dyn Fn() -> bool,
    ) -> Result<usize, AssignError> {
        if !should_continue() {
            return Err(AssignError::Interrupted);
        }
        self.edges.clear();
        self.start.clear();
        self.start.push(0);
        for row in cost.chunks_exact(cols) {
            self.edges.extend((0..cols as u32).filter(|&col| row[col as usize] <= threshold));
            self.start.push(self.edges.len());
        }
        self.col_of_row.clear();
        self.col_of_row.resize(rows, UNASSIGNED);
        self.row_of_col.clear();
        self.row_of_col.resize(cols, NONE);
        let mut matched = 0;
        while self.layers(rows) {
            if !should_continue() {
                return Err(AssignError::Interrupted);
            }
            self.cursor.clear();
            self.cursor.extend_from_slice(&self.start[..rows]);
            for row in 0..rows as u32 {
                if self.col_of_row[row as usize] == UNASSIGNED && self.extend(row) {
                    matched += 1;
                }
            }
        }
        Ok(matched)
    }

    /// Breadth-first layers of rows from the free ones; true if a free column can be reached.
    fn layers(&mut self, rows: usize) -> bool {
        self.layer.clear();
        self.layer.resize(rows, NONE);
        self.queue.clear();
        for row in 0..rows {
            if self.col_of_row[row] == UNASSIGNED {
                self.layer[row] = 0;
                self.queue.push(row as u32);
            }
        }
        let (mut head, mut reached) = (0, false);
        while head < self.queue.len() {
            let row = self.queue[head] as usize;
            head += 1;
            for &col in &self.edges[self.start[row]..self.start[row + 1]] {
                let owner = self.row_of_col[col as usize];
                if owner == NONE {
                    reached = true;
                } else if self.layer[owner as usize] == NONE {
                    self.layer[owner as usize] = self.layer[row] + 1;
                    self.queue.push(owner);
                }
            }
        }
        reached
    }

    /// Depth-first search down the layers with an explicit stack (paths can be as long as there are rows).
    fn extend(&mut self, start: u32) -> bool {
        self.path.clear();
        self.path.push(start);
        while let Some(&row) = self.path.last() {
            let row = row as usize;
            if self.cursor[row] == self.start[row + 1] {
                self.layer[row] = NONE;
                self.path.pop();
                continue;
            }
            let col = self.edges[self.cursor[row]];
            self.cursor[row] += 1;
            let owner = self.row_of_col[col as usize];
            if owner == NONE {
                // The last row takes the free column; every row before it takes the column of its successor.
                let mut col = col;
                while let Some(row) = self.path.pop() {
                    self.row_of_col[col as usize] = row;
                    col = std::mem::replace(&mut self.col_of_row[row as usize], col);
                }
                return true;
            }
            if self.layer[owner as usize] == self.layer[row].wrapping_add(1) && self.layer[row] != NONE {
                self.path.push(owner);
            }
        }
        false
    }
}
