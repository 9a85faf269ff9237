//! The cheapest columns of a row by cost − price, among points.
//!
//! A k-d tree over the columns (Bentley 1975) whose nodes know their box and the largest price below. Cost − price of a point is
//! at least the cost of the nearest point of its box less that price, so most nodes are never opened. Prices only fall: a price
//! that is out of date is too large, which keeps the bound valid. Three levels of halves are one node, so that the bounds of its
//! eight children are found together, in vectors.

mod build;

use super::costs::Metric;

/// Points of a leaf, at most: all are looked at together.
const LEAF: usize = 16;
/// Children of a node, at most.
const FAN: usize = 8;
/// Marks the index of a leaf among children.
const IS_LEAF: u32 = 1 << 31;

#[derive(Debug, Clone)]
struct Node<const D: usize> {
    /// By axis, of every child; where there is none, infinitely far away.
    low: [[f64; FAN]; D],
    high: [[f64; FAN]; D],
    largest_price: [f64; FAN],
    child: [u32; FAN],
    /// Points below each child that are not closed.
    open: [u32; FAN],
    at: Place,
}

/// Where a node or a leaf hangs; of the root, [`NOWHERE`].
#[derive(Debug, Clone, Copy)]
struct Place {
    node: u32,
    lane: u32,
}

const NOWHERE: Place = Place { node: u32::MAX, lane: 0 };

#[derive(Debug, Clone)]
struct Leaf<const D: usize> {
    /// Coordinates by axis; where the leaf has fewer points, the others are infinitely far away.
    block: [[f64; LEAF]; D],
    /// Its points, in the tree's order.
    start: u32,
    end: u32,
    at: Place,
}

/// A tree over points in its own order. The first node is the root.
#[derive(Debug, Clone)]
pub(super) struct Tree<const D: usize> {
    nodes: Vec<Node<D>>,
    leaves: Vec<Leaf<D>>,
    /// `[points]` in the tree's order.
    points: Vec<[f64; D]>,
    /// `[points]` the leaf of each.
    leaf_of: Vec<u32>,
    /// `[points]` points that are passed over.
    closed: Vec<bool>,
    stack: Vec<(u32, f64)>,
}

impl<const D: usize> Tree<D> {
    pub(super) fn points(&self) -> &[[f64; D]] {
        &self.points
    }

    /// Brings the largest prices up to date after the price of a point has fallen from `before`; `price` is in the tree's order.
    pub(super) fn reprice(&mut self, point: u32, before: f64, price: &[f64]) {
        let leaf = &self.leaves[self.leaf_of[point as usize] as usize];
        let mut at = leaf.at;
        if self.nodes[at.node as usize].largest_price[at.lane as usize] > before {
            return;
        }
        let mut largest = largest(&price[leaf.start as usize..leaf.end as usize]);
        while at.node != NOWHERE.node {
            let node = &mut self.nodes[at.node as usize];
            if node.largest_price[at.lane as usize] == largest {
                return;
            }
            node.largest_price[at.lane as usize] = largest;
            (largest, at) = (node.largest(), node.at);
        }
    }

    /// Brings all largest prices up to date.
    pub(super) fn reprice_all(&mut self, price: &[f64]) {
        for leaf in &self.leaves {
            let largest = largest(&price[leaf.start as usize..leaf.end as usize]);
            self.nodes[leaf.at.node as usize].largest_price[leaf.at.lane as usize] = largest;
        }
        // Children come after their parents.
        for place in (1..self.nodes.len()).rev() {
            let (largest, at) = (self.nodes[place].largest(), self.nodes[place].at);
            self.nodes[at.node as usize].largest_price[at.lane as usize] = largest;
        }
    }

    /// Passes over a point until it is opened again.
    pub(super) fn close(&mut self, point: u32) {
        self.closed[point as usize] = true;
        self.count(point, |open| *open -= 1);
    }

    pub(super) fn reopen(&mut self, point: u32) {
        self.closed[point as usize] = false;
        self.count(point, |open| *open += 1);
    }

