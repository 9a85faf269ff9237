//! Local search: exchange the goals of two agents while that shortens the sum.

use crate::{AssignError, UNASSIGNED, check_costs, cost_of};

/// Improves an assignment in place until no exchange of two rows' columns, and no move of a row to an unused column,
/// lowers the sum, or until `sweeps` passes over all pairs are done. Returns the new cost. An exchange must gain more
/// than 1e-12 of the costs it touches, so rounding cannot make it run in circles.
///
/// # Errors
/// As [`crate::Solver::solve`], and a column list of the wrong length or with a column that does not exist or occurs
/// twice; the list is then unchanged.
pub fn two_swap(
    cost: &[f64],
    rows: usize,
    cols: usize,
    col_of_row: &mut [u32],
    sweeps: usize,
) -> Result<f64, AssignError> {
    check_costs(cost, rows, cols)?;
    let mut unused = unused_columns(rows, cols, col_of_row)?;
    let at = |row: usize, col: u32| if col == UNASSIGNED { 0.0 } else { cost[row * cols + col as usize] };
    let gains = |before: f64, after: f64| after < before - 1e-12 * before.abs().max(after.abs());
    for _ in 0..sweeps {
        let mut changed = false;
        for row in 0..rows {
            for other in row + 1..rows {
                let (a, b) = (col_of_row[row], col_of_row[other]);
                if gains(at(row, a) + at(other, b), at(row, b) + at(other, a)) {
                    col_of_row.swap(row, other);
                    changed = true;
                }
            }
            if col_of_row[row] != UNASSIGNED {
                for col in &mut unused {
                    if gains(at(row, col_of_row[row]), at(row, *col)) {
                        std::mem::swap(&mut col_of_row[row], col);
                        changed = true;
                    }
                }
            }
        }
        if !changed {
            break;
        }
    }
    Ok(cost_of(cost, cols, col_of_row))
}

fn unused_columns(rows: usize, cols: usize, col_of_row: &[u32]) -> Result<Vec<u32>, AssignError> {
    if col_of_row.len() != rows {
        return Err(AssignError::Size { field: "col_of_row", found: col_of_row.len(), expected: rows });
    }
    let mut used = vec![false; cols];
    for &col in col_of_row.iter().filter(|&&col| col != UNASSIGNED) {
        match used.get_mut(col as usize) {
            Some(used) if !*used => *used = true,
            _ => {
                let remedy = "every column must exist and occur once";
                return Err(AssignError::Parameter { field: "col_of_row", value: f64::from(col), remedy });
            }
        }
    }
    Ok((0..cols as u32).filter(|&col| !used[col as usize]).collect())
}
