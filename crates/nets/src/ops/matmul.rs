//! Matrix products for small layers, row by row: the result of a row does not depend on how many rows there are.
//!
//! Every output is b + x₀w₀ + x₁w₁ + … accumulated in exactly this order with fused multiply-add. That is why the learner,
//! which sees thousands of rows, gets the same bits as an actor, which sees a few hundred: the first importance ratio
//! is exactly 1. The general-purpose `gemm` crate gives no such promise.
//!
//! A tile of outputs stays in registers: six rows of four vectors where there are thirty-two registers of sixteen lanes, six rows of
//! one vector where there are sixteen of eight. Rows are written out by a macro, because the compiler keeps an array of accumulators
//! in memory when it unrolls a loop over more than sixteen of them too late.

pub(crate) use super::simd::Rows;
use super::simd::{LANES, WIDE, load, store, tanh, transpose};
use wide::f32x16;

/// What is applied to a layer's output.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Activation {
    /// Nothing.
    Identity,
    /// max(x, 0), with derivative 0 at 0.
    Relu,
    /// Hyperbolic tangent.
    Tanh,
}

impl Activation {
    /// dz = dy · f'(z), written in terms of y = f(z).
    #[inline(always)]
    pub(crate) fn slope(self, y: f32x16, dy: f32x16) -> f32x16 {
        match self {
            Self::Identity => dy,
            Self::Relu => y.simd_gt(f32x16::ZERO) & dy,
            Self::Tanh => dy * (f32x16::ONE - y * y),
        }
    }
}

/// Vectors of a panel, at most.
pub(crate) const PANEL: usize = if WIDE { 4 } else { 1 };

/// Weights [k, n] cut into panels of up to [`PANEL`] vectors of columns, filled up with zeros.
pub(crate) struct Packed {
    panels: Vec<(usize, Vec<f32x16>)>,
    rows: usize,
    columns: usize,
}

impl Packed {
    /// From row-major [rows, columns].
    pub(crate) fn new(w: &[f32], rows: usize, columns: usize) -> Self {
        let mut packed = Self::zeros(rows, columns, PANEL);
        packed.fill(Rows::new(w, columns));
        packed
    }

    /// From the transpose of row-major [rows, columns]: a [columns, rows] matrix.
    pub(crate) fn transposed(w: &[f32], rows: usize, columns: usize) -> Self {
        let mut packed = Self::zeros(columns, rows, PANEL);
        packed.fill_transposed(Rows::new(w, columns));
        packed
    }

    /// Room for a [rows, columns] matrix in panels of up to `most` vectors (one, two or four), zero.
    pub(crate) fn zeros(rows: usize, columns: usize, most: usize) -> Self {
        let mut panels = Vec::new();
        let mut left = columns.div_ceil(LANES);
        while left > 0 {
            let q = if left >= 4 { 4 } else { left.min(2) }.min(most);
            panels.push((q, vec![f32x16::ZERO; rows * q]));
            left -= q;
        }
        Self { panels, rows, columns }
    }

    /// Takes in rows of the matrix.
    pub(crate) fn fill(&mut self, w: Rows<'_>) {
        let mut at = 0;
        for (q, panel) in &mut self.panels {
            for (vectors, row) in panel.chunks_exact_mut(*q).zip(w.values.chunks(w.stride)) {
                let row = &row[at..self.columns];
                vectors.iter_mut().zip(row.chunks(LANES)).for_each(|(vector, row)| *vector = load(row));
            }
            at += *q * LANES;
        }
    }

    /// Takes in columns of the matrix, which stand in rows.
    pub(crate) fn fill_transposed(&mut self, w: Rows<'_>) {
        let mut at = 0;
        for (q, panel) in &mut self.panels {
            let width = *q * LANES;
            let numbers = wide::bytemuck::cast_slice_mut(panel);
            transpose(w.skip(at * w.stride), width.min(self.columns - at), self.rows, numbers, width);
            at += width;
        }
    }
}

/// What the sums of a product begin with.
#[derive(Clone, Copy)]
pub(crate) enum Start<'a> {
    Zero,
    /// `[n]`, the same for every row.
    Bias(&'a [f32]),
    /// What stands in the output.
    Output,
}

/// y [m, n] = act(x [m, k] · w [k, n] + b `[n]`).
pub(crate) fn matmul(x: &[f32], w: &Packed, bias: Option<&[f32]>, act: Activation, y: &mut [f32]) {
    let rows = y.len().checked_div(w.columns).unwrap_or(0);
    layer(Rows::new(x, w.rows), w, bias.map_or(Start::Zero, Start::Bias), act, y, w.columns, rows);
}

