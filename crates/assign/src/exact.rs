//! The minimum-cost assignment, rectangular, in f64.
//!
//! Jonker & Volgenant 1987: column reduction, reduction transfer, one pass of augmenting row reduction (a second costs more
//! than it saves), then shortest augmenting paths (dense Dijkstra). With fewer rows than columns the column reduction is left
//! out: a column that stays alone must keep the price 0, and only columns with a partner are repriced later.
//!
//! Floating point: row prices are never stored (they follow from the matched entry), a repricing that rounds to nothing
//! does not count as progress, and the number of displacements is bounded, so no input can cycle. What rounding leaves open is
//! decided without it afterwards (`ties`).

mod problem;
mod scan;
mod shortlist;

use crate::ties::{self, Graph, Memory, NONE, Solution};
use crate::{AssignError, Assignment, GoOn, Result, Switching, UNASSIGNED, check_costs, cost_of};
use problem::Matrix;
use scan::{LANES, find, higher, least, lower, nearest_column, nearly_tight, relax, two_least};
use shortlist::{Shortlists, WORTH_IT};

/// The solver's memory. Reusing one solver allocates little but the answers.
#[derive(Debug, Clone, Default)]
pub struct Solver {
    /// `[rows, stride]` with rows ≤ cols ≤ stride; +∞ in the padding. Not used for costs that have this form as they are.
    cost: Vec<f64>,
    stride: usize,
    /// `[stride]` dual price of each column.
    price: Vec<f64>,
    /// `[stride]` the prices, −∞ where a column already belongs to the shortest-path tree.
    open_price: Vec<f64>,
    /// `[stride]` length of the shortest path to each column, +∞ in the tree.
    distance: Vec<f64>,
    /// Rows in the order they joined the tree, the free row first.
    tree: Vec<Branch>,
    /// `[stride]` cheapest row of each column.
    cheapest: Vec<u32>,
    row_of_col: Vec<u32>,
    col_of_row: Vec<u32>,
    free: Vec<u32>,
    still_free: Vec<u32>,
    shortlists: Shortlists,
    /// Columns from which on there are shortlists, if not the usual number.
    pub(crate) lists_from: Option<usize>,
    /// Rows of the tree of which only the shortlist was looked at: index in the tree, and what the rest cannot undercut.
    unread: Vec<(usize, f64)>,
    /// `[rows]` dual price of each row, once all have a column.
    row_price: Vec<f64>,
    near: Graph,
    memory: Memory,
}

/// A row of the shortest-path tree.
#[derive(Debug, Clone, Copy)]
struct Branch {
    row: u32,
    /// The row's price for its own column, less the length of the path there: what its other columns add it to.
    offset: f64,
    /// The row's own column, by which it was reached.
    col: u32,
    /// Length of the path to that column.
    length: f64,
}

impl Solver {
    /// The assignment of min(rows, cols) pairs with the smallest summed cost, the lowest one of several; `cost` is row-major
    /// `[rows, cols]`.
    /// Fails for mismatched shapes, and at the first entry that is NaN, infinite or beyond 1e300.
    pub fn solve(&mut self, cost: &[f64], rows: usize, cols: usize) -> Result<Assignment> {
        check_costs(cost, rows, cols)?;
        self.solve_matrix(&Matrix::new(cost, rows, cols), &|| true)
    }

    /// The same where a cost of +∞ forbids a pair: as many pairs as possible, and among those the smallest summed cost.
    /// Stops as soon as `go_on` returns false; it is called once per shortest-path search.
    pub fn solve_allowed(&mut self, cost: &[f64], rows: usize, cols: usize, go_on: GoOn<'_>) -> Result<Assignment> {
        self.solve_switching(cost, rows, cols, &Switching::default(), go_on)
    }

    /// The same where some pairs are in force: minimises summed cost + switching cost × rows that leave their column, then the
    /// number of rows that do. [`Assignment::cost`] is the summed cost alone.
    /// Fails for current pairs beyond the matrix or of one column twice, and a switching cost outside 0 ..= 1e300, too.
    pub fn solve_switching(
        &mut self,
        cost: &[f64],
        rows: usize,
        cols: usize,
        switching: &Switching<'_>,
        go_on: GoOn<'_>,
    ) -> Result<Assignment> {
        self.solve_matrix(&Matrix::check(cost, rows, cols, switching)?, go_on)
    }

    /// Dual prices of the rows of a cost matrix `[n, n]`.
    pub(crate) fn row_prices(&mut self, cost: &[f64], n: usize, go_on: GoOn<'_>) -> Result<Vec<f64>> {
        let mut own = std::mem::take(&mut self.cost);
        self.stride = n.next_multiple_of(LANES);
        Matrix::new(cost, n, n).load(&mut own, self.stride);
        let solved = self.run(&own, n, n, go_on);
        self.cost = own;
        solved?;
        let price = |(row, &col): (usize, &u32)| cost[row * n + col as usize] - self.price[col as usize];
        Ok(self.col_of_row.iter().enumerate().map(price).collect())
    }

