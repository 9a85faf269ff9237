//! The transportation problem by the network simplex method (Cunningham 1976, "A network simplex method").
//!
//! Rows with supplies and columns with demands of the same sum; a flow runs over arcs from rows to columns. A solution is a tree
//! over rows, columns and a root: only its arcs have flow, and the values along it make each of them tight. An arc that would be
//! cheaper than its values takes the place of one on the cycle that it closes. The trees are strongly feasible (every arc
//! without flow leads towards the root), so ties cannot make the method go round in circles.
//!
//! The numbers are doubles, or whole numbers without rounding ([`Fixed`]); both go on from the same tree.

use crate::fixed::Fixed;
use crate::ties::NONE;
use crate::{AssignError, GoOn, Result};

/// Arcs and nodes between two questions whether to go on.
const LOOKS: usize = 1 << 18;
/// Arcs that are looked at together, at least: the cheapest of them is taken.
const BLOCK: usize = 32;

/// What arcs cost.
pub(super) trait Number: Copy + PartialOrd {
    const ZERO: Self;
    fn minus(self, other: Self) -> Self;
}

impl Number for f64 {
    const ZERO: Self = 0.0;

    fn minus(self, other: Self) -> Self {
        self - other
    }
}

impl<const N: usize> Number for Fixed<N> {
    const ZERO: Self = Fixed::ZERO;

    fn minus(self, other: Self) -> Self {
        Fixed::minus(self, other)
    }
}

/// An arc from a row to a column.
#[derive(Debug, Clone, Copy)]
pub(super) struct Arc<T> {
    pub(super) row: u32,
    pub(super) col: u32,
    pub(super) cost: T,
}

/// A tree over the rows, the columns behind them, and the root behind these. Every node has an arc to its parent, from the row to
/// the column; the root stands for a column above rows, and for a row above columns.
#[derive(Debug, Clone)]
pub(super) struct Tree {
    pub(super) rows: u32,
    pub(super) root: u32,
    pub(super) parent: Vec<u32>,
    /// Of the arc to the parent.
    pub(super) flow: Vec<u64>,
    depth: Vec<u32>,
    /// The first child, and the neighbours among siblings; rows without children come last. Before the first one is the last.
    child: Vec<u32>,
    next: Vec<u32>,
    before: Vec<u32>,
}

impl Tree {
    /// Every row and column hangs at the root, with its supply or demand.
    fn new(supply: &[u64], demand: &[u64]) -> Self {
        let nodes = supply.len() + demand.len() + 1;
        let (rows, root) = (supply.len() as u32, nodes as u32 - 1);
        let mut tree = Self {
            rows,
            root,
            parent: vec![NONE; nodes],
            flow: supply.iter().chain(demand).copied().chain([0]).collect(),
            depth: vec![1; nodes],
            child: vec![NONE; nodes],
            next: vec![NONE; nodes],
            before: vec![NONE; nodes],
        };
        tree.depth[root as usize] = 0;
        (0..root).rev().for_each(|node| tree.attach(node, root));
        tree
    }

    /// A row without children; it has no value of its own.
    fn is_leaf(&self, node: u32) -> bool {
        node < self.rows && self.child[node as usize] == NONE
    }

    /// Hangs a node at another one.
    fn attach(&mut self, node: u32, parent: u32) {
        let was_leaf = self.is_leaf(parent);
        self.link(node, parent);
        if was_leaf {
            self.move_among_siblings(parent);
        }
    }

    fn detach(&mut self, node: u32) {
        let parent = self.parent[node as usize];
        self.unlink(node);
        if self.is_leaf(parent) {
            self.move_among_siblings(parent);
        }
    }

    fn move_among_siblings(&mut self, node: u32) {
        let parent = self.parent[node as usize];
        self.unlink(node);
        self.link(node, parent);
    }

    /// Puts a node before its siblings, a leaf behind them.
    fn link(&mut self, node: u32, parent: u32) {
        let (at, above) = (node as usize, parent as usize);
        let first = self.child[above];
        self.parent[at] = parent;
        if first == NONE {
            (self.child[above], self.before[at], self.next[at]) = (node, node, NONE);
            return;
        }
        let last = std::mem::replace(&mut self.before[first as usize], node);
        if self.is_leaf(node) {
            self.next[last as usize] = node;
            (self.before[at], self.next[at]) = (last, NONE);
        } else {
            self.child[above] = node;
            (self.before[at], self.next[at]) = (last, first);
        }
    }

