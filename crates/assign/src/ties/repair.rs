//! The minimum-cost assignment of nearly tight pairs, in whole numbers without rounding.
//!
//! Starts from the rounded solution: rows whose pair is not exactly the best are freed, and get a column again by shortest
//! augmenting paths. The cost of a pair is its exact reduced cost, and below that one unit for a pair that is not in force, so
//! that the fewest switches win among equal sums.

use super::components::Components;
use super::{Exact, Graph, NONE, Solution};
use crate::fixed::{Fixed, Scale};
use crate::{AssignError, GoOn, Result};
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Bids per freed row, at most.
const BIDS: usize = 8;

/// The pairs that are exactly tight, and the columns that may stay alone at no cost.
pub(super) struct Tight {
    pub(super) graph: Graph,
    /// `[cols]`
    pub(super) spare: Vec<bool>,
}

/// Makes the solution an exact one and finds the exactly tight pairs of `tied`.
pub(super) fn repair(
    tied: &Graph,
    parts: &Components,
    solution: &mut Solution<'_>,
    exact: &impl Exact,
    go_on: GoOn<'_>,
) -> Result<Tight> {
    if let Some(spare) = tight_already(tied, &|row| parts.pooled(row), solution, exact) {
        return Ok(Tight { graph: tied.clone(), spare });
    }
    let (mut scale, mut switches) = (Scale::default(), 0usize);
    for row in 0..tied.rows() {
        for &col in tied.of(row) {
            exact.terms(row, col as usize).into_iter().for_each(|term| scale.include(term));
            scale.include(solution.col_price[col as usize]);
            switches += usize::from(exact.current(row, col as usize));
        }
        if !tied.of(row).is_empty() {
            scale.include(solution.row_price[row]);
        }
    }
    let switches = (usize::BITS - switches.leading_zeros()) + 1;
    // Room for the sum of four terms along a path through all rows, forth and back, and the sign.
    let bits = scale.bits() + switches + 2 + (usize::BITS - tied.rows().leading_zeros()) + 3;
    let input = Input { tied, parts, exact, unit: scale.unit(), switches };
    match bits {
        ..=128 => Repair::<2>::run(&input, solution, go_on),
        129..=256 => Repair::<4>::run(&input, solution, go_on),
        257..=640 => Repair::<10>::run(&input, solution, go_on),
        // All doubles there are.
        _ => Repair::<36>::run(&input, solution, go_on),
    }
}

/// If all pairs are exactly tight and none is in force, there is nothing to solve: the columns that may stay alone.
/// `pooled` says of which rows the columns may stay alone.
pub(super) fn tight_already(
    tied: &Graph,
    pooled: &dyn Fn(usize) -> bool,
    solution: &Solution<'_>,
    exact: &impl Exact,
) -> Option<Vec<bool>> {
    let mut spare = vec![false; solution.col_price.len()];
    for row in 0..tied.rows() {
        let pooled = pooled(row);
        for &col in tied.of(row) {
            let price = solution.col_price[col as usize];
            let [cost, less] = exact.terms(row, col as usize);
            if less != 0.0 || exact.current(row, col as usize) || !difference_is(cost, price, solution.row_price[row]) {
                return None;
            }
            spare[col as usize] = pooled && price == 0.0;
        }
    }
    Some(spare)
}

/// Whether a − b = c without rounding (Knuth's two-sum gives the error).
fn difference_is(a: f64, b: f64, c: f64) -> bool {
    let difference = a - b;
    let shadow = difference - a;
    let error = (a - (difference - shadow)) - (b + shadow);
    difference == c && error == 0.0
}

struct Input<'a, E> {
    tied: &'a Graph,
    parts: &'a Components,
    exact: &'a E,
    unit: i32,
    /// Bits below the cost.
    switches: u32,
}

struct Repair<'a, const N: usize> {
    graph: &'a Graph,
    /// Cost of each pair of the graph.
    cost: Vec<Fixed<N>>,
    price: Vec<Fixed<N>>,
    /// What the search knows of each column: the shortest path to it, over which row it comes, whether it is final.
    distance: Vec<Fixed<N>>,
    via: Vec<u32>,
    known: Vec<Known>,
    touched: Vec<u32>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Known {
    Nothing,
    Bound,
    Final,
}