    /// Solves what was checked.
    fn solve_matrix(&mut self, matrix: &Matrix<'_>, go_on: GoOn<'_>) -> Result<Assignment> {
        let &Matrix { cost, rows, cols, .. } = matrix;
        let wide = rows <= cols;
        let mut own = std::mem::take(&mut self.cost);
        self.stride = rows.max(cols).next_multiple_of(LANES);
        // A copy of a large matrix would take as long as a good part of the solution.
        let as_it_is = wide && self.stride == cols && matrix.is_plain();
        if !as_it_is {
            matrix.load(&mut own, self.stride);
        }
        let used = if as_it_is { cost } else { &own };
        let solved = self.run(used, rows.min(cols), rows.max(cols), go_on);
        let settled = solved.and_then(|()| self.settle(used, matrix, go_on));
        self.cost = own;
        settled?;
        let mut col_of_row: Vec<u32> = if wide {
            self.col_of_row.clone()
        } else {
            // Solved as the transpose: the solver's columns are our rows, its padding is not.
            self.row_of_col[..rows].iter().map(|&col| if col == NONE { UNASSIGNED } else { col }).collect()
        };
        if matrix.penalty.is_some() {
            for (row, col) in col_of_row.iter_mut().enumerate() {
                if *col != UNASSIGNED && cost[row * cols + *col as usize] == f64::INFINITY {
                    *col = UNASSIGNED;
                }
            }
        }
        let cost = cost_of(cost, cols, &col_of_row);
        Ok(Assignment { col_of_row, cost })
    }

    /// Makes the matching that was found the exact one, and the lowest of several.
    fn settle(&mut self, cost: &[f64], matrix: &Matrix<'_>, go_on: GoOn<'_>) -> Result<()> {
        let (rows, cols) = (matrix.rows.min(matrix.cols), matrix.rows.max(matrix.cols));
        let Self { stride, price, row_price, row_of_col, col_of_row, near, memory, .. } = self;
        let magnitude = |prices: &[f64]| prices.iter().fold(0.0f64, |largest, price| largest.max(price.abs()));
        row_price.clear();
        row_price.extend(
            cost.chunks_exact(*stride)
                .zip(col_of_row.iter())
                .map(|(costs, &col)| costs[col as usize] - price[col as usize]),
        );
        let mut tolerance = ties::tolerance(rows, magnitude(row_price), magnitude(&price[..cols]));
        loop {
            near.clear();
            let mut beaten = [0.0; LANES];
            for (costs, &own) in cost.chunks_exact(*stride).zip(row_price.iter()) {
                nearly_tight(costs, price, own, tolerance, &mut beaten, &mut near.cols);
                near.end_row();
            }
            let beaten = rows as f64 * beaten.into_iter().fold(0.0, higher);
            // A repricing that rounds leaves pairs that look better than tight.
            if beaten <= 0.25 * tolerance {
                break;
            }
            tolerance += 8.0 * beaten;
        }
        let row_of_col = &mut row_of_col[..cols];
        let mut solution = Solution { row_price, col_price: &price[..cols], col_of_row, row_of_col };
        ties::settle(near, tolerance, &mut solution, matrix, memory, go_on)
    }

    fn run(&mut self, cost: &[f64], rows: usize, cols: usize, go_on: GoOn<'_>) -> Result<()> {
        let stride = self.stride;
        refill(&mut self.price, stride, 0.0);
        refill(&mut self.row_of_col, stride, NONE);
        refill(&mut self.col_of_row, rows, NONE);
        if cols == 1 {
            self.row_of_col[0] = 0;
            self.col_of_row[0] = 0;
            return Ok(());
        }
        if rows == cols {
            self.reduce_columns(cost, cols);
        }
        self.free.clear();
        self.free.extend((0..rows as u32).filter(|&row| self.col_of_row[row as usize] == NONE));
        self.reduce_rows(cost, rows);
        if self.listed(cols) {
            self.shortlists.reset(rows);
        }
        for next in 0..self.free.len() {
            if !go_on() {
                return Err(AssignError::Interrupted);
            }
            self.augment(cost, cols, self.free[next]);
        }
        Ok(())
    }

    /// Column reduction: each column takes the price of its cheapest row, and the row itself if it is still free. Then the
    /// reduction transfer: a row chosen by one column only lowers that column's price as far as it stays its best.
    fn reduce_columns(&mut self, cost: &[f64], cols: usize) {
        let Self { stride, price, cheapest, row_of_col, col_of_row, still_free, .. } = self;
        price.copy_from_slice(&cost[..*stride]);
        refill(cheapest, *stride, 0);
        for (row, costs) in cost.chunks_exact(*stride).enumerate().skip(1) {
            for ((price, cheapest), &cost) in price.iter_mut().zip(cheapest.iter_mut()).zip(costs) {
                let lower = cost < *price;
                *price = if lower { cost } else { *price };
                *cheapest = if lower { row as u32 } else { *cheapest };
            }
        }
        price[cols..].fill(0.0);
        // `still_free` counts how many columns chose each row.
        refill(still_free, cols, 0);
        for col in (0..cols).rev() {
            let row = cheapest[col] as usize;
            if still_free[row] == 0 {
                col_of_row[row] = col as u32;
                row_of_col[col] = row as u32;
            }
            still_free[row] += 1;
        }
        for row in 0..cols {
            if still_free[row] == 1 {
                let costs = &cost[row * *stride..(row + 1) * *stride];
                // Reduced costs are at least 0 and the row's own column is at 0: the second least is the least other.
                let (_, second) = two_least(costs, price);
                price[col_of_row[row] as usize] -= second;
            }
        }
    }