    /// Changes the count of everything above a point.
    fn count(&mut self, point: u32, change: impl Fn(&mut u32)) {
        let mut at = self.leaves[self.leaf_of[point as usize] as usize].at;
        while at.node != NOWHERE.node {
            let node = &mut self.nodes[at.node as usize];
            change(&mut node.open[at.lane as usize]);
            at = node.at;
        }
    }

    pub(super) fn is_open(&self, point: u32) -> bool {
        !self.closed[point as usize]
    }

    /// Opens all points.
    pub(super) fn restore(&mut self) {
        self.closed.fill(false);
        for leaf in &self.leaves {
            self.nodes[leaf.at.node as usize].open[leaf.at.lane as usize] = leaf.end - leaf.start;
        }
        for place in (1..self.nodes.len()).rev() {
            let (open, at) = (self.nodes[place].open.iter().sum(), self.nodes[place].at);
            self.nodes[at.node as usize].open[at.lane as usize] = open;
        }
    }

    /// Puts the children of a node that may hold a point of cost − price below the limit on the stack, the most promising last.
    #[inline(always)]
    fn open(&self, place: u32, from: &[f64; D], metric: &Metric, limit: f64, free: bool, stack: &mut Vec<(u32, f64)>) {
        let node = &self.nodes[place as usize];
        let bounds = node.bounds(from, metric);
        let first = stack.len();
        for lane in 0..FAN {
            let bound = bounds[lane];
            if bound < limit && !(free && node.open[lane] == 0) {
                let mut at = stack.len();
                stack.push((node.child[lane], bound));
                while at > first && stack[at - 1].1 < bound {
                    stack[at] = stack[at - 1];
                    at -= 1;
                }
                stack[at] = (node.child[lane], bound);
            }
        }
    }

    /// Replaces `found` by the `count` places with the least cost − price, with their costs, and returns what no other place is
    /// below; +∞ if there is no other. Closed places are passed over if `only_open`.
    pub(super) fn nearest(
        &mut self,
        from: &[f64; D],
        count: usize,
        only_open: bool,
        metric: &Metric,
        price: &[f64],
        found: &mut Vec<Found>,
    ) -> f64 {
        found.clear();
        let mut limit = f64::INFINITY;
        let mut stack = std::mem::take(&mut self.stack);
        stack.clear();
        stack.push((0, f64::NEG_INFINITY));
        while let Some((place, bound)) = stack.pop() {
            if bound >= limit {
                continue;
            }
            if place & IS_LEAF == 0 {
                self.open(place, from, metric, limit, only_open, &mut stack);
                continue;
            }
            let leaf = &self.leaves[(place & !IS_LEAF) as usize];
            let (costs, reduced) = leaf.reduced(from, metric, price);
            for lane in 0..LEAF {
                let (cost, reduced, col) = (costs[lane], reduced[lane], leaf.start + lane as u32);
                // Beyond the leaf's points they are infinite, and so are forbidden ones.
                if reduced >= limit || (only_open && self.closed[col as usize]) {
                    continue;
                }
                let mut at = found.len();
                found.push(Found { reduced, col, cost });
                while at > 0 && found[at - 1].reduced > reduced {
                    found[at] = found[at - 1];
                    at -= 1;
                }
                found[at] = Found { reduced, col, cost };
                if found.len() > count {
                    limit = found[count].reduced;
                    found.truncate(count);
                }
            }
        }
        self.stack = stack;
        limit
    }

    /// The cheapest open place that costs up to `limit` and is not to be skipped, and its cost.
    pub(super) fn cheapest(
        &mut self,
        from: &[f64; D],
        metric: &Metric,
        limit: f64,
        skip: impl Fn(u32) -> bool,
    ) -> Option<(u32, f64)> {
        // What costs the limit itself counts, until something does: of many in one place the first is enough.
        let (mut found, mut below) = (None, limit.next_up());
        let mut stack = std::mem::take(&mut self.stack);
        stack.clear();
        stack.push((0, f64::NEG_INFINITY));
        while let Some((place, bound)) = stack.pop() {
            if bound >= below {
                continue;
            }
            if place & IS_LEAF == 0 {
                self.open(place, from, metric, below, true, &mut stack);
                continue;
            }
            let leaf = &self.leaves[(place & !IS_LEAF) as usize];
            for (point, cost) in (leaf.start..leaf.end).zip(leaf.costs(from, metric)) {
                if cost < below && !self.closed[point as usize] && !skip(point) {
                    (found, below) = (Some((point, cost)), cost);
                }
            }
        }
        self.stack = stack;
        found
    }

