//! Prioritised planning on a grid: space-time A* (Hart et al. 1968) for one agent after the other, around the paths reserved
//! before (cooperative A*, Silver 2005).
//!
//! Time is counted in ticks: an agent moves to one of four neighbouring cells or waits. Two agents are never in one cell at the
//! same tick (vertex conflict), never exchange their cells (swap conflict), and an agent that has arrived stays.

use super::grid::Grid;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// How much a plan may cost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Limits {
    /// Last tick at which an agent may arrive.
    pub(super) ticks: u32,
    /// Nodes that one search may open.
    pub(super) nodes: usize,
    /// Orders of priority that are tried.
    pub(super) rounds: usize,
}

/// A path for every agent.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Plan {
    /// Cells of each agent at ticks 0, 1, …; it stays in the last one.
    pub(super) paths: Vec<Vec<u32>>,
    /// Agents whose path ignores the others, ascending: there was none around them.
    pub(super) unresolved: Vec<u32>,
}

/// Plans the ways of `trips` (start, goal); starts are distinct, and so are goals.
///
/// The longest way goes first, ties by index. An agent that finds no way around the ones before it gets the highest priority,
/// and all are planned again. After the last round the order with the fewest such agents counts, and each of them takes
/// the shortest way that ignores the others; without any way it stays at its start.
pub(super) fn plan(grid: &Grid, trips: &[(u32, u32)], limits: Limits) -> Plan {
    let mut order: Vec<u32> = (0..trips.len() as u32).collect();
    order.sort_by_key(|&agent| {
        let (start, goal) = trips[agent as usize];
        (Reverse(grid.manhattan(start, goal)), agent)
    });
    let mut search = Search::new(grid, limits);
    let mut best = search.in_order(trips, &order);
    for _ in 1..limits.rounds {
        if best.unresolved.is_empty() {
            break;
        }
        // Stable: the agents in need keep their order among themselves, and so do the others.
        let needy = search.failed.clone();
        order.sort_by_key(|agent| !needy.contains(agent));
        let next = search.in_order(trips, &order);
        if next.unresolved.len() < best.unresolved.len() {
            best = next;
        }
    }
    best
}

const FREE: u32 = u32::MAX;

/// Which agent is where at which tick.
struct Reservations {
    /// (tick, agent) per cell.
    visits: Vec<Vec<(u32, u32)>>,
    /// Tick from which an agent stays in the cell for good; [`FREE`] if none does.
    parked_from: Vec<u32>,
}

impl Reservations {
    fn new(cells: usize) -> Self {
        Self { visits: vec![Vec::new(); cells], parked_from: vec![FREE; cells] }
    }

    fn reserve(&mut self, agent: u32, path: &[u32]) {
        for (tick, &cell) in path.iter().enumerate() {
            self.visits[cell as usize].push((tick as u32, agent));
        }
        if let Some(&last) = path.last() {
            let parked = &mut self.parked_from[last as usize];
            *parked = (*parked).min(path.len() as u32 - 1);
        }
    }

    /// Whether a move to `to`, where it arrives at `tick`, meets no reservation.
    fn allows(&self, from: u32, to: u32, tick: u32) -> bool {
        let (from, to) = (from as usize, to as usize);
        if tick >= self.parked_from[to] || self.visits[to].iter().any(|&(at, _)| at == tick) {
            return false;
        }
        let comes_back = |agent: u32| self.visits[from].contains(&(tick, agent));
        !self.visits[to].iter().any(|&(at, agent)| at + 1 == tick && comes_back(agent))
    }

    /// First tick from which the cell is not needed any more; [`FREE`] if an agent stays there.
    fn free_from(&self, cell: u32) -> u32 {
        if self.parked_from[cell as usize] != FREE {
            return FREE;
        }
        self.visits[cell as usize].iter().map(|&(tick, _)| tick + 1).max().unwrap_or(0)
    }
}

#[derive(Debug, Clone, Copy)]
struct Node {
    cell: u32,
    tick: u32,
    parent: u32,
}

