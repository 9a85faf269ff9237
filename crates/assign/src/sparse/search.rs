//! Shortest augmenting paths over candidates (Dijkstra with a heap), from all free rows at once.

use super::NONE;
use super::candidates::{COUNT, Candidates, Engine};
use crate::greedy::ascending;
use crate::{AssignError, GoOn, Result};
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Columns that are looked up at once while those that are final are passed over: most of what is next becomes final, too.
const OPEN: usize = 4;

/// What the search knows of each column and row; a stamp says in which search.
struct Known {
    stamp: u32,
    /// The stamp: reached; + 1: final.
    col: Vec<u32>,
    distance: Vec<f64>,
    via: Vec<u32>,
    offset: Vec<f64>,
    /// Of a row that was reached, the free row where its path begins.
    root: Vec<u32>,
    /// The stamp + 1: a path from this free row ends at a column without a row.
    served: Vec<u32>,
    /// Columns that are final.
    finals: Vec<u32>,
    /// Of these, how many are closed in the source; none before the first list was too short.
    closed: usize,
    /// Columns without a row at the ends of paths.
    ends: Vec<u32>,
    heap: BinaryHeap<Reverse<(u64, u32)>>,
}

impl<C: Candidates> Engine<C> {
    /// Gives every row without a column one; the others' columns are within ε of their cheapest.
    pub(super) fn search(&mut self, epsilon: f64, go_on: GoOn<'_>) -> Result<()> {
        let (rows, places) = (self.col_of_row.len(), self.row_of_col.len());
        let mut known = Known {
            stamp: 0,
            col: vec![0; places],
            distance: vec![0.0; places],
            via: vec![NONE; places],
            offset: vec![0.0; rows],
            root: vec![NONE; rows],
            served: vec![0; rows],
            finals: Vec::new(),
            closed: 0,
            ends: Vec::new(),
            heap: BinaryHeap::new(),
        };
        let mut free: Vec<u32> = (0..rows as u32).filter(|row| self.col_of_row[*row as usize] == NONE).collect();
        // A column that stays alone keeps its price where there are more columns than rows: then one path at a time.
        let together = if rows == places { rows } else { 1 };
        while !free.is_empty() {
            if !go_on() {
                return Err(AssignError::Interrupted);
            }
            known.stamp += 2;
            known.heap.clear();
            known.finals.clear();
            known.closed = 0;
            let starts = free.len().saturating_sub(together);
            let found = self.augment(&free[starts..], epsilon, &mut known, go_on);
            let cols = self.price.len() as u32;
            let closed = known.finals[..known.closed].iter().filter(|col| **col < cols);
            closed.for_each(|&col| self.source.reopen(col));
            found?;
            free.retain(|row| self.col_of_row[*row as usize] == NONE);
        }
        Ok(())
    }

    /// Finds shortest paths from free rows to free columns, until half of the rows have one, and flips them.
    fn augment(&mut self, starts: &[u32], epsilon: f64, known: &mut Known, go_on: GoOn<'_>) -> Result<()> {
        let places = self.row_of_col.len() as u32;
        let done = known.stamp + 1;
        known.ends.clear();
        for &row in starts {
            known.root[row as usize] = row;
            // The lengths of several rows' paths compare from what is cheapest for each of them.
            known.offset[row as usize] = if starts.len() > 1 { self.best(row).least } else { 0.0 };
            self.relax(row, known);
        }
        let enough = starts.len().div_ceil(2);
        let mut alone = 0;
        let shortest = loop {
            let Some(Reverse((_, id))) = known.heap.pop() else {
                return Err(AssignError::invalid("cost", "no matching of all rows among the allowed pairs"));
            };
            if id >= places {
                // Nothing shorter is left than what this row's other columns could give.
                self.relax_open(id - places, known);
                continue;
            }
            let at = id as usize;
            if known.col[at] == done {
                continue;
            }
            known.col[at] = done;
            known.finals.push(id);
            self.reached += 1;
            if known.finals.len().is_multiple_of(4096) && !go_on() {
                return Err(AssignError::Interrupted);
            }
            let length = known.distance[at];
            let owner = self.row_of_col[at];
            let root = known.root[known.via[at] as usize];
            if owner != NONE {
                known.root[owner as usize] = root;
                known.offset[owner as usize] = self.own(owner) - epsilon - length;
                self.relax(owner, known);
                continue;
            }
            alone += 1;
            // Paths of different rows do not meet: every column belongs to the one that is nearest.
            if known.served[root as usize] != done {
                known.served[root as usize] = done;
                known.ends.push(id);
            }
            if known.ends.len() >= enough || alone == starts.len() {
                break length;
            }
        };
        for end in std::mem::take(&mut known.ends) {
            let mut col = end;
            while col != NONE {
                let row = known.via[col as usize];
                self.row_of_col[col as usize] = row;
                col = std::mem::replace(&mut self.col_of_row[row as usize], col);
            }
        }
        for &col in &known.finals {
            let change = known.distance[col as usize] - shortest;
            if change < 0.0 && (col as usize) < self.cols() {
                self.set_price(col, self.price[col as usize] + change);
            }
        }
        Ok(())
    }

    /// Shortens the paths through a row to its candidates; the others can come later.
    fn relax(&mut self, row: u32, known: &mut Known) {
        let offset = known.offset[row as usize];
        let mut refreshed = false;
        loop {
            let list = &self.lists[row as usize];
            let mut useful = false;
            for &(col, cost) in &list.entries {
                let reduced = cost - self.price[col as usize];
                useful |= reduced <= list.bound;
                known.reach(row, col, reduced - offset);
            }
            if useful || refreshed || list.bound == f64::INFINITY {
                break;
            }
            // All its prices have fallen too far.
            self.look_up(row, COUNT);
            refreshed = true;
        }
        if let Some(sink) = self.source.sink() {
            known.reach(row, self.price.len() as u32 + row, sink - offset);
        }
        known.later(self.row_of_col.len() as u32 + row, self.lists[row as usize].bound - offset);
    }

    /// Shortens the paths through a row to its next cheapest columns that are not final.
    fn relax_open(&mut self, row: u32, known: &mut Known) {
        // Columns of sinks are no columns of the source.
        let cols = self.price.len() as u32;
        for place in known.closed..known.finals.len() {
            if known.finals[place] < cols {
                self.source.close(known.finals[place]);
            }
        }
        known.closed = known.finals.len();
        self.looks += 1;
        let bound = self.source.nearest_open(row, OPEN, &self.price, &mut self.found);
        let offset = known.offset[row as usize];
        for found in &self.found {
            known.reach(row, found.col, found.reduced - offset);
        }
        known.later(self.row_of_col.len() as u32 + row, bound - offset);
    }
}

impl Known {
    /// A path to a column.
    fn reach(&mut self, row: u32, col: u32, length: f64) {
        let at = col as usize;
        let seen = self.col[at] == self.stamp;
        if self.col[at] == self.stamp + 1 || (seen && length >= self.distance[at]) {
            return;
        }
        (self.col[at], self.distance[at], self.via[at]) = (self.stamp, length, row);
        self.heap.push(Reverse((ascending(length), col)));
    }

    /// No path over the columns that a row has not shown is shorter.
    fn later(&mut self, id: u32, length: f64) {
        if length < f64::INFINITY {
            self.heap.push(Reverse((ascending(length), id)));
        }
    }
}
