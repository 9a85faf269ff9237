//! Points as the solver's rows and columns.

use crate::sparse::Order;
use crate::sparse::candidates::Candidates;
use crate::sparse::costs::{Metric, OwnCost, OwnCosts};
use crate::sparse::tree::{Found, Tree};
use crate::{AssignError, GoOn, Result};

/// The solver's rows and columns, in the order of their trees.
pub(in crate::sparse) struct Points<const D: usize> {
    from: Vec<[f64; D]>,
    tree: Tree<D>,
    metric: Metric,
    own: OwnCosts,
    largest_cost: f64,
    sink: Option<f64>,
}

impl<const D: usize> Points<D> {
    /// The solver's problem; no more points `from` than points `to`.
    pub(in crate::sparse) fn new(
        from: &[[f64; D]],
        to: &[[f64; D]],
        metric: Metric,
        own: &OwnCosts,
        largest_cost: f64,
        sink: Option<f64>,
    ) -> (Self, Order) {
        // Neighbours in space become neighbours in memory.
        let (tree, col_at) = Tree::new(to);
        let (_, row_at) = Tree::new(from);
        let mut place_of_col = vec![0; to.len()];
        (0u32..).zip(&col_at).for_each(|(place, &col)| place_of_col[col as usize] = place);
        let own = own.places(&row_at, &place_of_col);
        let from = row_at.iter().map(|&row| from[row as usize]).collect();
        (Self { from, tree, metric, own, largest_cost, sink }, Order { row_at, col_at })
    }

    /// Brings the source up to date after any prices have changed, in any direction.
    pub(in crate::sparse) fn reprice_all(&mut self, price: &[f64]) {
        self.tree.reprice_all(price);
    }

    /// Two doubles that sum to the cost of a pair, and whether it is in force.
    pub(in crate::sparse) fn terms(&self, row: u32, col: u32) -> ([f64; 2], bool) {
        match self.own.get(row as usize, col as usize) {
            Some(pair) => (pair.terms, pair.current),
            None => ([self.metric.cost(&self.from[row as usize], &self.tree.points()[col as usize]), 0.0], false),
        }
    }
}

impl<const D: usize> Candidates for Points<D> {
    fn rows(&self) -> usize {
        self.from.len()
    }

    fn cols(&self) -> usize {
        self.tree.points().len()
    }

    fn largest_cost(&self) -> f64 {
        self.largest_cost
    }

    fn sink(&self) -> Option<f64> {
        self.sink
    }

    fn nearest(&mut self, row: u32, count: usize, price: &[f64], found: &mut Vec<Found>) -> f64 {
        let own = self.own.of(row as usize);
        // Those pairs would be counted twice; beyond the others they cost what they cost.
        let from = &self.from[row as usize];
        let bound = self.tree.nearest(from, count + own.len(), false, &self.metric, price, found);
        if !own.is_empty() {
            found.retain(|found| self.own.get(row as usize, found.col as usize).is_none());
            for pair in own.iter().filter(|pair| pair.terms[0] < f64::INFINITY) {
                let cost = pair.cost();
                found.push(Found { reduced: cost - price[pair.col as usize], col: pair.col, cost });
            }
        }
        bound
    }

    fn nearest_open(&mut self, row: u32, count: usize, price: &[f64], found: &mut Vec<Found>) -> f64 {
        let own = self.own.of(row as usize);
        let bound = self.tree.nearest(&self.from[row as usize], count + own.len(), true, &self.metric, price, found);
        if !own.is_empty() {
            found.retain(|found| self.own.get(row as usize, found.col as usize).is_none());
        }
        bound
    }

    fn close(&mut self, col: u32) {
        self.tree.close(col);
    }

    fn reopen(&mut self, col: u32) {
        self.tree.reopen(col);
    }

    fn within(&mut self, row: u32, limit: f64, price: &[f64], found: &mut Vec<u32>) {
        let start = found.len();
        self.tree.within(&self.from[row as usize], limit, &self.metric, price, found);
        let own = self.own.of(row as usize);
        if !own.is_empty() {
            let others = found.split_off(start);
            found.extend(others.into_iter().filter(|&col| self.own.get(row as usize, col as usize).is_none()));
            let near = |pair: &&OwnCost| pair.cost() - price[pair.col as usize] <= limit;
            found.extend(own.iter().filter(near).map(|pair| pair.col));
        }
    }

    fn reprice(&mut self, col: u32, before: f64, price: &[f64]) {
        self.tree.reprice(col, before, price);
    }

    fn cost(&self, row: u32, col: u32) -> f64 {
        match self.own.get(row as usize, col as usize) {
            Some(pair) => pair.cost(),
            None => self.metric.cost(&self.from[row as usize], &self.tree.points()[col as usize]),
        }
    }

    fn sample(&self, count: usize) -> Option<Self> {
        // Points that are neighbours in a tree's order are neighbours in space.
        let take = |points: &[[f64; D]]| -> Vec<[f64; D]> {
            (0..count).map(|k| points[(2 * k + 1) * points.len() / (2 * count)]).collect()
        };
        let metric = Metric { limit: f64::INFINITY, ..self.metric };
        let (from, to) = (take(&self.from), take(self.tree.points()));
        Some(Self::new(&from, &to, metric, &OwnCosts::default(), self.largest_cost, None).0)
    }

    fn spread(&mut self, sample: &Self, least: &[f64], price: &mut Vec<f64>, go_on: GoOn<'_>) -> Result<()> {
        // The sample's rows take the place of columns.
        let (mut tree, order) = Tree::new(&sample.from);
        let least: Vec<f64> = order.iter().map(|&row| least[row as usize]).collect();
        tree.reprice_all(&least);
        let mut found = Vec::new();
        price.clear();
        for (place, to) in self.tree.points().iter().enumerate() {
            if place % 1024 == 0 && !go_on() {
                return Err(AssignError::Interrupted);
            }
            tree.nearest(to, 1, false, &sample.metric, &least, &mut found);
            price.push(found.first().map_or(0.0, |found| found.reduced));
        }
        self.tree.reprice_all(price);
        Ok(())
    }
}