/// The memory of the searches, used again and again.
struct Search<'a> {
    grid: &'a Grid,
    limits: Limits,
    reserved: Reservations,
    nodes: Vec<Node>,
    /// (f, h, distance from the straight way, number): the least estimate first, then the node nearest to the goal, then the one
    /// nearest to the line from start to goal, so that ways cross as seldom as straight lines would, then the oldest.
    open: BinaryHeap<Reverse<(u32, u32, u64, u32)>>,
    /// Ticks at which each cell was opened, and the cells that have any.
    opened: Vec<Vec<u32>>,
    touched: Vec<u32>,
    /// Agents that found no way in the last round, in the order of planning.
    failed: Vec<u32>,
}

impl<'a> Search<'a> {
    fn new(grid: &'a Grid, limits: Limits) -> Self {
        let cells = grid.cells();
        Self {
            grid,
            limits,
            reserved: Reservations::new(cells),
            nodes: Vec::new(),
            open: BinaryHeap::new(),
            opened: vec![Vec::new(); cells],
            touched: Vec::new(),
            failed: Vec::new(),
        }
    }

    fn in_order(&mut self, trips: &[(u32, u32)], order: &[u32]) -> Plan {
        self.reserved = Reservations::new(self.grid.cells());
        self.failed.clear();
        let mut paths = vec![Vec::new(); trips.len()];
        for &agent in order {
            let (start, goal) = trips[agent as usize];
            let path = self.path(start, goal, true).unwrap_or_else(|| {
                self.failed.push(agent);
                self.path(start, goal, false).unwrap_or_else(|| vec![start])
            });
            self.reserved.reserve(agent, &path);
            paths[agent as usize] = path;
        }
        let mut unresolved = self.failed.clone();
        unresolved.sort_unstable();
        Plan { paths, unresolved }
    }

    /// The path of least ticks from `start` at tick 0 to `goal`, where the agent can stay; `around` the reserved paths, or not.
    /// f = g + h with g the ticks so far and h the Manhattan distance to the goal: both are the paper's distances, in cells.
    fn path(&mut self, start: u32, goal: u32, around: bool) -> Option<Vec<u32>> {
        for cell in self.touched.drain(..) {
            self.opened[cell as usize].clear();
        }
        self.nodes.clear();
        self.open.clear();
        let stays_from = if around { self.reserved.free_from(goal) } else { 0 };
        // Starts are distinct: at tick 0 there is no conflict.
        let trip = (start, goal);
        self.push(Node { cell: start, tick: 0, parent: FREE }, trip, around);
        while let Some(Reverse((.., number))) = self.open.pop() {
            let node = self.nodes[number as usize];
            if node.cell == goal && node.tick >= stays_from {
                return Some(self.back(number));
            }
            if self.nodes.len() >= self.limits.nodes {
                return None;
            }
            let tick = node.tick + 1;
            for next in self.grid.neighbours(node.cell).into_iter().flatten().chain([node.cell]) {
                if !around || self.reserved.allows(node.cell, next, tick) {
                    self.push(Node { cell: next, tick, parent: number }, trip, around);
                }
            }
        }
        None
    }

    /// Opens a node once. A search that ignores the others has no use for coming to a cell a second time.
    fn push(&mut self, node: Node, (start, goal): (u32, u32), around: bool) {
        let seen = &mut self.opened[node.cell as usize];
        let known = if around { seen.contains(&node.tick) } else { !seen.is_empty() };
        let left = self.grid.manhattan(node.cell, goal);
        if known || (around && node.tick + left > self.limits.ticks) {
            return;
        }
        if seen.is_empty() {
            self.touched.push(node.cell);
        }
        seen.push(node.tick);
        let aside = self.grid.aside(node.cell, start, goal);
        self.open.push(Reverse((node.tick + left, left, aside, self.nodes.len() as u32)));
        self.nodes.push(node);
    }

    fn back(&self, mut number: u32) -> Vec<u32> {
        let mut path = Vec::new();
        while let Some(node) = self.nodes.get(number as usize) {
            path.push(node.cell);
            number = node.parent;
        }
        path.reverse();
        path
    }
}