    fn unlink(&mut self, node: u32) {
        let (at, above) = (node as usize, self.parent[node as usize] as usize);
        let (before, next, first) = (self.before[at], self.next[at], self.child[above]);
        if first == node {
            self.child[above] = next;
        } else {
            self.next[before as usize] = next;
        }
        if next != NONE {
            self.before[next as usize] = before;
        } else if first != node {
            self.before[first as usize] = before;
        }
    }

    /// The row and the column of the arc to the parent, unless that is the root.
    pub(super) fn arc(&self, node: u32) -> Option<(u32, u32)> {
        let parent = self.parent[node as usize];
        if parent == self.root || parent == NONE {
            return None;
        }
        Some(if node < self.rows { (node, parent - self.rows) } else { (parent, node - self.rows) })
    }

    /// Flow of the arc between a row and a column.
    pub(super) fn flow_of(&self, row: u32, col: u32) -> u64 {
        let below = self.rows + col;
        if self.parent[row as usize] == below {
            self.flow[row as usize]
        } else if self.parent[below as usize] == row {
            self.flow[below as usize]
        } else {
            0
        }
    }

    /// Whether some supply and demand is not served yet.
    pub(super) fn unserved(&self) -> bool {
        (0..self.root as usize).any(|node| self.parent[node] == self.root && self.flow[node] > 0)
    }
}

pub(super) struct Simplex<T> {
    pub(super) tree: Tree,
    /// Cost of the arc to the parent.
    cost: Vec<T>,
    /// An arc costs no less than the values of its row and its column; those of the tree cost their sum. That of a row without
    /// children is out of date while the method runs: most rows are such, and values above them change all the time.
    pub(super) value: Vec<T>,
    pub(super) arcs: Vec<Arc<T>>,
    /// How far below that sum an arc may cost.
    pub(super) tolerance: T,
    cursor: usize,
    /// Arcs that took the place of another one.
    pub(super) pivots: usize,
    /// Those in a row that moved no flow.
    idle: usize,
    /// Arcs and nodes that were looked at since the caller was asked last whether to go on.
    looked: usize,
}

impl<T: Number> Simplex<T> {
    /// Supplies and demands with the same sum, all above 0; to leave one of them unserved costs `penalty`.
    pub(super) fn new(supply: &[u64], demand: &[u64], penalty: T) -> Self {
        let tree = Tree::new(supply, demand);
        let cost = vec![penalty; tree.parent.len()];
        Self::of(tree, cost, Vec::new())
    }

    /// Goes on from a tree, with these costs of its arcs.
    pub(super) fn of(tree: Tree, cost: Vec<T>, arcs: Vec<Arc<T>>) -> Self {
        let value = vec![T::ZERO; tree.parent.len()];
        let mut new = Self { tree, cost, value, arcs, tolerance: T::ZERO, cursor: 0, pivots: 0, idle: 0, looked: 0 };
        new.revalue_all();
        new
    }

    /// What it costs to leave something unserved.
    pub(super) fn set_penalty(&mut self, penalty: T) {
        let mut node = self.tree.child[self.tree.root as usize];
        while node != NONE {
            self.cost[node as usize] = penalty;
            node = self.tree.next[node as usize];
        }
        self.revalue_all();
    }

    fn revalue_all(&mut self) {
        let mut node = self.tree.child[self.tree.root as usize];
        while node != NONE {
            self.revalue(node);
            node = self.tree.next[node as usize];
        }
    }

    /// What the value of a row is.
    fn row_value(&self, row: u32) -> T {
        self.cost[row as usize].minus(self.value[self.tree.parent[row as usize] as usize])
    }

    /// Brings depths and values below a node up to date, and its own, but not those of leaves.
    fn revalue(&mut self, top: u32) {
        let Self { tree, cost, value, looked, .. } = self;
        let mut node = top;
        loop {
            *looked += 1;
            let (at, parent) = (node as usize, tree.parent[node as usize] as usize);
            tree.depth[at] = tree.depth[parent] + 1;
            value[at] = cost[at].minus(value[parent]);
            let inner = |next: u32| next != NONE && !tree.is_leaf(next);
            if inner(tree.child[at]) {
                node = tree.child[at];
                continue;
            }
            while node != top && !inner(tree.next[node as usize]) {
                node = tree.parent[node as usize];
            }
            if node == top {
                return;
            }
            node = tree.next[node as usize];
        }
    }

