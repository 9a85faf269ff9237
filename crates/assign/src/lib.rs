//! Assignment of agents to goals by distance.
//!
//! [`exact`] is the optimum (the Hungarian baseline C_h of the paper's eq. 4), [`bottleneck`] minimises the longest distance
//! instead of the sum, [`greedy()`] and [`random`] are the baselines a learned commander is compared with, and [`duals`] are
//! entropic transport prices, a feature for such a commander. [`solve_points`], [`bottleneck_points`] and [`solve_pairs`] give
//! the same answers without a cost matrix, for thousands of agents.
//!
//! Costs are row-major `[rows, cols]`: rows are agents, columns are goals. Either side may be the longer one; it then
//! keeps members without a partner, marked [`UNASSIGNED`].
//!
//! # What is minimised
//!
//! In this order, each among the answers that are best by those before it:
//!
//! 1. No pair is forbidden (a cost of +∞ forbids a pair).
//! 2. The most pairs.
//! 3. Bottleneck only: the largest cost of a pair, which is the switching cost more where the row leaves its current column.
//! 4. Summed cost + switching cost × rows that do not keep their current column ([`Switching`]).
//! 5. The fewest rows that do not keep their current column.
//! 6. The lowest matching: row 0 has the lowest column that the best answers give it, then row 1, and so on; no column counts as
//!    the highest.
//!
//! Costs are the doubles that are given, and their sums are compared as if they were added without rounding: 0.1 + 0.2 is more
//! than 0.3, because these doubles are. Give whole numbers where sums of decimals should tie, for example cents. Neither the
//! range of the costs nor the size of the problem matters, so a pair of 10^50 that cannot be avoided leaves the others exact.
//! There is one answer to every problem, the same from every solver of this crate; [`solve_points`] names the only exception.

#![allow(
    clippy::needless_range_loop,
    reason = "kernels index several arrays by one counter; iterators hide which elements meet"
)]

use magex_core::error::FieldError;
use thiserror::Error;

pub mod bottleneck;
pub mod duals;
pub mod exact;
mod fixed;
pub mod greedy;
mod points;
pub mod random;
mod sparse;
mod strongly_connected;
mod switching;
mod ties;

pub use bottleneck::BottleneckSolver;
pub use exact::Solver;
pub use greedy::greedy;
pub use points::{
    LARGEST_COORDINATE, POWERS, cost_of_points, costs_into, distance, distances_into, powered, powered_square,
};
pub use sparse::{AllowedPairs, PointProblem, bottleneck_points, exact_points, solve_pairs, solve_points};
pub use switching::Switching;

/// An answer, or why there is none.
pub type Result<T> = std::result::Result<T, AssignError>;

/// Whether to go on, asked now and then by whatever may take long; `false` ends it with [`AssignError::Interrupted`].
pub type GoOn<'a> = &'a dyn Fn() -> bool;

/// Stands in [`Assignment::col_of_row`] for a row without a partner (only when there are more rows than columns).
pub const UNASSIGNED: u32 = u32::MAX;

/// Largest magnitude of a cost. Sums along a path of any length stay finite below it.
pub const LARGEST_COST: f64 = 1e300;

/// Why an assignment problem has no answer.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum AssignError {
    /// A size or a number is invalid.
    #[error(transparent)]
    Invalid(#[from] FieldError),
    /// The caller cancelled.
    #[error("interrupted before an answer was found")]
    Interrupted,
}

impl AssignError {
    /// A problem with a field.
    pub fn invalid(field: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::Invalid(FieldError::new(field, problem))
    }
}

/// A matching of min(rows, cols) pairs.
#[derive(Debug, Clone, PartialEq)]
pub struct Assignment {
    /// `[rows]` column of each row, or [`UNASSIGNED`].
    pub col_of_row: Vec<u32>,
    /// Sum of the chosen costs (compensated summation).
    pub cost: f64,
}

impl Assignment {
    /// (row, column) of every pair, rows ascending.
    pub fn pairs(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        pairs(&self.col_of_row)
    }
}

/// (row, column) of every pair of a column list, rows ascending.
pub fn pairs(col_of_row: &[u32]) -> impl Iterator<Item = (usize, usize)> + '_ {
    col_of_row.iter().enumerate().filter(|&(_, &col)| col != UNASSIGNED).map(|(row, &col)| (row, col as usize))
}

/// Sum of the costs `[rows, cols]` chosen by a column list, in row order with Neumaier's compensation.
pub fn cost_of(cost: &[f64], cols: usize, col_of_row: &[u32]) -> f64 {
    compensated_sum(pairs(col_of_row).map(|(row, col)| cost[row * cols + col]))
}

