//! A first guess of the prices, from a smaller problem.
//!
//! From prices of 0 an auction finds small differences of prices fast, but where clusters are far apart and unequal, some rows
//! must leave theirs, and the prices in it must fall by as much as the way is long before the first one does: bid after bid, and
//! stage after stage of ε. A quarter of the rows and columns, taken evenly from the order of their trees, has nearly the same
//! differences between clusters and everywhere else, and is solved first, by a quarter of it, and so on; the smallest is a
//! matrix. Whatever the guess, the auction and the shortest paths make the prices right.

use super::candidates::{Candidates, Engine};
use crate::{GoOn, Result, Solver};

/// Rows of the problem for each row of the smaller one.
const RATIO: usize = 4;
/// Problems with fewer rows begin with prices of 0.
const SMALLEST: usize = 16;
/// Problems with no more rows are solved by a matrix.
const MATRIX: usize = 256;
/// Stages of the auction of a smaller problem: ε ends where the larger problem's begins.
const STAGES: usize = 4;

impl<C: Candidates> Engine<C> {
    /// Begins with the prices that a smaller problem suggests. As many rows as columns.
    pub(super) fn guess(&mut self, go_on: GoOn<'_>) -> Result<()> {
        let rows = self.col_of_row.len();
        if rows < SMALLEST {
            return Ok(());
        }
        let Some(sample) = self.source.sample(rows / RATIO) else {
            return Ok(());
        };
        let mut engine = Engine::new(sample);
        let least = engine.least(go_on)?;
        self.source.spread(&engine.source, &least, &mut self.price, go_on)?;
        self.bids += engine.bids;
        self.looks += engine.looks;
        self.reached += engine.reached;
        Ok(())
    }

    /// Nearly the least cost − price of every row.
    fn least(&mut self, go_on: GoOn<'_>) -> Result<Vec<f64>> {
        let rows = self.col_of_row.len();
        if rows <= MATRIX {
            let mut cost = Vec::with_capacity(rows * rows);
            for row in 0..rows as u32 {
                cost.extend((0..rows as u32).map(|col| self.source.cost(row, col)));
            }
            return Solver::default().row_prices(&cost, rows, go_on);
        }
        self.guess(go_on)?;
        let epsilon = self.stages(STAGES, go_on)?;
        // What the auction has left over is what must go far.
        self.search(epsilon, go_on)?;
        Ok((0..rows as u32).map(|row| self.best(row).least).collect())
    }
}