    /// Makes the flow a cheapest one of these arcs. Rounding could let doubles go round in circles all the same, so what moves no
    /// flow for long must be better by more: `slacken` gives the next tolerance.
    pub(super) fn run(&mut self, slacken: impl Fn(T) -> T, go_on: GoOn<'_>) -> Result<()> {
        let patience = 16 * self.arcs.len() + 1000;
        while let Some(arc) = self.cheaper() {
            if self.looked > LOOKS {
                if !go_on() {
                    return Err(AssignError::Interrupted);
                }
                self.looked = 0;
            }
            self.pivots += 1;
            self.idle = if self.pivot(&arc) { 0 } else { self.idle + 1 };
            if self.idle > patience {
                self.tolerance = slacken(self.tolerance);
                self.idle = 0;
            }
        }
        (0..self.tree.rows).for_each(|row| self.value[row as usize] = self.row_value(row));
        Ok(())
    }

    /// The cheapest arc by its values of the next block that has one that is too cheap.
    fn cheaper(&mut self) -> Option<Arc<T>> {
        let block = (self.arcs.len().isqrt() / 4).max(BLOCK);
        let (rows, least) = (self.tree.rows, T::ZERO.minus(self.tolerance));
        let (mut left, mut found) = (self.arcs.len(), None);
        let mut best = least;
        while left > 0 {
            if self.cursor >= self.arcs.len() {
                self.cursor = 0;
            }
            let end = (self.cursor + block.min(left)).min(self.arcs.len());
            let (mut row, mut own) = (NONE, T::ZERO);
            for arc in &self.arcs[self.cursor..end] {
                if arc.row != row {
                    (row, own) = (arc.row, self.row_value(arc.row));
                }
                let reduced = arc.cost.minus(own).minus(self.value[(rows + arc.col) as usize]);
                if reduced < best {
                    (best, found) = (reduced, Some(*arc));
                }
            }
            self.looked += end - self.cursor;
            left -= end - self.cursor;
            self.cursor = end;
            if found.is_some() {
                break;
            }
        }
        found
    }

    /// Takes an arc into the tree and pushes as much flow over it as its cycle allows; whether that is any.
    fn pivot(&mut self, arc: &Arc<T>) -> bool {
        self.value[arc.row as usize] = self.row_value(arc.row);
        let Self { tree, cost, .. } = self;
        let (row, col) = (arc.row, tree.rows + arc.col);
        tree.depth[row as usize] = tree.depth[tree.parent[row as usize] as usize] + 1;
        // The flow falls on the arcs of the rows above the row, and of the columns above the column. Of those that fall to 0 the
        // last one in the direction of the flow, from the node where both ways meet, leaves the tree.
        let (mut up, mut down) = (row, col);
        let (mut least_up, mut least_down) = (u64::MAX, u64::MAX);
        let (mut out_up, mut out_down) = (NONE, NONE);
        while up != down {
            if tree.depth[up as usize] >= tree.depth[down as usize] {
                if up < tree.rows && tree.flow[up as usize] < least_up {
                    (least_up, out_up) = (tree.flow[up as usize], up);
                }
                up = tree.parent[up as usize];
            } else {
                if down >= tree.rows && tree.flow[down as usize] <= least_down {
                    (least_down, out_down) = (tree.flow[down as usize], down);
                }
                down = tree.parent[down as usize];
            }
        }
        let meet = up;
        let below = least_down <= least_up;
        let (flow, out) = if below { (least_down, out_down) } else { (least_up, out_up) };
        if flow > 0 {
            let mut node = row;
            while node != meet {
                let own = &mut tree.flow[node as usize];
                *own = if node < tree.rows { *own - flow } else { *own + flow };
                node = tree.parent[node as usize];
            }
            node = col;
            while node != meet {
                let own = &mut tree.flow[node as usize];
                *own = if node < tree.rows { *own + flow } else { *own - flow };
                node = tree.parent[node as usize];
            }
        }
        let (top, mut parent) = if below { (col, row) } else { (row, col) };
        let (mut node, mut link) = (top, (flow, arc.cost));
        loop {
            let at = node as usize;
            let above = tree.parent[at];
            tree.detach(node);
            let old = (tree.flow[at], cost[at]);
            (tree.flow[at], cost[at]) = link;
            tree.attach(node, parent);
            if node == out {
                break;
            }
            (parent, node, link) = (node, above, old);
        }
        self.revalue(top);
        flow > 0
    }
}
