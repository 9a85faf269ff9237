//! The bottleneck assignment: minimise the largest cost (when the last agent arrives, if all fly at the same speed).
//!
//! Binary search over the sorted costs with Hopcroft & Karp's maximum matching (1973) on the pairs up to the threshold;
//! among the assignments with the smallest largest cost, the one with the smallest sum.

use crate::{AssignError, Assignment, GoOn, Result, Solver, Switching, UNASSIGNED, check_allowed, pairs};

const NONE: u32 = u32::MAX;

/// The solver's memory. Reusing one allocates little but the answers.
#[derive(Debug, Default)]
pub struct BottleneckSolver {
    solver: Solver,
    matcher: Matcher,
    /// The costs up to the threshold.
    values: Vec<f64>,
}

impl BottleneckSolver {
    /// As many pairs of `cost`, row-major `[rows, cols]`, as possible where +∞ forbids a pair; among those the smallest largest
    /// cost, then the smallest sum, then the lowest matching. Costs of d^p make the sum one of d^p among the same smallest
    /// largest distances. Where some pairs are in force, a pair of a row that leaves its column costs the switching cost more;
    /// the number of rows that do comes after the sum. Stops as soon as `go_on` returns false.
    /// Fails as [`Solver::solve_switching`].
    pub fn solve_switching(
        &mut self,
        cost: &[f64],
        rows: usize,
        cols: usize,
        switching: &Switching<'_>,
        go_on: GoOn<'_>,
    ) -> Result<Assignment> {
        check_allowed(cost, rows, cols)?;
        switching.check(rows, cols)?;
        let Self { solver, matcher, values } = self;
        let costs = Costs { cost, rows, cols };
        let found = if pairs(switching.current).next().is_none() || switching.cost == 0.0 {
            costs.search(matcher, values, |place| cost[place], go_on)?
        } else {
            let key = |place: usize| {
                let (row, col) = (place / cols, place % cols);
                let leaves = switching.current[row] != UNASSIGNED && !switching.holds(row, col);
                exact_sum(cost[place], if leaves { switching.cost } else { 0.0 })
            };
            costs.search(matcher, values, key, go_on)?
        };
        if !found {
            return Ok(Assignment { col_of_row: vec![UNASSIGNED; rows], cost: 0.0 });
        }
        solver.solve_switching(values, rows, cols, switching, go_on)
    }
}

/// A sum and what it lost to rounding (Knuth): such pairs sort like the exact sums.
fn exact_sum(a: f64, b: f64) -> (f64, f64) {
    let sum = a + b;
    let shadow = sum - a;
    (sum, (a - (sum - shadow)) + (b - shadow))
}

/// Costs `[rows, cols]`.
struct Costs<'a> {
    cost: &'a [f64],
    rows: usize,
    cols: usize,
}

impl Costs<'_> {
    /// Finds the smallest largest key of a largest matching, and fills `values` with the costs of the pairs up to it and +∞ for
    /// the others. False if all pairs are forbidden.
    fn search<K: PartialOrd + Copy>(
        &self,
        matcher: &mut Matcher,
        values: &mut Vec<f64>,
        key: impl Fn(usize) -> K,
        go_on: GoOn<'_>,
    ) -> Result<bool> {
        let &Self { cost, rows, cols } = self;
        let allowed = |place: &usize| cost[*place] < f64::INFINITY;
        let order = |a: &K, b: &K| a.partial_cmp(b).unwrap_or(std::cmp::Ordering::Equal);
        let mut keys: Vec<K> = (0..cost.len()).filter(allowed).map(&key).collect();
        if keys.is_empty() {
            return Ok(false);
        }
        let key = &key;
        let up_to = |limit: K| move |place: usize| cost[place] < f64::INFINITY && key(place) <= limit;
        let pairs = match keys.len() == cost.len() {
            true => rows.min(cols),
            false => matcher.run(rows, cols, |place| cost[place] < f64::INFINITY, go_on)?,
        };
        keys.sort_unstable_by(order);
        keys.dedup();
        let (mut low, mut high) = (0, keys.len() - 1);
        while low < high {
            let middle = low + (high - low) / 2;
            if matcher.run(rows, cols, up_to(keys[middle]), go_on)? == pairs {
                high = middle;
            } else {
                low = middle + 1;
            }
        }
        let within = up_to(keys[low]);
        values.clear();
        values.extend((0..cost.len()).map(|place| if within(place) { cost[place] } else { f64::INFINITY }));
        Ok(true)
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
    /// Size of the largest matching of allowed places of a matrix `[rows, cols]`. `go_on` is called before every round of paths of the same length.
    pub(crate) fn run(
        &mut self,
        rows: usize,
        cols: usize,
        allowed: impl Fn(usize) -> bool,
        go_on: GoOn<'_>,
    ) -> Result<usize> {
        if !go_on() {
            return Err(AssignError::Interrupted);
        }
        self.edges.clear();
        self.start.clear();
        self.start.push(0);
        for row in 0..rows {
            self.edges.extend((0..cols as u32).filter(|&col| allowed(row * cols + col as usize)));
            self.start.push(self.edges.len());
        }
        self.col_of_row.clear();
        self.col_of_row.resize(rows, UNASSIGNED);
        self.row_of_col.clear();
        self.row_of_col.resize(cols, NONE);
        let mut matched = 0;
        while self.layers(rows) {
            if !go_on() {
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
