//! Builds a tree: points are halved along the longest side of their box until few are left.

use super::{FAN, IS_LEAF, LEAF, Leaf, NOWHERE, Node, Place, Tree};

impl<const D: usize> Tree<D> {
    /// The tree, and the index of the point at each of its places.
    pub(in crate::sparse) fn new(points: &[[f64; D]]) -> (Self, Vec<u32>) {
        let mut order: Vec<u32> = (0..points.len() as u32).collect();
        let mut tree = Self {
            nodes: Vec::new(),
            leaves: Vec::new(),
            points: Vec::new(),
            leaf_of: vec![0; points.len()],
            closed: vec![false; points.len()],
            stack: Vec::new(),
        };
        tree.node(points, &mut order, 0, NOWHERE);
        tree.points = order.iter().map(|&point| points[point as usize]).collect();
        for (place, leaf) in tree.leaves.iter_mut().enumerate() {
            let range = leaf.start as usize..leaf.end as usize;
            tree.leaf_of[range.clone()].fill(place as u32);
            for (lane, point) in tree.points[range].iter().enumerate() {
                (0..D).for_each(|axis| leaf.block[axis][lane] = point[axis]);
            }
        }
        tree.restore();
        (tree, order)
    }

    /// Adds a node with these points; returns its index.
    fn node(&mut self, points: &[[f64; D]], order: &mut [u32], start: u32, at: Place) -> u32 {
        let place = self.nodes.len();
        self.nodes.push(Node {
            low: [[f64::INFINITY; FAN]; D],
            high: [[f64::INFINITY; FAN]; D],
            largest_price: [0.0; FAN],
            child: [u32::MAX; FAN],
            open: [0; FAN],
            at,
        });
        // The parts, and where they begin: the largest ones are halved.
        let (mut parts, mut lane) = (vec![(order, start)], 0);
        while parts.len() < FAN && parts.iter().any(|(part, _)| part.len() > LEAF) {
            let mut halves = Vec::with_capacity(2 * parts.len());
            for (part, start) in parts {
                if part.len() <= LEAF {
                    halves.push((part, start));
                    continue;
                }
                let middle = part.len() / 2;
                halve(points, part);
                let (first, second) = part.split_at_mut(middle);
                halves.extend([(first, start), (second, start + middle as u32)]);
            }
            parts = halves;
        }
        for (part, start) in parts {
            let (low, high) = extent(points, part);
            for axis in 0..D {
                (self.nodes[place].low[axis][lane], self.nodes[place].high[axis][lane]) = (low[axis], high[axis]);
            }
            let at = Place { node: place as u32, lane: lane as u32 };
            self.nodes[place].child[lane] = if part.len() > LEAF {
                self.node(points, part, start, at)
            } else {
                arrange(points, part);
                let block = [[f64::INFINITY; LEAF]; D];
                self.leaves.push(Leaf { block, start, end: start + part.len() as u32, at });
                (self.leaves.len() - 1) as u32 | IS_LEAF
            };
            lane += 1;
        }
        place as u32
    }
}

/// The corners of the box of some points.
fn extent<const D: usize>(points: &[[f64; D]], order: &[u32]) -> ([f64; D], [f64; D]) {
    let (mut low, mut high) = ([f64::INFINITY; D], [f64::NEG_INFINITY; D]);
    for &point in order {
        for (axis, &x) in points[point as usize].iter().enumerate() {
            (low[axis], high[axis]) = (low[axis].min(x), high[axis].max(x));
        }
    }
    (low, high)
}

/// Puts the lower half of some points along the longest side of their box first.
fn halve<const D: usize>(points: &[[f64; D]], order: &mut [u32]) {
    let (low, high) = extent(points, order);
    let mut axis = 0;
    for other in 1..D {
        if high[other] - low[other] > high[axis] - low[axis] {
            axis = other;
        }
    }
    let key = |point: &u32| points[*point as usize][axis];
    order.select_nth_unstable_by(order.len() / 2, |a, b| key(a).total_cmp(&key(b)).then(a.cmp(b)));
}

/// Makes neighbours in space neighbours in the order, within a leaf too.
fn arrange<const D: usize>(points: &[[f64; D]], order: &mut [u32]) {
    if order.len() > 2 {
        halve(points, order);
        let (first, second) = order.split_at_mut(order.len() / 2);
        arrange(points, first);
        arrange(points, second);
    }
}