/// The same for rows that are apart, in x as in y.
pub(crate) fn layer(
    x: Rows<'_>,
    w: &Packed,
    start: Start<'_>,
    act: Activation,
    y: &mut [f32],
    stride: usize,
    rows: usize,
) {
    match act {
        Activation::Identity => product(x, w, start, y, stride, rows, |z, _, _, _| z),
        Activation::Relu => product(x, w, start, y, stride, rows, |z, _, _, _| z.fast_max(f32x16::ZERO)),
        Activation::Tanh => {
            product(x, w, start, y, stride, rows, |z, _, _, _| z);
            // In a pass of its own: with this many instructions behind it, the compiler keeps the sums of a product in memory.
            for row in y.chunks_mut(stride.max(1)).take(rows) {
                let (whole, rest) = row[..w.columns].as_chunks_mut::<LANES>();
                whole.iter_mut().for_each(|z| *z = tanh(f32x16::new(*z)).to_array());
                store(tanh(load(rest)), rest);
            }
        }
    }
}

/// dx = (dz · wᵀ) · f'(x), where x is what the activation of the layer below gave; `w` is packed transposed.
pub(crate) fn backward(
    dz: Rows<'_>,
    w: &Packed,
    (act, x): (Activation, Rows<'_>),
    dx: &mut [f32],
    stride: usize,
    rows: usize,
) {
    let at = |row: usize, column: usize, count: usize| load(&x.values[row * x.stride + column..][..count]);
    match act {
        Activation::Identity => product(dz, w, Start::Zero, dx, stride, rows, |d, _, _, _| d),
        Activation::Relu => {
            product(dz, w, Start::Zero, dx, stride, rows, |d, r, c, n| Activation::Relu.slope(at(r, c, n), d));
        }
        Activation::Tanh => {
            product(dz, w, Start::Zero, dx, stride, rows, |d, r, c, n| Activation::Tanh.slope(at(r, c, n), d));
        }
    }
}

/// `finish` gets a sum, its row, its first column and how many columns there are.
#[inline(always)]
fn product(
    x: Rows<'_>,
    w: &Packed,
    start: Start<'_>,
    y: &mut [f32],
    stride: usize,
    rows: usize,
    finish: impl Fn(f32x16, usize, usize, usize) -> f32x16 + Copy,
) {
    let mut column = 0;
    for (q, panel) in &w.panels {
        let place = Place { column, columns: w.columns, stride };
        match q {
            4 => panel_rows::<4>(x, panel.as_chunks().0, start, y, place, rows, finish),
            2 => panel_rows::<2>(x, panel.as_chunks().0, start, y, place, rows, finish),
            _ => panel_rows::<1>(x, panel.as_chunks().0, start, y, place, rows, finish),
        }
        column += q * LANES;
    }
}

/// Where a panel's outputs go.
#[derive(Clone, Copy)]
struct Place {
    column: usize,
    columns: usize,
    stride: usize,
}

#[inline(always)]
fn panel_rows<const Q: usize>(
    x: Rows<'_>,
    panel: &[[f32x16; Q]],
    start: Start<'_>,
    y: &mut [f32],
    place: Place,
    rows: usize,
    finish: impl Fn(f32x16, usize, usize, usize) -> f32x16 + Copy,
) {
    let mut row = 0;
    let six = Q == 4 || !WIDE;
    let high = if six { 6 } else { 8 };
    while row + high <= rows {
        if six {
            tile6(x, panel, start, y, place, row, finish);
        } else {
            tile8(x, panel, start, y, place, row, finish);
        }
        row += high;
    }
    while row + 4 <= rows {
        tile4(x, panel, start, y, place, row, finish);
        row += 4;
    }
    while row < rows {
        tile1(x, panel, start, y, place, row, finish);
        row += 1;
    }
}

macro_rules! tile {
    ($name:ident, $rows:literal, $($r:literal)*) => {
        #[inline(always)]
        fn $name<const Q: usize>(
            x: Rows<'_>,
            panel: &[[f32x16; Q]],
            start: Start<'_>,
            y: &mut [f32],
            place: Place,
            row: usize,
            finish: impl Fn(f32x16, usize, usize, usize) -> f32x16 + Copy,
        ) {
            let Place { column, columns, stride } = place;
            let mut acc = [[f32x16::ZERO; Q]; $rows];
            match start {
                Start::Zero => {}
                Start::Bias(bias) => {
                    let bias: [f32x16; Q] =
                        std::array::from_fn(|q| load(&bias[(column + q * LANES).min(columns)..columns]));
                    acc = [bias; $rows];
                }
                Start::Output if column + Q * LANES <= columns => {
                    $(
                        let out = &y[(row + $r) * stride + column..][..Q * LANES];
                        acc[$r].iter_mut().zip(out.as_chunks().0).for_each(|(acc, out)| *acc = f32x16::new(*out));
                    )*
                }
                Start::Output => {
                    $(for q in 0..Q {
                        let from = (column + q * LANES).min(columns);
                        let at = (row + $r) * stride;
                        acc[$r][q] = load(&y[at + from..at + columns]);
                    })*
                }
            }
            // Slices of exactly k, so that the loop below needs no bounds checks.
            let k = panel.len();
            let rows: [&[f32]; $rows] = [$(&x.values[(row + $r) * x.stride..][..k]),*];
            for (i, w) in panel.iter().enumerate() {
                $(
                    let a = f32x16::splat(rows[$r][i]);
                    for q in 0..Q {
                        acc[$r][q] = a.mul_add(w[q], acc[$r][q]);
                    }
                )*
            }
            // Whole vectors need no look at where the columns end.
            if column + Q * LANES <= columns {
                $(
                    let out = &mut y[(row + $r) * stride + column..][..Q * LANES];
                    for (q, out) in out.as_chunks_mut().0.iter_mut().enumerate() {
                        *out = finish(acc[$r][q], row + $r, column + q * LANES, LANES).to_array();
                    }
                )*
                return;
            }
            $(
                let at = (row + $r) * stride;
                for q in 0..Q {
                    let from = column + q * LANES;
                    if from < columns {
                        let count = LANES.min(columns - from);
                        store(finish(acc[$r][q], row + $r, from, count), &mut y[at + from..at + from + count]);
                    }
                }
            )*
        }
    };
}

tile!(tile1, 1, 0);
tile!(tile4, 4, 0 1 2 3);
tile!(tile6, 6, 0 1 2 3 4 5);
tile!(tile8, 8, 0 1 2 3 4 5 6 7);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ops::gradient::Gradient;
    use magex_core::rng::{Key, Purpose};

    fn numbers(n: usize, tag: u32) -> Vec<f32> {
        let mut s = Key::new(1, Purpose::Bench, &[tag]).stream();
        (0..n).map(|_| s.normal() as f32).collect()
    }

    #[test]
    fn products_match_double_precision_for_odd_sizes() {
        for (m, k, n) in [
            (1, 1, 1),
            (7, 3, 5),
            (13, 36, 96),
            (9, 32, 33),
            (200, 9, 32),
            (64, 96, 64),
            (5, 17, 130),
            (70, 64, 5),
            (70, 32, 1),
            (40, 64, 192),
        ] {
            let (x, w, b) = (numbers(m * k, 1), numbers(k * n, 2), numbers(n, 3));
            let mut y = vec![0.0; m * n];
            matmul(&x, &Packed::new(&w, k, n), Some(&b), Activation::Identity, &mut y);
            let dz = numbers(m * n, 4);
            let padded = n.next_multiple_of(LANES);
            let mut wide = vec![0.0; m * padded];
            wide.chunks_exact_mut(padded).zip(dz.chunks_exact(n)).for_each(|(to, from)| to[..n].copy_from_slice(from));
            let mut gradient = Gradient::new(k, n);
            // In two goes: the order of the sums does not depend on it.
            let first = m / 3;
            gradient.add(Rows::new(&x, k), Rows::new(&wide, padded), first);
            gradient.add(Rows::new(&x[first * k..], k), Rows::new(&wide[first * padded..], padded), m - first);
            let (mut dw, mut db) = (vec![0.0; k * n], vec![0.0; n]);
            gradient.write(&mut dw, Some(&mut db));
            let mut dx = vec![0.0; m * k];
            matmul(&dz, &Packed::transposed(&w, k, n), None, Activation::Identity, &mut dx);
            let close = |a: f32, b: f64| (f64::from(a) - b).abs() < 1e-4 * (1.0 + b.abs());
            for r in 0..m {
                for j in 0..n {
                    let exact: f64 = f64::from(b[j])
                        + (0..k).map(|i| f64::from(x[r * k + i]) * f64::from(w[i * n + j])).sum::<f64>();
                    assert!(close(y[r * n + j], exact), "{m}x{k}x{n}");
                }
                for i in 0..k {
                    let exact: f64 = (0..n).map(|j| f64::from(dz[r * n + j]) * f64::from(w[i * n + j])).sum();
                    assert!(close(dx[r * k + i], exact));
                }
            }
            for j in 0..n {
                assert!(close(db[j], (0..m).map(|r| f64::from(dz[r * n + j])).sum()));
                for i in 0..k {
                    let exact = (0..m).map(|r| f64::from(x[r * k + i]) * f64::from(dz[r * n + j])).sum();
                    assert!(close(dw[i * n + j], exact));
                }
            }
        }
    }

    /// What another instruction set would do.
    #[test]
    fn the_width_of_a_panel_does_not_change_a_bit() {
        let (m, k, n) = (101, 36, 119);
        let (x, w, b) = (numbers(m * k, 1), numbers(k * n, 2), numbers(n, 3));
        let product = |most: usize| {
            let mut y = vec![0.0; m * n];
            let mut packed = Packed::zeros(k, n, most);
            packed.fill(Rows::new(&w, n));
            matmul(&x, &packed, Some(&b), Activation::Tanh, &mut y);
            y
        };
        assert!(product(1) == product(4) && product(2) == product(4));
    }

    #[test]
    fn a_row_has_the_same_bits_alone_and_in_a_batch() {
        let (m, k, n) = (101, 36, 96);
        let (x, w, b) = (numbers(m * k, 1), numbers(k * n, 2), numbers(n, 3));
        let packed = Packed::new(&w, k, n);
        let mut all = vec![0.0; m * n];
        matmul(&x, &packed, Some(&b), Activation::Relu, &mut all);
        for r in 0..m {
            let mut one = vec![0.0; n];
            matmul(&x[r * k..(r + 1) * k], &packed, Some(&b), Activation::Relu, &mut one);
            assert_eq!(one, all[r * n..(r + 1) * n]);
        }
    }
}
