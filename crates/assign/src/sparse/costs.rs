//! What pairs of points cost: a power of their distance, or a cost of their own.

use crate::points::powered_square;

/// distance^power, and +∞ beyond the limit.
#[derive(Debug, Clone, Copy)]
pub(super) struct Metric {
    pub(super) power: f64,
    pub(super) limit: f64,
}

impl Metric {
    #[inline]
    pub(super) fn cost<const D: usize>(&self, from: &[f64; D], to: &[f64; D]) -> f64 {
        let mut square = 0.0;
        for axis in 0..D {
            let difference = from[axis] - to[axis];
            square += difference * difference;
        }
        let cost = powered_square(square, self.power);
        if cost <= self.limit { cost } else { f64::INFINITY }
    }

    /// The costs of pairs with these squared distances.
    #[inline(always)]
    pub(super) fn costs<const L: usize>(&self, squares: &mut [f64; L]) {
        if self.power == 1.0 {
            squares.iter_mut().for_each(|square| *square = square.sqrt());
        } else if self.power != 2.0 {
            squares.iter_mut().for_each(|square| *square = powered_square(*square, self.power));
        }
        squares.iter_mut().for_each(|cost| *cost = if *cost <= self.limit { *cost } else { f64::INFINITY });
    }

    /// Turns squared distances into what no point that is at least as far away costs less than.
    #[inline(always)]
    pub(super) fn at_least<const L: usize>(&self, squares: &mut [f64; L]) {
        // Roots, products and sums are monotone after rounding, too; nothing says so of other powers.
        if self.power == 1.0 {
            squares.iter_mut().for_each(|square| *square = square.sqrt());
        } else if self.power != 2.0 {
            let least = |square: f64| powered_square(square, self.power) * (1.0 - 1e-14);
            squares.iter_mut().for_each(|square| *square = least(*square));
        }
    }
}

/// A pair with a cost of its own: the sum of two doubles.
#[derive(Debug, Clone, Copy)]
pub(super) struct OwnCost {
    pub(super) row: u32,
    pub(super) col: u32,
    pub(super) terms: [f64; 2],
    pub(super) current: bool,
}

impl OwnCost {
    pub(super) fn cost(&self) -> f64 {
        self.terms[0] + self.terms[1]
    }
}

/// Pairs with costs of their own, sorted by row and column.
#[derive(Debug, Default)]
pub(super) struct OwnCosts {
    /// Where each row begins; empty without such pairs.
    start: Vec<usize>,
    pub(super) pairs: Vec<OwnCost>,
}

impl OwnCosts {
    /// Of a list in which the last one of a pair counts.
    pub(super) fn new(mut pairs: Vec<OwnCost>, rows: usize) -> Self {
        if pairs.is_empty() {
            return Self::default();
        }
        pairs.reverse();
        pairs.sort_by_key(|pair| (pair.row, pair.col));
        pairs.dedup_by_key(|pair| (pair.row, pair.col));
        let start = (0..=rows as u32).map(|row| pairs.partition_point(|pair| pair.row < row)).collect();
        Self { start, pairs }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.pairs.is_empty()
    }

    pub(super) fn of(&self, row: usize) -> &[OwnCost] {
        if self.start.is_empty() { &[] } else { &self.pairs[self.start[row]..self.start[row + 1]] }
    }

    pub(super) fn get(&self, row: usize, col: usize) -> Option<&OwnCost> {
        let pairs = self.of(row);
        pairs.binary_search_by_key(&(col as u32), |pair| pair.col).ok().map(|place| &pairs[place])
    }

    /// With rows for columns; there are `rows` of these.
    pub(super) fn turned(&self, rows: usize) -> Self {
        Self::new(self.pairs.iter().map(|pair| OwnCost { row: pair.col, col: pair.row, ..*pair }).collect(), rows)
    }

    /// The same with other numbers for rows and columns.
    pub(super) fn places(&self, row_at: &[u32], place_of_col: &[u32]) -> Self {
        let mut pairs = Vec::with_capacity(self.pairs.len());
        for (place, &row) in row_at.iter().enumerate().filter(|_| !self.pairs.is_empty()) {
            pairs.extend(self.of(row as usize).iter().map(|pair| OwnCost {
                row: place as u32,
                col: place_of_col[pair.col as usize],
                ..*pair
            }));
        }
        Self::new(pairs, row_at.len())
    }
}
