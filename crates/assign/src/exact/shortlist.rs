//! Shortlists: of every row the columns that were its cheapest when it was last looked at as a whole.
//!
//! In a large problem the tree of shortest paths visits the same rows again and again, and reading all their costs from
//! memory is what takes the time. Prices only ever fall, so cost − price only ever rises, also after rounding: what is not on
//! a row's list is at least as far as the list's bound was when it was made. As long as the nearest column is nearer than
//! every bound, the rest of the rows need not be read; otherwise the row with the least bound is. So every length that
//! decides anything is the same number as without lists, and so is the answer.

/// Columns on a list, about.
const LENGTH: usize = 128;

/// Problems with fewer columns are read as a whole.
pub(super) const WORTH_IT: usize = 2048;

/// How often a row's list is made; a row whose lists keep being too short is read as a whole.
const PATIENCE: u8 = 16;

/// The lists of all rows.
#[derive(Debug, Clone, Default)]
pub(super) struct Shortlists {
    lists: Vec<Shortlist>,
    reduced: Vec<f64>,
    sorted: Vec<f64>,
}

#[derive(Debug, Clone, Default)]
struct Shortlist {
    /// Columns and their costs.
    entries: Vec<(u32, f64)>,
    /// No other column has less cost − price.
    bound: f64,
    made: u8,
}

impl Shortlists {
    /// Forgets all lists.
    pub(super) fn reset(&mut self, rows: usize) {
        self.lists.truncate(rows);
        for list in &mut self.lists {
            list.entries.clear();
            list.made = 0;
        }
        self.lists.resize(rows, Shortlist::default());
    }

    /// Shortens the paths through a row to its list, if it has one; no path to another column is shorter than the result.
    pub(super) fn relax(&self, row: u32, open_price: &[f64], offset: f64, distance: &mut [f64]) -> Option<f64> {
        let list = &self.lists[row as usize];
        if list.entries.is_empty() {
            return None;
        }
        for &(col, cost) in &list.entries {
            let distance = &mut distance[col as usize];
            *distance = super::lower(cost - open_price[col as usize] - offset, *distance);
        }
        Some(list.bound - offset)
    }

    /// Makes a row's list, unless it was of no use too often.
    pub(super) fn make(&mut self, row: u32, costs: &[f64], price: &[f64], cols: usize) {
        let Self { lists, reduced, sorted } = self;
        let list = &mut lists[row as usize];
        list.entries.clear();
        if list.made == PATIENCE {
            return;
        }
        list.made += 1;
        reduced.clear();
        reduced.extend(costs[..cols].iter().zip(price).map(|(cost, price)| cost - price));
        sorted.clone_from(reduced);
        let (_, bound, _) = sorted.select_nth_unstable_by(LENGTH, f64::total_cmp);
        list.bound = *bound;
        let near = reduced.iter().enumerate().filter(|(_, reduced)| **reduced < *bound);
        list.entries.extend(near.map(|(col, _)| (col as u32, costs[col])));
    }
}
