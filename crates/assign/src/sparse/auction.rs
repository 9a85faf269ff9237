//! Nearly the final prices: rows bid for their cheapest column, and a row that is outbid bids again.

use super::NONE;
use super::candidates::{COUNT, Candidates, Engine};
use crate::{AssignError, GoOn, Result};

/// Stages, from [`NEAR`] mean differences between the cheapest and the second cheapest column on; ε falls by [`FALL`] from one
/// to the next.
const STAGES: usize = 8;
const NEAR: f64 = 5.0;
const FALL: f64 = 0.2;
/// Bids per row and stage, at most.
const BIDS: usize = 80;
/// Rows that outbid each other in turn, at most: rows / [`CHAIN`], but not fewer than [`SHORTEST_CHAIN`]. What is left over must
/// go far, which is the shortest paths' work: the auction would lower all prices on the way, little by little.
const CHAIN: usize = 5;
const SHORTEST_CHAIN: usize = 256;
/// Candidates that are looked up at once while most bids need others: fewer are found sooner.
const FEW: usize = 8;

impl<C: Candidates> Engine<C> {
    /// Gives most rows a column that is one of their cheapest. With as many rows as columns, stages of falling ε; otherwise a
    /// column must keep the price 0 until it is taken, and once taken it never becomes free again: one stage without ε.
    pub(super) fn auction(&mut self, go_on: GoOn<'_>) -> Result<()> {
        let rows = self.col_of_row.len();
        let mut free: Vec<u32> = (0..rows as u32).collect();
        if rows == self.row_of_col.len() && rows > 1 {
            self.guess(go_on)?;
            self.stages(STAGES, go_on)?;
            free.clear();
            self.free_unless_best(&mut free, 0.0, go_on)?;
        }
        self.bid(&mut free, 0.0, 4 * rows, usize::MAX, go_on)
    }

    /// Stages of falling ε; returns the last one. Rows that a stage leaves over do not bid in the next ones.
    pub(super) fn stages(&mut self, stages: usize, go_on: GoOn<'_>) -> Result<f64> {
        let rows = self.col_of_row.len();
        let chain = SHORTEST_CHAIN.max(rows / CHAIN);
        let mut free: Vec<u32> = (0..rows as u32).collect();
        let mut epsilon = self.first_epsilon(go_on)?;
        self.count = FEW;
        for stage in 0..stages {
            if stage > 0 {
                epsilon *= FALL;
                free.clear();
                self.free_unless_best(&mut free, epsilon, go_on)?;
            }
            let (bids, looks) = (self.bids, self.looks);
            self.bid(&mut free, epsilon, BIDS * rows, chain, go_on)?;
            self.count = if 2 * (self.looks - looks) > self.bids - bids { FEW } else { COUNT };
        }
        self.count = COUNT;
        Ok(epsilon)
    }

    /// ε of the first stage.
    fn first_epsilon(&mut self, go_on: GoOn<'_>) -> Result<f64> {
        let rows = self.col_of_row.len();
        let mut sum = 0.0;
        for row in 0..rows as u32 {
            if row % 1024 == 0 && !go_on() {
                return Err(AssignError::Interrupted);
            }
            let best = self.best(row);
            // A row may have only one column.
            sum += if best.second < f64::INFINITY { best.second - best.least } else { 0.0 };
        }
        // Where many are the same, the differences say nothing.
        Ok((NEAR * sum / rows as f64).max(1e-7 * self.source.largest_cost()))
    }

    /// Frees the rows whose column is not within ε of their cheapest.
    fn free_unless_best(&mut self, free: &mut Vec<u32>, epsilon: f64, go_on: GoOn<'_>) -> Result<()> {
        for row in 0..self.col_of_row.len() as u32 {
            if row % 1024 == 0 && !go_on() {
                return Err(AssignError::Interrupted);
            }
            let col = self.col_of_row[row as usize];
            if col != NONE && self.own(row) > self.best(row).least + epsilon {
                self.col_of_row[row as usize] = NONE;
                self.row_of_col[col as usize] = NONE;
                free.push(row);
            }
        }
        Ok(())
    }

    /// Every free row takes its cheapest column at a price that makes the second cheapest one better by ε, and the row that had
    /// it is next, up to `chain` times. Rows that are left are `free` afterwards.
    fn bid(&mut self, free: &mut Vec<u32>, epsilon: f64, mut most: usize, chain: usize, go_on: GoOn<'_>) -> Result<()> {
        let mut left = Vec::new();
        for first in std::mem::take(free) {
            if !go_on() {
                return Err(AssignError::Interrupted);
            }
            let mut row = first;
            let mut chain = chain;
            loop {
                self.bids += 1;
                if self.bids.is_multiple_of(256) && !go_on() {
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
                (most, chain) = (most.saturating_sub(1), chain.saturating_sub(1));
                if !progress || most == 0 || chain == 0 {
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
