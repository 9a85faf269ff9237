//! Candidates of every row, and the state of a solution.

use super::NONE;
use super::tree::Found;
use crate::{GoOn, Result};

/// Candidates that are looked up at once, as a rule.
pub(super) const COUNT: usize = 16;

/// Where the columns of a row come from.
pub(super) trait Candidates {
    fn rows(&self) -> usize;
    fn cols(&self) -> usize;
    /// No pair costs more.
    fn largest_cost(&self) -> f64;
    /// What a row without a column costs, if that may be.
    fn sink(&self) -> Option<f64>;
    /// Replaces `found` by at least the `count` columns of a row with the least cost − price; returns what no other column is
    /// below, +∞ if there is none.
    fn nearest(&mut self, row: u32, count: usize, price: &[f64], found: &mut Vec<Found>) -> f64;
    /// The same of the columns that are not closed; those with a cost of their own may be missing.
    fn nearest_open(&mut self, row: u32, count: usize, price: &[f64], found: &mut Vec<Found>) -> f64;
    /// Passes over a column in [`Self::nearest_open`] until it is opened again.
    fn close(&mut self, col: u32);
    fn reopen(&mut self, col: u32);
    /// Appends every column of a row with cost − price up to `limit`.
    fn within(&mut self, row: u32, limit: f64, price: &[f64], found: &mut Vec<u32>);
    /// The price of a column has fallen from `before`.
    fn reprice(&mut self, col: u32, before: f64, price: &[f64]);
    /// Cost of a pair that was found.
    fn cost(&self, row: u32, col: u32) -> f64;
    /// A problem with this many of the rows and of the columns, taken evenly; nothing where there is no such thing.
    fn sample(&self, count: usize) -> Option<Self>
    where
        Self: Sized;
    /// Sets all prices: to the largest at which no row of the sample would have a column cheaper than its `[rows]` least
    /// cost − price.
    fn spread(&mut self, sample: &Self, least: &[f64], price: &mut Vec<f64>, go_on: GoOn<'_>) -> Result<()>;
}

/// The cheapest columns of a row when they were looked up.
#[derive(Debug, Clone, Default)]
pub(super) struct List {
    /// (column, cost)
    pub(super) entries: Vec<(u32, f64)>,
    /// No other column has less cost − price.
    pub(super) bound: f64,
}

/// The cheapest and the second cheapest choice of a row.
#[derive(Debug, Clone, Copy)]
pub(super) struct Best {
    /// The number of columns + the row for no column.
    pub(super) col: u32,
    /// cost − price.
    pub(super) least: f64,
    pub(super) second: f64,
}

pub(super) struct Engine<C> {
    pub(super) source: C,
    pub(super) lists: Vec<List>,
    /// `[cols]`
    pub(super) price: Vec<f64>,
    /// `[rows]`; the number of columns + the row for a row that has none.
    pub(super) col_of_row: Vec<u32>,
    /// `[cols]`, and `[rows]` more where rows may be without a column.
    pub(super) row_of_col: Vec<u32>,
    pub(super) found: Vec<Found>,
    /// Candidates that are looked up at once.
    pub(super) count: usize,
    /// How often that happened, and how often a row bid.
    pub(super) looks: usize,
    pub(super) bids: usize,
    /// How often shortest paths reached a column.
    pub(super) reached: usize,
}

impl<C: Candidates> Engine<C> {
    pub(super) fn new(source: C) -> Self {
        let (rows, cols) = (source.rows(), source.cols());
        let sinks = if source.sink().is_some() { rows } else { 0 };
        Self {
            lists: vec![List { entries: Vec::new(), bound: f64::NEG_INFINITY }; rows],
            price: vec![0.0; cols],
            col_of_row: vec![NONE; rows],
            row_of_col: vec![NONE; cols + sinks],
            found: Vec::new(),
            count: COUNT,
            looks: 0,
            bids: 0,
            reached: 0,
            source,
        }
    }

    /// Finds a cheapest matching of all rows, as far as doubles can tell, and its prices.
    pub(super) fn run(&mut self, go_on: GoOn<'_>) -> Result<()> {
        self.auction(go_on)?;
        self.search(0.0, go_on)
    }

    pub(super) fn cols(&self) -> usize {
        self.price.len()
    }

    /// Changes a price.
    pub(super) fn set_price(&mut self, col: u32, price: f64) {
        let before = std::mem::replace(&mut self.price[col as usize], price);
        self.source.reprice(col, before, &self.price);
    }

    /// Looks up the cheapest columns of a row anew.
    pub(super) fn look_up(&mut self, row: u32, count: usize) {
        self.looks += 1;
        let list = &mut self.lists[row as usize];
        list.bound = self.source.nearest(row, count, &self.price, &mut self.found);
        list.entries.clear();
        list.entries.extend(self.found.iter().map(|found| (found.col, found.cost)));
    }

    /// The best choice of a row; a column without a row first among equals.
    pub(super) fn best(&mut self, row: u32) -> Best {
        let mut count = self.count;
        loop {
            let mut best = Best { col: NONE, least: f64::INFINITY, second: f64::INFINITY };
            let list = &self.lists[row as usize];
            for &(col, cost) in &list.entries {
                let reduced = cost - self.price[col as usize];
                if reduced < best.least {
                    best = Best { col, least: reduced, second: best.least };
                } else {
                    if reduced == best.least
                        && self.row_of_col[best.col as usize] != NONE
                        && self.row_of_col[col as usize] == NONE
                    {
                        best.col = col;
                    }
                    best.second = if reduced < best.second { reduced } else { best.second };
                }
            }
            if best.second <= list.bound {
                if let Some(sink) = self.source.sink() {
                    let col = self.cols() as u32 + row;
                    if sink < best.least {
                        best = Best { col, least: sink, second: best.least };
                    } else if sink < best.second {
                        best.second = sink;
                    }
                }
                return best;
            }
            self.look_up(row, count);
            count *= 2;
        }
    }

    /// Cost − price of the column that a row has.
    pub(super) fn own(&self, row: u32) -> f64 {
        let col = self.col_of_row[row as usize] as usize;
        match self.price.get(col) {
            Some(price) => self.cost(row, col as u32) - price,
            None => self.source.sink().unwrap_or(f64::INFINITY),
        }
    }

    /// The cost of a pair, as it stands in the lists.
    fn cost(&self, row: u32, col: u32) -> f64 {
        let listed = self.lists[row as usize].entries.iter().find(|entry| entry.0 == col);
        listed.map_or_else(|| self.source.cost(row, col), |entry| entry.1)
    }

    /// Appends the columns of a row with cost − price up to `limit` and returns the least.
    pub(super) fn near(&mut self, row: u32, limit: f64, near: &mut Vec<u32>) -> f64 {
        let start = near.len();
        let list = &self.lists[row as usize];
        if list.bound > limit {
            let price = &self.price;
            let up_to = |entry: &&(u32, f64)| entry.1 - price[entry.0 as usize] <= limit;
            near.extend(list.entries.iter().filter(up_to).map(|entry| entry.0));
        } else {
            self.source.within(row, limit, &self.price, near);
        }
        let mut least = f64::INFINITY;
        for &col in &near[start..] {
            least = least.min(self.cost(row, col) - self.price[col as usize]);
        }
        if let Some(sink) = self.source.sink().filter(|sink| *sink <= limit) {
            near.push(self.cols() as u32 + row);
            least = least.min(sink);
        }
        least
    }
}
