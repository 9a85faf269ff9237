//! Shortest augmenting paths over candidates (Dijkstra with a heap).

use super::NONE;
use super::candidates::{COUNT, Candidates, Engine};
use crate::AssignError;
use crate::greedy::ascending;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// What the search knows of each column and row; a stamp says in which search.
struct Known {
    stamp: u32,
    /// The stamp: reached; + 1: final.
    col: Vec<u32>,
    distance: Vec<f64>,
    via: Vec<u32>,
    offset: Vec<f64>,
    /// Columns that are final.
    finals: Vec<u32>,
    /// Of these, how many are closed in the source; none before the first list was too short.
    closed: usize,
    heap: BinaryHeap<Reverse<(u64, u32)>>,
}

impl<C: Candidates> Engine<C> {
    /// Gives every row without a column one.
    pub(super) fn search(&mut self, should_continue: &dyn Fn() -> bool) -> Result<(), AssignError> {
        let (rows, places) = (self.col_of_row.len(), self.row_of_col.len());
        let mut known = Known {
            stamp: 0,
            col: vec![0; places],
            distance: vec![0.0; places],
            via: vec![NONE; places],
            offset: vec![0.0; rows],
            finals: Vec::new(),
            closed: 0,
            heap: BinaryHeap::new(),
        };
        for row in 0..rows as u32 {
            if self.col_of_row[row as usize] == NONE {
                if !should_continue() {
                    return Err(AssignError::Interrupted);
                }
                known.stamp += 2;
                known.heap.clear();
                known.finals.clear();
                known.closed = 0;
                let found = self.augment(row, &mut known, should_continue);
                let cols = self.price.len() as u32;
                let closed = known.finals[..known.closed].iter().filter(|col| **col < cols);
                closed.for_each(|&col| self.source.reopen(col));
                found?;
            }
        }
        Ok(())
    }

    fn augment(
        &mut self,
        start: u32,
        known: &mut Known,
        should_continue: &dyn Fn() -> bool,
    ) -> Result<(), AssignError> {
        let places = self.row_of_col.len() as u32;
        let done = known.stamp + 1;
        let (mut row, mut offset) = (start, 0.0);
        let (end, shortest) = 'path: loop {
            known.offset[row as usize] = offset;
            self.relax(row, known);
            loop {
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
                let length = known.distance[at];
                let owner = self.row_of_col[at];
                if owner == NONE {
                    break 'path (id, length);
                }
                known.finals.push(id);
                if known.finals.len().is_multiple_of(4096) && !should_continue() {
                    return Err(AssignError::Interrupted);
                }
                offset = self.own(owner) - length;
                row = owner;
                break;
            }
        };
        let mut col = end;
        loop {
            let row = known.via[col as usize];
            self.row_of_col[col as usize] = row;
            let before = std::mem::replace(&mut self.col_of_row[row as usize], col);
            if row == start {
                break;
            }
            col = before;
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
        let bound = self.source.nearest_open(row, COUNT, &self.price, &mut self.found);
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
