//! Greedy assignment: the globally cheapest pair first.

use crate::{AssignError, Assignment, UNASSIGNED, check_allowed, check_costs, cost_of};

/// Takes the cheapest remaining pair until one side is used up; ties go to the lowest (row, column). `cost` is
/// row-major `[rows, cols]`.
///
/// # Errors
/// As [`crate::Solver::solve`].
pub fn greedy(cost: &[f64], rows: usize, cols: usize) -> Result<Assignment, AssignError> {
    check_costs(cost, rows, cols)?;
    Ok(take(cost, rows, cols))
}

/// The same where a cost of +∞ forbids a pair. It may end with fewer pairs than are possible.
///
/// # Errors
/// As [`crate::Solver::solve_allowed`].
pub fn greedy_allowed(cost: &[f64], rows: usize, cols: usize) -> Result<Assignment, AssignError> {
    check_allowed(cost, rows, cols)?;
    Ok(take(cost, rows, cols))
}

fn take(cost: &[f64], rows: usize, cols: usize) -> Assignment {
    let allowed = cost.iter().enumerate().filter(|&(_, &value)| value < f64::INFINITY);
    let mut order: Vec<(u64, u64)> = allowed.map(|(place, &value)| (ascending(value), place as u64)).collect();
    order.sort_unstable();
    let mut col_of_row = vec![UNASSIGNED; rows];
    let mut taken = vec![false; cols];
    let mut left = rows.min(cols);
    for (_, place) in order {
        let (row, col) = (place as usize / cols, place as usize % cols);
        if col_of_row[row] == UNASSIGNED && !taken[col] {
            col_of_row[row] = col as u32;
            taken[col] = true;
            left -= 1;
            if left == 0 {
                break;
            }
        }
    }
    let cost = cost_of(cost, cols, &col_of_row);
    Assignment { col_of_row, cost }
}

/// Bits that sort like the finite number they come from; −0 sorts as +0.
pub(crate) fn ascending(value: f64) -> u64 {
    let bits = (value + 0.0).to_bits();
    if bits >> 63 == 1 { !bits } else { bits | 1 << 63 }
}
