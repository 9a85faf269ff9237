//! The cheapest columns of a row by cost − price, among points.
//!
//! A k-d tree over the columns (Bentley 1975) whose nodes know their box and the largest price below. Cost − price of a point is
//! at least the cost of the nearest point of its box less that price, so most nodes are never opened. Prices only fall: a price
//! that is out of date is too large, which keeps the bound valid.

use super::costs::Metric;

/// Points of a leaf, at most: all are looked at together, in vectors.
const LEAF: usize = 16;

#[derive(Debug, Clone)]
struct Node<const D: usize> {
    low: [f64; D],
    high: [f64; D],
    /// Points of the node, in the tree's order.
    start: u32,
    end: u32,
    /// The second child; the first one follows its parent. 0 for a leaf.
    second: u32,
    /// Of a leaf, where its coordinates are.
    block: u32,
    largest_price: f64,
}

/// A tree over points in its own order.
#[derive(Debug, Clone)]
pub(super) struct Tree<const D: usize> {
    nodes: Vec<Node<D>>,
    /// `[points]` in the tree's order.
    points: Vec<[f64; D]>,
    /// The same of every leaf by axis; where it has fewer points, the others are infinitely far away.
    blocks: Vec<[[f64; LEAF]; D]>,
    /// `[points]` points that are passed over, and `[nodes]` points below each node that are not.
    closed: Vec<bool>,
    open: Vec<u32>,
    stack: Vec<(u32, f64)>,
    path: Vec<u32>,
}

impl<const D: usize> Tree<D> {
    /// The tree, and the index of the point at each of its places.
    pub(super) fn new(points: &[[f64; D]]) -> (Self, Vec<u32>) {
        let mut order: Vec<u32> = (0..points.len() as u32).collect();
        let (nodes, open) = (Vec::new(), Vec::new());
        let mut tree = Self {
            blocks: Vec::new(),
            nodes,
            points: Vec::new(),
            closed: vec![false; points.len()],
            open,
            stack: Vec::new(),
            path: Vec::new(),
        };
        tree.split(points, &mut order, 0);
        tree.points = order.iter().map(|&point| points[point as usize]).collect();
        for node in tree.nodes.iter_mut().filter(|node| node.second == 0) {
            let mut block = [[f64::INFINITY; LEAF]; D];
            for (lane, point) in tree.points[node.start as usize..node.end as usize].iter().enumerate() {
                for axis in 0..D {
                    block[axis][lane] = point[axis];
                }
            }
            node.block = tree.blocks.len() as u32;
            tree.blocks.push(block);
        }
        tree.open = tree.nodes.iter().map(|node| node.end - node.start).collect();
        (tree, order)
    }

    fn split(&mut self, points: &[[f64; D]], order: &mut [u32], start: u32) {
        let (mut low, mut high) = ([f64::INFINITY; D], [f64::NEG_INFINITY; D]);
        for &point in order.iter() {
            for (axis, &x) in points[point as usize].iter().enumerate() {
                (low[axis], high[axis]) = (low[axis].min(x), high[axis].max(x));
            }
        }
        let place = self.nodes.len();
        let end = start + order.len() as u32;
        self.nodes.push(Node { low, high, start, end, second: 0, block: 0, largest_price: 0.0 });
        if order.len() <= LEAF {
            return;
        }
        let mut axis = 0;
        for other in 1..D {
            if high[other] - low[other] > high[axis] - low[axis] {
                axis = other;
            }
        }
        let middle = order.len() / 2;
        let key = |point: &u32| points[*point as usize][axis];
        order.select_nth_unstable_by(middle, |a, b| key(a).total_cmp(&key(b)).then(a.cmp(b)));
        let (first, second) = order.split_at_mut(middle);
        self.split(points, first, start);
        self.nodes[place].second = self.nodes.len() as u32;
        self.split(points, second, start + middle as u32);
    }

    pub(super) fn points(&self) -> &[[f64; D]] {
        &self.points
    }

    /// Brings the largest prices up to date after the price of a point has fallen from `before`; `price` is in the tree's order.
    pub(super) fn reprice(&mut self, point: u32, before: f64, price: &[f64]) {
        self.path.clear();
        let mut place = 0;
        loop {
            let second = self.nodes[place as usize].second;
            if second == 0 {
                break;
            }
            self.path.push(place);
            place = if point < self.nodes[second as usize].start { place + 1 } else { second };
        }
        let Node { start, end, largest_price, .. } = self.nodes[place as usize];
        if largest_price > before {
            return;
        }
        let mut largest = f64::NEG_INFINITY;
        price[start as usize..end as usize]
            .iter()
            .for_each(|&price| largest = if price > largest { price } else { largest });
        loop {
            let node = &mut self.nodes[place as usize];
            if node.largest_price == largest {
                return;
            }
            node.largest_price = largest;
            let Some(parent) = self.path.pop() else { return };
            let second = self.nodes[parent as usize].second;
            let (one, other) =
                (self.nodes[parent as usize + 1].largest_price, self.nodes[second as usize].largest_price);
            largest = if other > one { other } else { one };
            place = parent;
        }
    }

