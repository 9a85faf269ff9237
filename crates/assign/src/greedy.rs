//! Greedy assignment: the globally cheapest pair first.

use crate::{AssignError, Assignment, GoOn, Result, UNASSIGNED, check_allowed, cost_of};

/// Pairs that are sorted at once.
const CHUNK: usize = 1 << 16;

/// Takes the cheapest remaining pair of `cost` `[rows, cols]` until one side is used up; ties go to the lowest (row, column),
/// and +∞ forbids a pair. Stops as soon as `go_on` returns false. Fails as [`crate::Solver::solve_allowed`].
pub fn greedy(cost: &[f64], rows: usize, cols: usize, go_on: GoOn<'_>) -> Result<Assignment> {
    check_allowed(cost, rows, cols)?;
    let allowed = cost.iter().enumerate().filter(|&(_, &value)| value < f64::INFINITY);
    let mut order: Vec<(u64, u64)> = allowed.map(|(place, &value)| (ascending(value), place as u64)).collect();
    let mut col_of_row = vec![UNASSIGNED; rows];
    let mut taken = vec![false; cols];
    let mut left = rows.min(cols);
    // Put in order as far as it is needed: `ends` are places before which everything is smaller than behind them.
    let (mut start, mut ends) = (0, vec![order.len()]);
    while let Some(&end) = ends.last() {
        if left == 0 {
            break;
        }
        // A small problem is solved faster than a cancellation would be noticed.
        if order.len() > CHUNK && !go_on() {
            return Err(AssignError::Interrupted);
        }
        if end - start > CHUNK {
            let middle = (end - start) / 2;
            order[start..end].select_nth_unstable(middle);
            ends.push(start + middle);
            continue;
        }
        order[start..end].sort_unstable();
        for &(_, place) in &order[start..end] {
            let (row, col) = (place as usize / cols, place as usize % cols);
            if left > 0 && col_of_row[row] == UNASSIGNED && !taken[col] {
                col_of_row[row] = col as u32;
                taken[col] = true;
                left -= 1;
            }
        }
        start = end;
        ends.pop();
    }
    let cost = cost_of(cost, cols, &col_of_row);
    Ok(Assignment { col_of_row, cost })
}

/// Bits that sort like the finite number they come from; −0 sorts as +0.
pub(crate) fn ascending(value: f64) -> u64 {
    let bits = (value + 0.0).to_bits();
    if bits >> 63 == 1 { !bits } else { bits | 1 << 63 }
}
