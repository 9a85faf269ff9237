//! The search of a smallest threshold, for matchings of points and of places.

use super::Order;
use super::costs::{Metric, OwnCost, OwnCosts};
use super::points::Limit;
use super::tree::Tree;
use crate::{GoOn, Result};

/// A largest matching of pairs up to a threshold, which changes.
pub(super) trait Growing<const D: usize> {
    fn seeker(&mut self) -> &mut Seeker<D>;
    /// Pairs of the whole shorter side.
    fn whole(&self) -> usize;
    /// Whether the rows are that side.
    fn rows_are_shorter(&self) -> bool;
    /// Makes the matching a largest one of pairs up to the limit; returns its size.
    fn grow(&mut self, limit: f64, go_on: GoOn<'_>) -> Result<usize>;
    /// Rows that the last round has reached in vain.
    fn reached(&mut self) -> &mut Vec<u32>;
    /// The dearest pair.
    fn largest(&mut self) -> f64;

    /// The smallest largest cost.
    fn search(&mut self, go_on: GoOn<'_>) -> Result<Option<Limit>> {
        let (rows, whole) = (self.seeker().from.len(), self.whole());
        // The dearest of the rows' cheapest pairs is a lower bound if all rows need one, the cheapest otherwise.
        let (mut low, mut least) = (f64::NEG_INFINITY, f64::INFINITY);
        let mut complete = true;
        for row in 0..rows as u32 {
            match self.seeker().cheapest(row) {
                Some(cost) => (low, least) = (low.max(cost), least.min(cost)),
                None => complete = false,
            }
        }
        if low == f64::NEG_INFINITY {
            return Ok(None);
        }
        if !self.rows_are_shorter() {
            low = least;
        }
        let target = if self.seeker().own.is_empty() && complete {
            whole
        } else {
            let pairs = self.grow(f64::INFINITY, go_on)?;
            if pairs < whole {
                // Some rows stay without a column: their cheapest pairs say nothing.
                low = f64::NEG_INFINITY;
                for row in 0..rows as u32 {
                    if let Some(cost) = self.seeker().cheapest(row) {
                        low = if low == f64::NEG_INFINITY { cost } else { low.min(cost) };
                    }
                }
            }
            pairs
        };
        let mut high = f64::INFINITY;
        let mut limit = low;
        while low < high {
            if self.grow(limit, go_on)? == target {
                high = self.largest();
            } else {
                // Something above the limit is needed.
                low = self.next();
                debug_assert!(low > limit, "a largest matching leads out only above the limit");
            }
            limit = if high == f64::INFINITY { low + 0.5 * low.abs() } else { low + 0.5 * (high - low) };
            if limit >= high {
                limit = low;
            }
        }
        Ok(Some(Limit { cost: high, complete: target == whole }))
    }

    /// The cheapest pair that leads out of what the last round has reached.
    fn next(&mut self) -> f64 {
        let reached = std::mem::take(self.reached());
        let next = reached.iter().filter_map(|&row| self.seeker().cheapest(row)).min_by(f64::total_cmp);
        *self.reached() = reached;
        next.unwrap_or(f64::INFINITY)
    }
}

/// Finds columns for rows.
pub(super) struct Seeker<const D: usize> {
    pub(super) from: Vec<[f64; D]>,
    /// Columns that a round has not met yet, and those of them that have room.
    pub(super) left: Tree<D>,
    pub(super) free: Tree<D>,
    metric: Metric,
    own: OwnCosts,
    /// How often a row looked for a column.
    pub(super) looks: usize,
}

impl<const D: usize> Seeker<D> {
    /// And the order of the rows and of the columns.
    pub(super) fn new(from: &[[f64; D]], to: &[[f64; D]], metric: Metric, own: &OwnCosts) -> (Self, Order) {
        let (tree, col_at) = Tree::new(to);
        let (_, row_at) = Tree::new(from);
        let mut place_of_col = vec![0; to.len()];
        (0u32..).zip(&col_at).for_each(|(place, &col)| place_of_col[col as usize] = place);
        let seeker = Self {
            from: row_at.iter().map(|&row| from[row as usize]).collect(),
            free: tree.clone(),
            left: tree,
            metric,
            own: own.places(&row_at, &place_of_col),
            looks: 0,
        };
        (seeker, Order { row_at, col_at })
    }

    /// Takes a column that is left and not dearer than the limit: one that has room first, then the cheapest, which leaves the
    /// matching mostly as it is when the limit falls.
    pub(super) fn reach(&mut self, row: u32, limit: f64) -> Option<u32> {
        self.looks += 1;
        let Self { own, left, free, from, metric, .. } = self;
        let (from, skip) = (&from[row as usize], |col: u32| own.get(row as usize, col as usize).is_some());
        let listed = own.of(row as usize).iter();
        let near = |pair: &&OwnCost| pair.terms[0] <= limit && pair.terms[0] < f64::INFINITY && left.is_open(pair.col);
        let mut found = listed.clone().find(|pair| near(pair) && free.is_open(pair.col)).map(|pair| pair.col);
        found = found.or_else(|| free.cheapest(from, metric, limit, skip).map(|found| found.0));
        found = found.or_else(|| listed.clone().find(near).map(|pair| pair.col));
        found = found.or_else(|| left.cheapest(from, metric, limit, skip).map(|found| found.0));
        if let Some(col) = found {
            left.close(col);
            if free.is_open(col) {
                free.close(col);
            }
        }
        found
    }

    /// The cheapest pair of a row with a column that is left.
    fn cheapest(&mut self, row: u32) -> Option<f64> {
        self.looks += 1;
        let Self { own, left, from, metric, .. } = self;
        let skip = |col: u32| own.get(row as usize, col as usize).is_some();
        let found = left.cheapest(&from[row as usize], metric, f64::INFINITY, skip).map(|found| found.1);
        let listed = own.of(row as usize).iter().filter(|pair| pair.terms[0] < f64::INFINITY && left.is_open(pair.col));
        listed.map(|pair| pair.terms[0]).chain(found).min_by(f64::total_cmp)
    }

    pub(super) fn cost(&self, row: u32, col: u32) -> f64 {
        match self.own.get(row as usize, col as usize) {
            Some(pair) => pair.terms[0],
            None => self.metric.cost(&self.from[row as usize], &self.left.points()[col as usize]),
        }
    }
}