    /// No point of the node has less cost − price.
    fn bound(&self, node: u32, from: &[f64; D], metric: &Metric) -> f64 {
        let node = &self.nodes[node as usize];
        let mut nearest = [0.0; D];
        for axis in 0..D {
            let (below, above) = (node.low[axis] - from[axis], from[axis] - node.high[axis]);
            let outside = if below > above { below } else { above };
            nearest[axis] = if outside > 0.0 { outside } else { 0.0 };
        }
        metric.at_least(&nearest) - node.largest_price
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

    /// Changes the count of every node above a point.
    fn count(&mut self, point: u32, change: impl Fn(&mut u32)) {
        let mut place = 0;
        loop {
            change(&mut self.open[place as usize]);
            let second = self.nodes[place as usize].second;
            if second == 0 {
                return;
            }
            place = if point < self.nodes[second as usize].start { place + 1 } else { second };
        }
    }

    pub(super) fn is_open(&self, point: u32) -> bool {
        !self.closed[point as usize]
    }

    /// Opens all points.
    pub(super) fn restore(&mut self) {
        self.closed.fill(false);
        self.open.clear();
        self.open.extend(self.nodes.iter().map(|node| node.end - node.start));
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
        stack.push((0, self.bound(0, from, metric)));
        while let Some((place, bound)) = stack.pop() {
            if bound >= limit || (only_open && self.open[place as usize] == 0) {
                continue;
            }
            let &Node { start, end, second, .. } = &self.nodes[place as usize];
            if second != 0 {
                let (first, other) = (place + 1, second);
                let (near, far) = (self.bound(first, from, metric), self.bound(other, from, metric));
                // The more promising child is opened first.
                if near <= far {
                    stack.extend([(other, far), (first, near)]);
                } else {
                    stack.extend([(first, near), (other, far)]);
                }
                continue;
            }
            let (costs, reduced) = self.leaf(place, from, metric, price);
            for lane in 0..(end - start) as usize {
                let (cost, reduced, col) = (costs[lane], reduced[lane], start + lane as u32);
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

    /// Costs of the points of a leaf, and these less their prices.
    #[inline(always)]
    fn leaf(&self, place: u32, from: &[f64; D], metric: &Metric, price: &[f64]) -> ([f64; LEAF], [f64; LEAF]) {
        let &Node { start, end, block, .. } = &self.nodes[place as usize];
        let block = &self.blocks[block as usize];
        let mut costs = [0.0; LEAF];
        for axis in 0..D {
            for lane in 0..LEAF {
                let difference = from[axis] - block[axis][lane];
                costs[lane] += difference * difference;
            }
        }
        metric.costs(&mut costs);
        let mut reduced = [f64::INFINITY; LEAF];
        // Beyond the leaf's points the costs are infinite, whatever the price.
        match price[start as usize..].first_chunk::<LEAF>() {
            Some(price) => (0..LEAF).for_each(|lane| reduced[lane] = costs[lane] - price[lane]),
            None => {
                let price = &price[start as usize..end as usize];
                (0..price.len()).for_each(|lane| reduced[lane] = costs[lane] - price[lane]);
            }
        }
        (costs, reduced)
    }

    /// The cheapest open place that costs up to `limit` and is not to be skipped, and its cost.
    pub(super) fn cheapest(
        &mut self,
        from: &[f64; D],
        metric: &Metric,
        mut limit: f64,
        skip: impl Fn(u32) -> bool,
    ) -> Option<(u32, f64)> {
        let mut found = None;
        let mut stack = std::mem::take(&mut self.stack);
        stack.clear();
        stack.push((0, self.bound(0, from, metric)));
        while let Some((place, bound)) = stack.pop() {
            if bound > limit || self.open[place as usize] == 0 {
                continue;
            }
            let &Node { start, end, second, .. } = &self.nodes[place as usize];
            if second != 0 {
                let (first, other) = (place + 1, second);
                let (near, far) = (self.bound(first, from, metric), self.bound(other, from, metric));
                if near <= far {
                    stack.extend([(other, far), (first, near)]);
                } else {
                    stack.extend([(first, near), (other, far)]);
                }
                continue;
            }
            for point in (start..end).filter(|&point| !self.closed[point as usize] && !skip(point)) {
                let cost = metric.cost(from, &self.points[point as usize]);
                if cost < limit || (found.is_none() && cost == limit && cost < f64::INFINITY) {
                    (found, limit) = (Some((point, cost)), cost);
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
            if self.bound(place, from, metric) > limit {
                continue;
            }
            let &Node { start, end, second, .. } = &self.nodes[place as usize];
            if second != 0 {
                stack.extend([(second, 0.0), (place + 1, 0.0)]);
                continue;
            }
            let near = |col: &u32| metric.cost(from, &self.points[*col as usize]) - price[*col as usize] <= limit;
            found.extend((start..end).filter(near));
        }
        self.stack = stack;
    }
}

/// A column, its cost, and that less its price.
#[derive(Debug, Clone, Copy)]
pub(super) struct Found {
    pub(super) reduced: f64,
    pub(super) col: u32,
    pub(super) cost: f64,
}