    /// Appends every place with cost − price up to `limit`.
    pub(super) fn within(&mut self, from: &[f64; D], limit: f64, metric: &Metric, price: &[f64], found: &mut Vec<u32>) {
        let mut stack = std::mem::take(&mut self.stack);
        stack.clear();
        stack.push((0, f64::NEG_INFINITY));
        while let Some((place, _)) = stack.pop() {
            if place & IS_LEAF == 0 {
                self.open(place, from, metric, limit.next_up(), false, &mut stack);
                continue;
            }
            let leaf = &self.leaves[(place & !IS_LEAF) as usize];
            let (_, reduced) = leaf.reduced(from, metric, price);
            found.extend(
                (leaf.start..leaf.end).zip(reduced).filter(|(_, reduced)| *reduced <= limit).map(|near| near.0),
            );
        }
        self.stack = stack;
    }
}

impl<const D: usize> Node<D> {
    fn largest(&self) -> f64 {
        (0..FAN).filter(|lane| self.child[*lane] != u32::MAX).fold(f64::NEG_INFINITY, |largest, lane| {
            let price = self.largest_price[lane];
            if price > largest { price } else { largest }
        })
    }

    /// No point of a child has less cost − price.
    #[inline(always)]
    fn bounds(&self, from: &[f64; D], metric: &Metric) -> [f64; FAN] {
        let mut squares = [0.0; FAN];
        for axis in 0..D {
            for lane in 0..FAN {
                let (below, above) = (self.low[axis][lane] - from[axis], from[axis] - self.high[axis][lane]);
                let outside = if below > above { below } else { above };
                let outside = if outside > 0.0 { outside } else { 0.0 };
                squares[lane] += outside * outside;
            }
        }
        metric.at_least(&mut squares);
        for lane in 0..FAN {
            squares[lane] -= self.largest_price[lane];
        }
        squares
    }
}

impl<const D: usize> Leaf<D> {
    /// Costs of the points; beyond them, +∞.
    #[inline(always)]
    fn costs(&self, from: &[f64; D], metric: &Metric) -> [f64; LEAF] {
        let mut costs = [0.0; LEAF];
        for axis in 0..D {
            for lane in 0..LEAF {
                let difference = from[axis] - self.block[axis][lane];
                costs[lane] += difference * difference;
            }
        }
        metric.costs(&mut costs);
        costs
    }

    /// Costs of the points, and these less their prices.
    #[inline(always)]
    fn reduced(&self, from: &[f64; D], metric: &Metric, price: &[f64]) -> ([f64; LEAF], [f64; LEAF]) {
        let costs = self.costs(from, metric);
        let mut reduced = [f64::INFINITY; LEAF];
        // Beyond the leaf's points the costs are infinite, whatever the price.
        match price[self.start as usize..].first_chunk::<LEAF>() {
            Some(price) => (0..LEAF).for_each(|lane| reduced[lane] = costs[lane] - price[lane]),
            None => {
                let price = &price[self.start as usize..self.end as usize];
                (0..price.len()).for_each(|lane| reduced[lane] = costs[lane] - price[lane]);
            }
        }
        (costs, reduced)
    }
}

fn largest(price: &[f64]) -> f64 {
    price.iter().fold(f64::NEG_INFINITY, |largest, &price| if price > largest { price } else { largest })
}

/// A column, its cost, and that less its price.
#[derive(Debug, Clone, Copy)]
pub(super) struct Found {
    pub(super) reduced: f64,
    pub(super) col: u32,
    pub(super) cost: f64,
}
