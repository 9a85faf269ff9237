//! A cost matrix with forbidden and current pairs, as the solver and as exact arithmetic see it.

use crate::ties::Exact;
use crate::{Result, Switching, UNASSIGNED, check_allowed};

/// Costs `[rows, cols]` that were checked.
pub(super) struct Matrix<'a> {
    pub(super) cost: &'a [f64],
    pub(super) rows: usize,
    pub(super) cols: usize,
    /// Cost in the place of +∞, if that occurs: a pair that pays it is none.
    pub(super) penalty: Option<f64>,
    switching: Switching<'a>,
}

impl<'a> Matrix<'a> {
    /// Costs without +∞, and without current pairs.
    pub(super) fn new(cost: &'a [f64], rows: usize, cols: usize) -> Self {
        Self { cost, rows, cols, penalty: None, switching: Switching::default() }
    }

    pub(super) fn check(cost: &'a [f64], rows: usize, cols: usize, switching: &Switching<'a>) -> Result<Self> {
        let mut span = check_allowed(cost, rows, cols)?;
        switching.check(rows, cols)?;
        let matrix = Self { penalty: None, switching: *switching, ..Self::new(cost, rows, cols) };
        if span.forbidden == 0 {
            return Ok(matrix);
        }
        matrix.favoured().for_each(|(row, col)| span.least = span.least.min(cost[row * cols + col] - switching.cost));
        Ok(Self { penalty: Some(span.penalty(rows.min(cols))), ..matrix })
    }

    /// The current pairs that are allowed.
    fn favoured(&self) -> impl Iterator<Item = (usize, usize)> {
        let allowed = |&(row, col): &(usize, usize)| self.cost[row * self.cols + col] < f64::INFINITY;
        crate::pairs(self.switching.current).filter(allowed)
    }

    /// Whether the costs are those that the solver works with.
    pub(super) fn is_plain(&self) -> bool {
        self.penalty.is_none() && self.switching.current.iter().all(|&col| col == UNASSIGNED)
    }

    /// Copies the costs, transposed if there are more rows than columns, and pads every row. Forbidden pairs get a price, and
    /// current pairs are cheaper by the switching cost.
    pub(super) fn load(&self, own: &mut Vec<f64>, stride: usize) {
        let &Self { cost, rows, cols, .. } = self;
        let short = rows.min(cols);
        own.clear();
        own.reserve(short * stride);
        for row in 0..short {
            if rows <= cols {
                own.extend_from_slice(&cost[row * cols..(row + 1) * cols]);
            } else {
                own.extend((0..rows).map(|i| cost[i * cols + row]));
            }
            if let Some(penalty) = self.penalty {
                for value in &mut own[row * stride..] {
                    *value = if *value == f64::INFINITY { penalty } else { *value };
                }
            }
            own.resize((row + 1) * stride, f64::INFINITY);
        }
        for (row, col) in self.favoured() {
            own[if rows <= cols { row * stride + col } else { col * stride + row }] -= self.switching.cost;
        }
    }

    /// Row and column of the matrix for those of the solver, whose rows are the shorter side.
    fn place(&self, row: usize, col: usize) -> (usize, usize) {
        if self.rows <= self.cols { (row, col) } else { (col, row) }
    }
}

impl Exact for Matrix<'_> {
    fn terms(&self, row: usize, col: usize) -> [f64; 2] {
        let (row, col) = self.place(row, col);
        let cost = self.cost[row * self.cols + col];
        match self.penalty {
            Some(penalty) if cost == f64::INFINITY => [penalty, 0.0],
            _ if self.switching.holds(row, col) => [cost, -self.switching.cost],
            _ => [cost, 0.0],
        }
    }

    fn current(&self, row: usize, col: usize) -> bool {
        let (row, col) = self.place(row, col);
        self.switching.holds(row, col) && self.cost[row * self.cols + col] < f64::INFINITY
    }

    fn forbidden(&self, row: usize, col: usize) -> bool {
        let (row, col) = self.place(row, col);
        self.penalty.is_some() && self.cost[row * self.cols + col] == f64::INFINITY
    }

    fn by_columns(&self) -> bool {
        self.rows > self.cols
    }
}
