//! Shortest augmenting paths over candidates (Dijkstra with a heap).

use super::NONE;
use super::candidates::{Candidates, Engine};
use crate::AssignError;
use crate::greedy::ascending;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// What the search knows of each column and row; a stamp says in which search.
struct Known {
    stamp: u32,
    /// Even stamps · 2: bound; + 1: final.
    col: Vec<u32>,
    distance: Vec<f64>,
    via: Vec<u32>,
    offset: Vec<f64>,
    /// Whether a row's list is of this search.
    fresh: Vec<u32>,
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
            fresh: vec![0; rows],
        };
        let mut heap = BinaryHeap::new();
        for row in 0..rows as u32 {
            if self.col_of_row[row as usize] == NONE {
                if !should_continue() {
                    return Err(AssignError::Interrupted);
                }
                known.stamp += 2;
                heap.clear();
                self.augment(row, &mut known, &mut heap, should_continue)?;
            }
        }
        Ok(())
    }

    fn augment(
        &mut self,
        start: u32,
        known: &mut Known,
        heap: &mut BinaryHeap<Reverse<(u64, u32)>>,
        should_continue: &dyn Fn() -> bool,
    ) -> Result<(), AssignError> {
        let places = self.row_of_col.len() as u32;
        let (bound, done) = (known.stamp, known.stamp + 1);
        let mut finals: Vec<u32> = Vec::new();
        let (mut row, mut offset) = (start, 0.0);
        let (end, shortest) = 'path: loop {
            known.offset[row as usize] = offset;
            self.relax(row, known, heap);
            loop {
                let Some(Reverse((_, id))) = heap.pop() else {
                    return Err(AssignError::invalid("cost", "no matching of all rows among the allowed pairs"));
                };
                if id >= places {
                    // Nothing shorter is left than what this row's other columns could give.
                    let unread = id - places;
                    let fresh = known.fresh[unread as usize] == bound;
                    let count = self.lists[unread as usize].entries.len().max(2);
                    self.look_up(unread, if fresh { 2 * count } else { count });
                    known.fresh[unread as usize] = bound;
                    self.relax(unread, known, heap);
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
                finals.push(id);
                if finals.len() % 4096 == 0 && !should_continue() {
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
        for col in finals {
            let change = known.distance[col as usize] - shortest;
            if change < 0.0 && (col as usize) < self.cols() {
                self.set_price(col, self.price[col as usize] + change);
            }
        }
        Ok(())
    }

    /// Shortens the paths through a row to its candidates; the others can come later.
    fn relax(&mut self, row: u32, known: &mut Known, heap: &mut BinaryHeap<Reverse<(u64, u32)>>) {
        let (bound, done) = (known.stamp, known.stamp + 1);
        let offset = known.offset[row as usize];
        let mut reach = |col: u32, length: f64| {
            let at = col as usize;
            if known.col[at] == done || (known.col[at] == bound && length >= known.distance[at]) {
                return;
            }
            (known.col[at], known.distance[at], known.via[at]) = (bound, length, row);
            heap.push(Reverse((ascending(length), col)));
        };
        let list = &self.lists[row as usize];
        for &(col, cost) in &list.entries {
            reach(col, cost - self.price[col as usize] - offset);
        }
        if let Some(sink) = self.source.sink() {
            reach(self.price.len() as u32 + row, sink - offset);
        }
        if list.bound < f64::INFINITY {
            heap.push(Reverse((ascending(list.bound - offset), self.row_of_col.len() as u32 + row)));
        }
    }
}
