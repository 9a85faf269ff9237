//! Random assignment: the baseline of a commander.

use crate::bottleneck::Matcher;
use crate::{GoOn, Result, UNASSIGNED, check_allowed, check_shape};
use magex_core::rng::Stream;

/// A uniformly random matching of min(rows, cols) pairs: the column of each row. Fails without rows or columns.
pub fn random(rows: usize, cols: usize, stream: &mut Stream) -> Result<Vec<u32>> {
    check_shape(rows, cols)?;
    let mut col_of_row = stream.permutation(rows.max(cols));
    col_of_row.truncate(rows);
    for col in &mut col_of_row {
        // With more rows than columns, numbers beyond the last column mean no partner.
        if *col >= cols as u32 {
            *col = UNASSIGNED;
        }
    }
    Ok(col_of_row)
}

/// A random matching of as many pairs as possible where a cost of +∞ forbids a pair; uniform only if none is forbidden.
/// Stops as soon as `go_on` returns false. Fails as [`crate::Solver::solve_allowed`].
pub fn random_allowed(cost: &[f64], rows: usize, cols: usize, draws: &mut Stream, go_on: GoOn<'_>) -> Result<Vec<u32>> {
    if check_allowed(cost, rows, cols)?.forbidden == 0 {
        return random(rows, cols, draws);
    }
    // A largest matching of a shuffled problem.
    let (row_order, col_order) = (draws.permutation(rows), draws.permutation(cols));
    let entry =
        |row: &u32, col: &u32| if cost[*row as usize * cols + *col as usize] < f64::INFINITY { 0.0 } else { 1.0 };
    let shuffled: Vec<f64> =
        row_order.iter().flat_map(|row| col_order.iter().map(move |col| entry(row, col))).collect();
    let mut matcher = Matcher::default();
    matcher.run(rows, cols, |place| shuffled[place] == 0.0, go_on)?;
    let mut col_of_row = vec![UNASSIGNED; rows];
    for (place, &row) in row_order.iter().enumerate() {
        if let Some(&col) = col_order.get(matcher.col_of_row[place] as usize) {
            col_of_row[row as usize] = col;
        }
    }
    Ok(col_of_row)
}
