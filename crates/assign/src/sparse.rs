//! The minimum-cost assignment without a cost matrix: of points, and of lists of allowed pairs.
//!
//! Every row knows a few candidates, its cheapest columns by cost − price when they were looked up, and a bound that no other
//! column was below. Prices only fall, so cost − price only rises and the bound stays true: what is decided below the bound
//! needs no other column, and what is not looks up more. So every step is that of the dense solver, and memory grows with the
//! candidates. The steps are a first guess of the prices from a quarter of the rows and columns, solved in the same way; an
//! auction with falling ε (Bertsekas 1988), which finds nearly the final prices; and shortest augmenting paths, which make them
//! final. [`crate::ties`] makes the answer the lowest of the exact optima, so the answer depends on none of these steps.
//! Where many points are at the same places, [`places`] counts them instead.

mod auction;
mod candidates;
mod costs;
mod growing;
mod line;
mod pairs;
mod places;
mod points;
mod search;
mod start;
mod threshold;
mod tree;

use crate::ties::{self, Exact, Graph, NONE, Solution};
use crate::{AssignError, GoOn, Result};
use candidates::{Candidates, Engine};

pub use pairs::{AllowedPairs, solve_pairs};
pub use points::{PointProblem, exact_points, solve_points};
pub use threshold::bottleneck_points;

/// Nearly tight pairs beyond which they are not collected, in all: points on a line that is not along an axis have nearly as
/// many as there are pairs.
const MOST_NEAR: usize = 1 << 25;

/// The numbers of rows and columns in the problem, by their numbers in the solver.
struct Order {
    row_at: Vec<u32>,
    col_at: Vec<u32>,
}

/// Solves by auction and shortest paths: `[rows]` the column of each row, the number of columns + the row where it has none, in
/// the numbers of the problem, as in `exact`. No more rows than columns.
fn solve<C: Candidates>(source: C, order: &Order, exact: &impl Exact, go_on: GoOn<'_>) -> Result<Vec<u32>> {
    let rows = source.rows();
    let mut engine = Engine::new(source);
    engine.run(go_on)?;
    let mut state = State::of(&engine, order);
    let magnitude = |prices: &[f64]| prices.iter().fold(0.0f64, |largest, price| largest.max(price.abs()));
    let mut tolerance = ties::tolerance(rows, magnitude(&state.row_price), magnitude(&state.col_price));
    loop {
        let mut beaten = 0.0;
        state.near.clear();
        for row in 0..rows {
            if row % 1024 == 0 && !go_on() {
                return Err(AssignError::Interrupted);
            }
            beaten += state.collect(&mut engine, order, row, tolerance);
            if state.near.cols.len() > MOST_NEAR {
                return Ok(state.col_of_row);
            }
        }
        if beaten <= 0.25 * tolerance {
            break;
        }
        tolerance += 8.0 * beaten;
    }
    let State { near, row_price, col_price, mut col_of_row, mut row_of_col, .. } = state;
    let mut solution = Solution {
        row_price: &row_price,
        col_price: &col_price,
        col_of_row: &mut col_of_row,
        row_of_col: &mut row_of_col,
    };
    ties::settle(&near, tolerance, &mut solution, exact, &mut ties::Memory::default(), go_on)?;
    Ok(col_of_row)
}

/// A solution in the numbers of the problem.
struct State {
    near: Graph,
    row_price: Vec<f64>,
    col_price: Vec<f64>,
    col_of_row: Vec<u32>,
    row_of_col: Vec<u32>,
    place_of_row: Vec<u32>,
}

impl State {
    fn of<C: Candidates>(engine: &Engine<C>, order: &Order) -> Self {
        let (rows, cols) = (order.row_at.len(), order.col_at.len());
        let places = engine.row_of_col.len();
        let mut state = Self {
            near: Graph::default(),
            row_price: vec![0.0; rows],
            col_price: vec![0.0; places],
            col_of_row: vec![NONE; rows],
            row_of_col: vec![NONE; places],
            place_of_row: vec![0; rows],
        };
        for (place, &col) in order.col_at.iter().enumerate() {
            state.col_price[col as usize] = engine.price[place];
        }
        for (place, &row) in (0u32..).zip(&order.row_at) {
            let col = order.col(cols, row, engine.col_of_row[place as usize]);
            state.row_price[row as usize] = engine.own(place);
            (state.col_of_row[row as usize], state.row_of_col[col as usize]) = (col, row);
            state.place_of_row[row as usize] = place;
        }
        state
    }

    /// Collects the nearly tight pairs of a row; returns by how much the best one beats its own.
    fn collect<C: Candidates>(&mut self, engine: &mut Engine<C>, order: &Order, row: usize, tolerance: f64) -> f64 {
        let (start, own) = (self.near.cols.len(), self.row_price[row]);
        let least = engine.near(self.place_of_row[row], own + tolerance, &mut self.near.cols);
        for col in &mut self.near.cols[start..] {
            *col = order.col(order.col_at.len(), row as u32, *col);
        }
        self.near.cols[start..].sort_unstable();
        self.near.end_row();
        (own - least).max(0.0)
    }
}

impl Order {
    /// The column at a place of the solver; behind the columns stands that the row has none.
    fn col(&self, cols: usize, row: u32, place: u32) -> u32 {
        self.col_at.get(place as usize).copied().unwrap_or(cols as u32 + row)
    }
}

#[cfg(test)]
mod tests;