    /// Augmenting row reduction over the free rows: each takes its cheapest column at a price that makes the second
    /// cheapest as good, and displaces the owner, which searches for another column at once.
    fn reduce_rows(&mut self, cost: &[f64], rows: usize) {
        let Self { stride, price, row_of_col, col_of_row, free, still_free, .. } = self;
        still_free.clear();
        let mut budget = 4 * rows;
        for &first in free.iter() {
            let mut row = first;
            loop {
                let costs = &cost[row as usize * *stride..(row as usize + 1) * *stride];
                let (least, second) = two_least(costs, price);
                let mut col = find(costs, price, least, 0);
                let lowered = price[col] - (second - least);
                let progress = lowered < price[col];
                if progress {
                    price[col] = lowered;
                } else if least == second && row_of_col[col] != NONE {
                    col = find(costs, price, least, col + 1);
                }
                let displaced = std::mem::replace(&mut row_of_col[col], row);
                col_of_row[row as usize] = col as u32;
                if displaced == NONE {
                    break;
                }
                col_of_row[displaced as usize] = NONE;
                budget = budget.saturating_sub(1);
                if !progress || budget == 0 {
                    still_free.push(displaced);
                    break;
                }
                row = displaced;
            }
        }
        std::mem::swap(free, still_free);
    }

    fn listed(&self, cols: usize) -> bool {
        cols >= self.lists_from.unwrap_or(WORTH_IT)
    }

    /// Finds the shortest alternating path from a free row to a free column, reprices the tree and flips the path.
    fn augment(&mut self, cost: &[f64], cols: usize, start: u32) {
        let listed = self.listed(cols);
        let Self { stride, price, open_price, distance, tree, row_of_col, col_of_row, shortlists, unread, .. } = self;
        let stride = *stride;
        open_price.clear();
        open_price.extend_from_slice(price);
        refill(distance, stride, f64::INFINITY);
        tree.clear();
        tree.push(Branch { row: start, offset: 0.0, col: NONE, length: 0.0 });
        let (mut row, mut offset) = (start, 0.0);
        let costs_of = |row: u32| &cost[row as usize * stride..(row as usize + 1) * stride];
        // No path to a column that was not looked at is shorter than this.
        let mut bound = f64::INFINITY;
        unread.clear();
        let (end, shortest) = loop {
            let listed_bound = if listed { shortlists.relax(row, open_price, offset, distance) } else { None };
            let mut nearest = match listed_bound {
                Some(rest) => {
                    unread.push((tree.len() - 1, rest));
                    bound = lower(rest, bound);
                    least(distance)
                }
                None => {
                    let nearest = relax(costs_of(row), open_price, offset, distance);
                    if listed {
                        shortlists.make(row, costs_of(row), price, cols);
                    }
                    nearest
                }
            };
            while nearest >= bound {
                let mut first = 0;
                for (place, &(_, rest)) in unread.iter().enumerate() {
                    first = if rest < unread[first].1 { place } else { first };
                }
                let Branch { row, offset, .. } = tree[unread.swap_remove(first).0];
                nearest = relax(costs_of(row), open_price, offset, distance);
                shortlists.make(row, costs_of(row), price, cols);
                bound = unread.iter().fold(f64::INFINITY, |bound, &(_, rest)| lower(rest, bound));
            }
            let col = nearest_column(distance, nearest, row_of_col);
            if row_of_col[col] == NONE {
                break (col, nearest);
            }
            row = row_of_col[col];
            offset = cost[row as usize * stride + col] - price[col] - nearest;
            tree.push(Branch { row, offset, col: col as u32, length: nearest });
            open_price[col] = f64::NEG_INFINITY;
            distance[col] = f64::INFINITY;
        };
        // Walk back: the row before a column is the first of the tree that gives it its length, to the last bit.
        let (mut col, mut length) = (end, shortest);
        loop {
            let gives =
                |branch: &Branch| cost[branch.row as usize * stride + col] - price[col] - branch.offset == length;
            let Some(branch) = tree.iter().find(|&branch| gives(branch)) else {
                debug_assert!(false, "every length came from a row of the tree");
                break;
            };
            row_of_col[col] = branch.row;
            col_of_row[branch.row as usize] = col as u32;
            if branch.row == start {
                break;
            }
            (col, length) = (branch.col as usize, branch.length);
        }
        for branch in &tree[1..] {
            price[branch.col as usize] += branch.length - shortest;
        }
    }
}

fn refill<T: Copy>(buffer: &mut Vec<T>, length: usize, value: T) {
    buffer.clear();
    buffer.resize(length, value);
}
