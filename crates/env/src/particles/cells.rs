//! A grid of cells over one large world, so that only neighbours are compared.
//!
//! Bodies are sorted by cell, row by row, which makes the three cells left, at and right of a cell one contiguous run.
//! Bodies outside the grid belong to its border cells; clamping moves no two bodies further apart, so neighbours still
//! sit in neighbouring cells.

use super::physics::{Pairs, pack};
use super::real::Real;

/// Bodies compared at once.
const BLOCK: usize = 16;

/// The grid and the bodies sorted into it.
#[derive(Debug, Clone)]
pub(crate) struct Cells<R> {
    low: R,
    inverse_side: R,
    columns: usize,
    /// `[columns² + 1]` first sorted place of each cell.
    start: Vec<u32>,
    /// `[N]` cell of each body.
    cell: Vec<u32>,
    /// `[N]` body at each sorted place.
    order: Vec<u32>,
    /// `[N + BLOCK]` coordinates at each sorted place.
    x: Vec<R>,
    y: Vec<R>,
}

impl<R: Real> Cells<R> {
    /// A grid of about N cells, none smaller than `reach`, over a square map of the given side.
    pub(crate) fn new(bodies: usize, side: f64, reach: f64) -> Self {
        let width = 1.1 * side;
        // A cell slightly wider than the reach keeps rounding of coordinates from hiding a neighbour.
        let cells = (width / (1.01 * reach)).min((bodies as f64).sqrt()).max(1.0);
        let columns = cells as usize;
        Self {
            low: R::from_f64(-0.5 * width),
            inverse_side: R::from_f64(columns as f64 / width),
            columns,
            start: vec![0; columns * columns + 1],
            cell: vec![0; bodies],
            order: vec![0; bodies],
            x: vec![R::from_f64(1e30); bodies + BLOCK],
            y: vec![R::from_f64(1e30); bodies + BLOCK],
        }
    }

    /// Column (or row) of a coordinate.
    #[inline(always)]
    fn column(&self, coordinate: R) -> usize {
        let place: f64 = ((coordinate - self.low) * self.inverse_side).into();
        (place as i32).clamp(0, self.columns as i32 - 1) as usize
    }

    /// Sorts the bodies at `x`, `y` into cells (a stable counting sort).
    pub(crate) fn sort(&mut self, x: &[R], y: &[R]) {
        self.start.fill(0);
        for i in 0..x.len() {
            let cell = self.column(y[i]) * self.columns + self.column(x[i]);
            self.cell[i] = cell as u32;
            self.start[cell] += 1;
        }
        let mut sum = 0;
        for count in &mut self.start {
            sum += *count;
            *count = sum;
        }
        // `start` holds the ends of the cells now; placing bodies from the last to the first turns them into starts.
        for i in (0..x.len()).rev() {
            let slot = &mut self.start[self.cell[i] as usize];
            *slot -= 1;
            let place = *slot as usize;
            self.order[place] = i as u32;
            (self.x[place], self.y[place]) = (x[i], y[i]);
        }
    }

    /// Sorted places of the cells `column − 1 ..= column + 1` of a row.
    #[inline(always)]
    fn run(&self, row: usize, column: usize) -> (usize, usize) {
        let first = row * self.columns;
        let from = self.start[first + column.saturating_sub(1)];
        let to = self.start[first + (column + 2).min(self.columns)];
        (from as usize, to as usize)
    }

    /// Lists all pairs (i < j) closer than √reach2, by rising i, then j.
    pub(crate) fn pairs(&self, reach2: R, pairs: &mut Pairs) {
        pairs.clear();
        for place in 0..self.order.len() {
            let cell = self.cell[self.order[place] as usize] as usize;
            let (row, column) = (cell / self.columns, cell % self.columns);
            // Each pair is met once: from the place that is sorted first.
            self.near(place, (place + 1, self.run(row, column).1), reach2, pairs);
            if row + 1 < self.columns {
                self.near(place, self.run(row + 1, column), reach2, pairs);
            }
        }
        pairs.sort_unstable();
    }

    /// Pairs of the body at `place` with those at the places `from..to`. One block is looked at even if there are no
    /// such places: short runs are the rule, and a branch on their emptiness would be mispredicted half of the time.
    #[inline(always)]
    fn near(&self, place: usize, (from, to): (usize, usize), reach2: R, pairs: &mut Pairs) {
        let point = (self.x[place], self.y[place]);
        let mut base = from;
        loop {
            let end = base + BLOCK;
            if any_near(&self.x[base..end], &self.y[base..end], point, reach2) {
                self.list(place, (base, end.min(to)), reach2, pairs);
            }
            base = end;
            if base >= to {
                break;
            }
        }
    }

    /// Lists the pairs of the body at `place` with the near ones among the places `from..to`.
    #[inline(never)]
    fn list(&self, place: usize, (from, to): (usize, usize), reach2: R, pairs: &mut Pairs) {
        let (px, py) = (self.x[place], self.y[place]);
        for other in from..to {
            let (dx, dy) = (px - self.x[other], py - self.y[other]);
            if dx.mul_add(dx, dy * dy) < reach2 {
                let (i, j) = (self.order[place] as usize, self.order[other] as usize);
                pairs.push(pack(i.min(j), i.max(j)));
            }
        }
    }

    /// Whether any body is within √radius2 (≤ the cells' reach) of a point.
    pub(crate) fn any_within(&self, x: R, y: R, radius2: R) -> bool {
        let (row, column) = (self.column(y), self.column(x));
        (row.saturating_sub(1)..(row + 2).min(self.columns)).any(|row| {
            let (from, to) = self.run(row, column);
            (from..to).any(|place| {
                let (dx, dy) = (self.x[place] - x, self.y[place] - y);
                dx.mul_add(dx, dy * dy) <= radius2
            })
        })
    }
}

/// Whether a block holds a body near a point. The block may reach beyond the run in question, into bodies that are
/// rarely near and that the caller leaves out, or into places that hold no body and are far from everything.
#[inline(always)]
fn any_near<R: Real>(x: &[R], y: &[R], (px, py): (R, R), reach2: R) -> bool {
    let mut near = false;
    for (&x, &y) in x.iter().zip(y) {
        let (dx, dy) = (px - x, py - y);
        near |= dx.mul_add(dx, dy * dy) < reach2;
    }
    near
}