/// Sum with Neumaier's compensation.
pub fn compensated_sum(terms: impl Iterator<Item = f64>) -> f64 {
    let (mut sum, mut lost) = (0.0f64, 0.0f64);
    for term in terms {
        let next = sum + term;
        lost += if sum.abs() >= term.abs() { (sum - next) + term } else { (term - next) + sum };
        sum = next;
    }
    sum + lost
}

/// Checks shape and entries of a cost matrix `[rows, cols]`.
fn check_costs(cost: &[f64], rows: usize, cols: usize) -> Result<()> {
    check_size(cost.len(), rows, cols)?;
    // Counting instead of searching vectorises.
    if cost.iter().filter(|&&value| !usable(value)).count() == 0 {
        return Ok(());
    }
    let place = cost.iter().position(|&value| !usable(value)).unwrap_or_default();
    Err(invalid_entry(place, cols, cost[place]))
}

/// What [`check_allowed`] learns about a matrix in which +∞ forbids a pair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Span {
    /// Forbidden pairs.
    pub(crate) forbidden: usize,
    /// Least cost of the others; +∞ if there are none.
    pub(crate) least: f64,
    /// Largest cost of the others; −∞ if there are none.
    pub(crate) largest: f64,
}

impl Span {
    /// A price of forbidden pairs, above all that others could save, and so low that the others keep their digits.
    pub(crate) fn penalty(&self, pairs: usize) -> f64 {
        if self.least > self.largest {
            return 1.0;
        }
        let range = self.largest - self.least;
        let step = range.max(self.largest.abs() * 1e-9).max(f64::MIN_POSITIVE);
        self.largest + pairs as f64 * range + step
    }
}

/// Checks shape and entries of a cost matrix `[rows, cols]` in which +∞ forbids a pair.
pub(crate) fn check_allowed(cost: &[f64], rows: usize, cols: usize) -> Result<Span> {
    check_size(cost.len(), rows, cols)?;
    let mut span = Span { forbidden: 0, least: f64::INFINITY, largest: f64::NEG_INFINITY };
    for (block, values) in cost.chunks(BLOCK).enumerate() {
        let lower = |a: f64, b: f64| if b < a { b } else { a };
        let higher = |a: f64, b: f64| if b > a { b } else { a };
        // Without a branch per entry, this and the count are vectors.
        if values.iter().filter(|&&value| !usable(value)).count() == 0 {
            let (mut least, mut largest) = ([f64::INFINITY; 8], [f64::NEG_INFINITY; 8]);
            let (chunks, rest) = values.as_chunks::<8>();
            for values in chunks {
                for lane in 0..8 {
                    least[lane] = lower(least[lane], values[lane]);
                    largest[lane] = higher(largest[lane], values[lane]);
                }
            }
            span.least = least.iter().chain(rest).copied().fold(span.least, lower);
            span.largest = largest.iter().chain(rest).copied().fold(span.largest, higher);
            continue;
        }
        for (place, &value) in values.iter().enumerate() {
            if usable(value) {
                span.least = lower(span.least, value);
                span.largest = higher(span.largest, value);
            } else if value == f64::INFINITY {
                span.forbidden += 1;
            } else {
                return Err(invalid_entry(block * BLOCK + place, cols, value));
            }
        }
    }
    Ok(span)
}

/// Entries that are checked together.
const BLOCK: usize = 1024;

/// False for NaN too.
fn usable(cost: f64) -> bool {
    cost.abs() <= LARGEST_COST
}

fn invalid_entry(place: usize, cols: usize, value: f64) -> AssignError {
    let (row, col) = (place / cols, place % cols);
    AssignError::invalid(format!("cost[{row}][{col}]"), format!("{value} is not a finite number up to 1e300"))
}

fn check_shape(rows: usize, cols: usize) -> Result<()> {
    let problem = match (rows.min(cols), rows.max(cols)) {
        (0, _) => "is empty; both must be at least 1",
        (_, 0x8000_0000..) => "is too large; both must be below 2^31",
        _ => return Ok(()),
    };
    Err(AssignError::invalid("cost", format!("{rows} rows by {cols} columns {problem}")))
}

/// Checks a shape and the number of its entries.
fn check_size(found: usize, rows: usize, cols: usize) -> Result<()> {
    check_shape(rows, cols)?;
    // A product that overflows cannot be the length of anything, so saturating is enough to refuse it.
    let expected = rows.saturating_mul(cols);
    if found == expected { Ok(()) } else { Err(invalid_size("cost", found, expected)) }
}

fn invalid_size(field: &str, found: usize, expected: usize) -> AssignError {
    AssignError::invalid(field, format!("{found} numbers, the shape asks for {expected}"))
}

#[cfg(test)]
mod tests;
