//! Pairs that are in force, and what leaving them costs.

use crate::{AssignError, LARGEST_COST, Result, UNASSIGNED};

/// Current pairs.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Switching<'a> {
    /// `[rows]` current column of each row, or [`UNASSIGNED`]; empty without current pairs.
    pub current: &'a [u32],
    /// Cost of a row that does not keep its current column, in the unit of the costs.
    pub cost: f64,
}

impl Switching<'_> {
    /// Whether the pair is in force.
    pub(crate) fn holds(&self, row: usize, col: usize) -> bool {
        self.current.get(row).is_some_and(|&current| current as usize == col)
    }

    pub(crate) fn check(&self, rows: usize, cols: usize) -> Result<()> {
        if !(0.0..=LARGEST_COST).contains(&self.cost) {
            let problem = format!("{} is not a number from 0 to {LARGEST_COST:e}", self.cost);
            return Err(AssignError::invalid("switching_cost", problem));
        }
        if self.current.is_empty() {
            return Ok(());
        }
        if self.current.len() != rows {
            return Err(crate::invalid_size("current", self.current.len(), rows));
        }
        let mut taken = vec![false; cols];
        for (row, &col) in self.current.iter().enumerate().filter(|&(_, &col)| col != UNASSIGNED) {
            match taken.get_mut(col as usize) {
                Some(taken) if !*taken => *taken = true,
                Some(_) => return Err(AssignError::invalid(format!("current[{row}]"), format!("column {col} twice"))),
                None => {
                    let problem = format!("{col} is not below {cols} columns");
                    return Err(AssignError::invalid(format!("current[{row}]"), problem));
                }
            }
        }
        Ok(())
    }
}
