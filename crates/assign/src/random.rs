//! Random assignment: the lower bound a commander is measured against.

use crate::{AssignError, UNASSIGNED, check_shape};
use magex_core::rng::Stream;

/// A uniformly random matching of min(rows, cols) pairs: the column of each row, or [`UNASSIGNED`].
///
/// # Errors
/// No rows or no columns.
pub fn random(rows: usize, cols: usize, stream: &mut Stream) -> Result<Vec<u32>, AssignError> {
    check_shape(rows, cols)?;
    let mut col_of_row = stream.permutation(rows.max(cols));
    col_of_row.truncate(rows);
    for col in &mut col_of_row {
        // With more rows than columns, the numbers beyond the last column are the places without a partner.
        if *col >= cols as u32 {
            *col = UNASSIGNED;
        }
    }
    Ok(col_of_row)
}
