//! Makes a solution in rounded numbers the exact one, and chooses among equally cheap ones.
//!
//! Input is a matching with prices u (rows) and v (columns) from a solver that rounds. A pair is *nearly tight* if its reduced
//! cost c − u − v is no more than all rounding errors of a matching together could hide. Every matching that is at least as
//! cheap consists of nearly tight pairs, and differs from the solution by cycles in the graph in which a row points at the
//! owners of its nearly tight columns (a column that may stay alone belongs to the *pool*). So:
//!
//! 1. Without a cycle the solution is the only optimum. This is the usual case; it costs one look at the costs.
//! 2. Otherwise [`repair`] solves the parts with cycles again, in whole numbers without rounding, where a current pair wins
//!    among equals, and finds the pairs that are exactly tight: those of the optima, and no others.
//! 3. [`lowest`] chooses the lowest of these optima: row 0 takes the lowest column it can, then row 1, and so on.
//!
//! So the answer is a function of the problem alone, not of the solver.

mod components;
mod lowest;
mod repair;

use crate::{GoOn, Result};
use components::Components;

/// Nearly tight pairs per row above which a look for cycles would be longer than what follows.
const MANY: usize = 8;

/// No partner.
pub(crate) const NONE: u32 = u32::MAX;

/// What the pairs of a problem cost, without rounding.
pub(crate) trait Exact {
    /// Two doubles that sum to the cost of the pair of a row and a column.
    fn terms(&self, row: usize, col: usize) -> [f64; 2];
    /// Whether the pair is in force.
    fn current(&self, row: usize, col: usize) -> bool;
    /// Whether the pair stands for having no partner.
    fn forbidden(&self, row: usize, col: usize) -> bool;
    /// The answer is the lowest one for the columns: column 0 takes the lowest row it can, and so on.
    fn by_columns(&self) -> bool;
}

/// A solution in rounded numbers; no more rows than columns, and every row has a column.
pub(crate) struct Solution<'a> {
    /// `[rows]`
    pub(crate) row_price: &'a [f64],
    /// `[cols]`; a column without a row has the price 0, the others no more, if there are more columns than rows.
    pub(crate) col_price: &'a [f64],
    /// `[rows]`
    pub(crate) col_of_row: &'a mut [u32],
    /// `[cols]`
    pub(crate) row_of_col: &'a mut [u32],
}

/// Nearly tight pairs: of each row its columns, ascending, its own one among them.
#[derive(Debug, Clone, Default)]
pub(crate) struct Graph {
    /// `[rows + 1]` where each row's columns start.
    pub(crate) start: Vec<usize>,
    pub(crate) cols: Vec<u32>,
}

impl Graph {
    /// Without rows.
    pub(crate) fn clear(&mut self) {
        self.start.clear();
        self.start.push(0);
        self.cols.clear();
    }

    /// The columns pushed since the last row are those of the next row.
    pub(crate) fn end_row(&mut self) {
        self.start.push(self.cols.len());
    }

    pub(crate) fn rows(&self) -> usize {
        self.start.len() - 1
    }

    pub(crate) fn of(&self, row: usize) -> &[u32] {
        &self.cols[self.start[row]..self.start[row + 1]]
    }
}

/// Buffers of the usual case: small problems would spend a good part of their time on allocating them.
#[derive(Debug, Clone, Default)]
pub(crate) struct Memory {
    degree: Vec<u32>,
    ready: Vec<u32>,
}

/// More than the rounding errors of the reduced costs of a matching of `pairs` pairs can be, where the prices of rows and of
/// columns are no larger than these. A reduced cost is wrong by 2^-53 of the magnitude of each of its few partial sums.
pub(crate) fn tolerance(pairs: usize, largest_row_price: f64, largest_col_price: f64) -> f64 {
    const UNIT: f64 = 1.0 / (1u64 << 49) as f64;
    (pairs + 2) as f64 * UNIT * (largest_row_price + largest_col_price)
}

/// Makes `solution` the lowest optimum. `near` are its nearly tight pairs within `tolerance`.
pub(crate) fn settle(
    near: &Graph,
    tolerance: f64,
    solution: &mut Solution<'_>,
    exact: &impl Exact,
    memory: &mut Memory,
    go_on: GoOn<'_>,
) -> Result<()> {
    let spare_columns = solution.col_price.len() > near.rows();
    if near.cols.len() > MANY * near.rows() {
        // Costs of a few values: as a rule all these pairs are exactly tight, and there is nothing to take apart.
        if let Some(spare) = repair::tight_already(near, &|_| spare_columns, solution, exact) {
            return lowest::lowest(near, &spare, solution, exact, go_on);
        }
    } else if components::has_no_cycle(near, tolerance, solution, memory) {
        // Most problems end here.
        return Ok(());
    }
    let pooled = components::pooled(tolerance, solution);
    let parts = Components::of(near, solution.row_of_col, &pooled);
    let tied = parts.inner(near);
    let tight = repair::repair(&tied, &parts, solution, exact, go_on)?;
    lowest::lowest(&tight.graph, &tight.spare, solution, exact, go_on)
}