impl<const N: usize> Repair<'_, N> {
    fn run(input: &Input<'_, impl Exact>, solution: &mut Solution<'_>, go_on: GoOn<'_>) -> Result<Tight> {
        let &Input { tied, parts, exact, unit, switches } = input;
        let cols = solution.col_price.len();
        let of = |value: f64| Fixed::<N>::of(value, unit).shifted(switches);
        let one = Fixed::<N>::of(1.0, 0);
        let mut cost = Vec::with_capacity(tied.cols.len());
        for row in 0..tied.rows() {
            // A column that may stay alone must keep the price 0 as long as it does: there the search begins without prices.
            let pooled = parts.pooled(row);
            for &col in tied.of(row) {
                let [first, second] = exact.terms(row, col as usize);
                let mut value = of(first).plus(of(second)).minus(of(solution.row_price[row]));
                if !pooled {
                    value = value.minus(of(solution.col_price[col as usize]));
                }
                if exact.current(row, col as usize) {
                    value = value.minus(one);
                }
                cost.push(value);
            }
        }
        let mut repair = Repair {
            graph: tied,
            cost,
            price: vec![Fixed::ZERO; cols],
            distance: vec![Fixed::ZERO; cols],
            via: vec![NONE; cols],
            known: vec![Known::Nothing; cols],
            touched: Vec::new(),
        };
        let freed = repair.free(solution);
        for row in repair.bid(freed, solution, go_on)? {
            if !go_on() {
                return Err(AssignError::Interrupted);
            }
            repair.augment(row, solution);
        }
        Ok(repair.tight(parts, solution))
    }

    fn pairs(&self, row: usize) -> impl Iterator<Item = (u32, Fixed<N>)> {
        let range = self.graph.start[row]..self.graph.start[row + 1];
        self.graph.cols[range.clone()].iter().copied().zip(self.cost[range].iter().copied())
    }

    /// Frees the rows whose column is not one of their best, and returns them.
    fn free(&mut self, solution: &mut Solution<'_>) -> Vec<u32> {
        let mut freed = Vec::new();
        for row in 0..self.graph.rows() {
            let own = solution.col_of_row[row];
            let mine = self.pairs(row).find(|(col, _)| *col == own).map(|(_, cost)| cost);
            let least = self.pairs(row).map(|(_, cost)| cost).min();
            if mine != least {
                solution.col_of_row[row] = NONE;
                solution.row_of_col[own as usize] = NONE;
                freed.push(row as u32);
            }
        }
        freed
    }

    /// Every freed row takes its cheapest column at a price that makes the second cheapest as good, and the row that had it is
    /// next (Jonker & Volgenant's augmenting row reduction): rounding frees many rows, and this is faster than a path for each.
    /// Returns the rows that are left.
    fn bid(&mut self, freed: Vec<u32>, solution: &mut Solution<'_>, go_on: GoOn<'_>) -> Result<Vec<u32>> {
        let mut left = Vec::new();
        let mut budget = BIDS * freed.len();
        for first in freed {
            if !go_on() {
                return Err(AssignError::Interrupted);
            }
            let mut row = first;
            loop {
                let mut best: Option<(Fixed<N>, u32)> = None;
                let mut second: Option<Fixed<N>> = None;
                for (col, cost) in self.pairs(row as usize) {
                    let reduced = cost.minus(self.price[col as usize]);
                    match best {
                        Some((least, own)) if reduced >= least => {
                            let taken = |col: u32| solution.row_of_col[col as usize] != NONE;
                            if reduced == least && taken(own) && !taken(col) {
                                best = Some((least, col));
                            }
                            second = Some(second.map_or(reduced, |second| second.min(reduced)));
                        }
                        _ => {
                            second = best.map(|(least, _)| least);
                            best = Some((reduced, col));
                        }
                    }
                }
                let Some((least, col)) = best else { break };
                let margin = second.map_or(Fixed::ZERO, |second| second.minus(least));
                let at = col as usize;
                if solution.row_of_col[at] != NONE && (margin == Fixed::ZERO || budget == 0) {
                    left.push(row);
                    break;
                }
                budget = budget.saturating_sub(1);
                if budget % 256 == 255 && !go_on() {
                    return Err(AssignError::Interrupted);
                }
                self.price[at] = self.price[at].minus(margin);
                let displaced = std::mem::replace(&mut solution.row_of_col[at], row);
                solution.col_of_row[row as usize] = col;
                if displaced == NONE {
                    break;
                }
                solution.col_of_row[displaced as usize] = NONE;
                row = displaced;
            }
        }
        Ok(left)
    }

    /// Finds the shortest alternating path from a free row to a free column, reprices what is nearer, and flips the path.
    fn augment(&mut self, start: u32, solution: &mut Solution<'_>) {
        let mut heap = BinaryHeap::new();
        let (mut row, mut offset) = (start, Fixed::ZERO);
        // Length of the path to the row.
        let mut here = None;
        let (end, shortest) = 'path: loop {
            let range = self.graph.start[row as usize]..self.graph.start[row as usize + 1];
            for (&col, &cost) in self.graph.cols[range.clone()].iter().zip(&self.cost[range]) {
                let at = col as usize;
                if self.known[at] == Known::Final {
                    continue;
                }
                let length = cost.minus(self.price[at]).minus(offset);
                if self.known[at] == Known::Nothing {
                    self.touched.push(col);
                } else if length >= self.distance[at] {
                    continue;
                }
                (self.known[at], self.distance[at], self.via[at]) = (Known::Bound, length, row);
                if here == Some(length) && solution.row_of_col[at] == NONE {
                    // No path is shorter.
                    break 'path (col, length);
                }
                // One without a row first: it ends the search.
                heap.push(Reverse((length, solution.row_of_col[at] != NONE, col)));
            }
            let next = loop {
                match heap.pop() {
                    Some(Reverse((length, _, col)))
                        if self.known[col as usize] == Known::Bound && self.distance[col as usize] == length =>
                    {
                        break Some((length, col));
                    }
                    Some(_) => {}
                    None => break None,
                }
            };
            let Some((length, col)) = next else {
                debug_assert!(false, "the rounded solution is a matching of these pairs");
                return;
            };
            self.known[col as usize] = Known::Final;
            let owner = solution.row_of_col[col as usize];
            if owner == NONE {
                break (col, length);
            }
            let own = self.pairs(owner as usize).find(|(own, _)| *own == col).map_or(Fixed::ZERO, |(_, cost)| cost);
            offset = own.minus(self.price[col as usize]).minus(length);
            here = Some(length);
            row = owner;
        };
        let mut col = end;
        loop {
            let row = self.via[col as usize];
            solution.row_of_col[col as usize] = row;
            let before = std::mem::replace(&mut solution.col_of_row[row as usize], col);
            if row == start {
                break;
            }
            col = before;
        }
        for col in self.touched.drain(..) {
            let at = col as usize;
            if self.known[at] == Known::Final {
                self.price[at] = self.price[at].plus(self.distance[at]).minus(shortest);
            }
            self.known[at] = Known::Nothing;
        }
    }

    fn tight(&self, parts: &Components, solution: &Solution<'_>) -> Tight {
        let mut graph = Graph::default();
        graph.clear();
        let mut spare = vec![false; self.price.len()];
        for row in 0..self.graph.rows() {
            let reduced = |(col, cost): (u32, Fixed<N>)| (col, cost.minus(self.price[col as usize]));
            let own = self.pairs(row).map(reduced).find(|(col, _)| *col == solution.col_of_row[row]);
            for (col, cost) in self.pairs(row).map(reduced) {
                if own.is_some_and(|(_, own)| own == cost) {
                    graph.cols.push(col);
                }
                spare[col as usize] |= parts.pooled(row) && self.price[col as usize] == Fixed::ZERO;
            }
            graph.end_row();
        }
        Tight { graph, spare }
    }
}
