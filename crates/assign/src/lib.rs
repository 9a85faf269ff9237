//! Assignment of agents to goals by distance.
//!
//! [`exact`] is the optimum (the Hungarian baseline C_h of the paper's eq. 4), [`bottleneck`] minimises the longest distance
//! instead of the sum, [`greedy()`] and [`random`] are the baselines a learned commander is compared with, and [`duals`] are
//! entropic transport prices, a feature for such a commander.
//!
//! Costs are row-major `[rows, cols]`: rows are agents, columns are goals. Either side may be the longer one; it then
//! keeps members without a partner, marked [`UNASSIGNED`].

#![allow(
    clippy::needless_range_loop,
    reason = "kernels index several arrays by one counter; iterators hide which elements meet"
)]

use magex_core::error::FieldError;
use thiserror::Error;

pub mod bottleneck;
pub mod duals;
pub mod exact;
pub mod greedy;
pub mod random;

pub use bottleneck::BottleneckSolver;
pub use exact::{Solver, exact_points};
pub use greedy::greedy;

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

/// Euclidean distance of two points, in double precision.
pub fn distance(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum::<f64>().sqrt()
}

/// Summed distance of an assignment, in double precision: agents `[N, dims]`, goals `[G, dims]`, `goal_of` `[N]` the goal of each
/// agent. An agent without a goal ([`UNASSIGNED`]) costs nothing.
pub fn cost_of_points(agents: &[f32], goals: &[f32], dims: usize, goal_of: &[u32]) -> f64 {
    let mut total = 0.0;
    for (agent, &goal) in agents.chunks_exact(dims).zip(goal_of) {
        let start = goal as usize * dims;
        if let Some(goal) = goals.get(start..start + dims) {
            total += distance(agent, goal);
        }
    }
    total
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
fn check_costs(cost: &[f64], rows: usize, cols: usize) -> Result<(), AssignError> {
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
        (self.largest + pairs as f64 * range + step).min(LARGEST_COST)
    }
}

/// Checks shape and entries of a cost matrix `[rows, cols]` in which +∞ forbids a pair.
pub(crate) fn check_allowed(cost: &[f64], rows: usize, cols: usize) -> Result<Span, AssignError> {
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

fn check_shape(rows: usize, cols: usize) -> Result<(), AssignError> {
    let problem = match (rows.min(cols), rows.max(cols)) {
        (0, _) => "is empty; both must be at least 1",
        (_, 0x8000_0000..) => "is too large; both must be below 2^31",
        _ => return Ok(()),
    };
    Err(AssignError::invalid("cost", format!("{rows} rows by {cols} columns {problem}")))
}

/// Checks a shape and the number of its entries.
fn check_size(found: usize, rows: usize, cols: usize) -> Result<(), AssignError> {
    check_shape(rows, cols)?;
    // A product that overflows cannot be the length of anything, so saturating is enough to refuse it.
    let expected = rows.saturating_mul(cols);
    if found == expected { Ok(()) } else { Err(invalid_size("cost", found, expected)) }
}

fn invalid_size(field: &str, found: usize, expected: usize) -> AssignError {
    AssignError::invalid(field, format!("{found} numbers, the shape asks for {expected}"))
}

/// Distances `[rows, cols]` in f64 between agents `[rows, dims]` and goals `[cols, dims]`; returns (rows, cols).
/// Fails for empty or ragged arrays and coordinates that are not finite.
pub fn distances_into(
    agents: &[f32],
    goals: &[f32],
    dims: usize,
    cost: &mut Vec<f64>,
) -> Result<(usize, usize), AssignError> {
    if dims == 0 {
        return Err(AssignError::invalid("dims", "0 is out of range; use at least 1"));
    }
    for (field, points) in [("agents", agents), ("goals", goals)] {
        if !points.len().is_multiple_of(dims) {
            return Err(invalid_size(field, points.len(), points.len().div_ceil(dims) * dims));
        }
        if let Some(place) = points.iter().position(|x| !x.is_finite()) {
            let path = format!("{field}[{}][{}]", place / dims, place % dims);
            return Err(AssignError::invalid(path, format!("{} is not finite", points[place])));
        }
    }
    let (rows, cols) = (agents.len() / dims, goals.len() / dims);
    check_shape(rows, cols)?;
    cost.clear();
    cost.reserve(rows * cols);
    for agent in agents.chunks_exact(dims) {
        if let &[x, y] = agent {
            let (x, y) = (f64::from(x), f64::from(y));
            cost.extend(goals.as_chunks::<2>().0.iter().map(|&[gx, gy]| {
                let (dx, dy) = (x - f64::from(gx), y - f64::from(gy));
                (dx * dx + dy * dy).sqrt()
            }));
        } else {
            cost.extend(goals.chunks_exact(dims).map(|goal| {
                let square = |(&a, &g): (&f32, &f32)| (f64::from(a) - f64::from(g)) * (f64::from(a) - f64::from(g));
                agent.iter().zip(goal).map(square).sum::<f64>().sqrt()
            }));
        }
    }
    Ok((rows, cols))
}

#[cfg(test)]
mod tests;
