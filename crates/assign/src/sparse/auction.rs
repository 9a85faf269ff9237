//! Nearly the final prices: rows bid for their cheapest column, and a row that is outbid bids again.

use super::NONE;
use super::candidates::{COUNT, Candidates, Engine};
use crate::AssignError;

/// Bids per row and stage, at most: what is left then is the shortest paths' work.
const BIDS: usize = 40;
/// ε falls by this from stage to stage.
const FALL: f64 = 0.2;
/// Stages from [`NEAR`] mean differences between the cheapest and the second cheapest column on.
const STAGES: usize = 8;
const NEAR: f64 = 30.0;
/// Where that is too little, because clusters compete that are far apart, a stage with [`TRIAL`] bids per row leaves rows over:
/// then ε begins [`RISE`] stages higher, up to the largest cost / [`FAR`].
const TRIAL: usize = 12;
const RISE: usize = 2;
const FAR: f64 = 16.0;
/// Candidates that are looked up at once while most bids need others: fewer are found sooner.
const FEW: usize = 8;

impl<C: Candidates> Engine<C> {
    /// Gives most rows a column that is one of their cheapest. With as many rows as columns, stages of falling ε; otherwise a
    /// column must keep the price 0 until it is taken, and once taken it never becomes free again: one stage without ε.
    pub(super) fn auction(&mut self, should_continue: &dyn Fn() -> bool) -> Result<(), AssignError> {
        let rows = self.col_of_row.len();
        let mut free: Vec<u32> = (0..rows as u32).collect();
        if rows == self.row_of_col.len() && rows > 1 {
            let mut epsilon = self.first_epsilon();
            let mut stages = STAGES;
            self.count = FEW;
            while epsilon * FAR < self.source.largest_cost() && stages < 2 * STAGES {
                self.bid(&mut free, epsilon, TRIAL * rows, should_continue)?;
                if free.is_empty() {
                    break;
                }
                epsilon /= FALL.powi(RISE as i32);
                stages += RISE;
            }
            for _ in 0..stages {
                let (bids, looks) = (self.bids, self.looks);
                self.bid(&mut free, epsilon, BIDS * rows, should_continue)?;
                self.count = if 2 * (self.looks - looks) > self.bids - bids { FEW } else { COUNT };
                epsilon *= FALL;
                self.free_unless_best(&mut free, epsilon);
            }
            self.count = COUNT;
            self.free_unless_best(&mut free, 0.0);
        }
        self.bid(&mut free, 0.0, 4 * rows, should_continue)
    }

    /// ε of the last [`STAGES`] stages' first one.
    fn first_epsilon(&mut self) -> f64 {
        let rows = self.col_of_row.len();
        let mut sum = 0.0;
        for row in 0..rows as u32 {
            let best = self.best(row);
            // A row may have only one column.
            sum += if best.second < f64::INFINITY { best.second - best.least } else { 0.0 };
        }
        // Where many are the same, the differences say nothing.
        (NEAR * sum / rows as f64).max(1e-4 * self.source.largest_cost())
    }

    /// Frees the rows whose column is not within ε of their cheapest.
    fn free_unless_best(&mut self, free: &mut Vec<u32>, epsilon: f64) {
        for row in 0..self.col_of_row.len() as u32 {
            let col = self.col_of_row[row as usize];
            if col != NONE && self.own(row) > self.best(row).least + epsilon {
                self.col_of_row[row as usize] = NONE;
                self.row_of_col[col as usize] = NONE;
                free.push(row);
            }
        }
    }

    /// Every free row takes its cheapest column at a price that makes the second cheapest one better by ε, and the row that had
    /// it is next. Rows that are left are `free` afterwards.
    fn bid(
        &mut self,
        free: &mut Vec<u32>,
        epsilon: f64,
        mut budget: usize,
        should_continue: &dyn Fn() -> bool,
    ) -> Result<(), AssignError> {
        let mut left = Vec::new();
        for first in std::mem::take(free) {
            if !should_continue() {
                return Err(AssignError::Interrupted);
            }
            let mut row = first;
            loop {
                self.bids += 1;
                if self.bids.is_multiple_of(256) && !should_continue() {
                    return Err(AssignError::Interrupted);
                }
                let best = self.best(row);
                if best.col as usize >= self.cols() {
                    (self.col_of_row[row as usize], self.row_of_col[best.col as usize]) = (best.col, row);
                    break;
                }
                let price = self.price[best.col as usize];
                // A row that has only one column may keep it at any price.
                let margin = if best.second < f64::INFINITY { best.second - best.least } else { 0.0 };
                let lowered = price - margin - epsilon;
                let progress = lowered < price;
                if progress {
                    self.set_price(best.col, lowered);
                }
                let displaced = std::mem::replace(&mut self.row_of_col[best.col as usize], row);
                self.col_of_row[row as usize] = best.col;
                if displaced == NONE {
                    break;
                }
                self.col_of_row[displaced as usize] = NONE;
                budget = budget.saturating_sub(1);
                if !progress || budget == 0 {
                    left.push(displaced);
                    break;
                }
                row = displaced;
            }
        }
        *free = left;
        Ok(())
    }
}
