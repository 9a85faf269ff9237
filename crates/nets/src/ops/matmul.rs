//! Matrix products for small layers, row by row: the result of a row does not depend on how many rows there are.
//!
//! Every output is b + x₀w₀ + x₁w₁ + … accumulated in exactly this order with fused multiply-add. That is why the learner,
//! which sees thousands of rows, gets the same bits as an actor, which sees a few hundred: the first importance ratio
//! is exactly 1. The general-purpose `gemm` crate gives no such promise.

use super::simd::{LANES, load, store};
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
    #[inline(always)]
    fn apply(self, x: f32x16) -> f32x16 {
        match self {
            Self::Identity => x,
            Self::Relu => x.fast_max(f32x16::ZERO),
            Self::Tanh => super::simd::tanh(x),
        }
    }

    /// dz = dy · f'(z), written in terms of y = f(z).
    pub(crate) fn backward(self, y: &[f32], dy: &[f32]) -> Vec<f32> {
        let mut dz = dy.to_vec();
        match self {
            Self::Identity => {}
            Self::Relu => {
                for (d, &y) in dz.iter_mut().zip(y) {
                    *d = if y > 0.0 { *d } else { 0.0 };
                }
            }
            Self::Tanh => {
                for (d, &y) in dz.iter_mut().zip(y) {
                    *d *= 1.0 - y * y;
                }
            }
        }
        dz
    }
}

/// Weights [k, n] cut into panels of up to four vectors of columns, filled up with zeros.
pub(crate) struct Packed {
    panels: Vec<(usize, Vec<f32x16>)>,
    rows: usize,
    columns: usize,
}

impl Packed {
    /// From row-major [rows, columns].
    pub(crate) fn new(w: &[f32], rows: usize, columns: usize) -> Self {
        let mut panels = Vec::new();
        let mut start = 0;
        while start < columns {
            let left = (columns - start).div_ceil(LANES);
            let q = if left >= 4 { 4 } else { left.min(2) };
            let mut panel = Vec::with_capacity(rows * q);
            for row in w.chunks_exact(columns) {
                for v in 0..q {
                    let at = (start + v * LANES).min(columns);
                    panel.push(load(&row[at..columns]));
                }
            }
            panels.push((q, panel));
            start += q * LANES;
        }
        Self { panels, rows, columns }
    }

    /// From the transpose of row-major [rows, columns]: a [columns, rows] matrix.
    pub(crate) fn transposed(w: &[f32], rows: usize, columns: usize) -> Self {
        let mut t = vec![0.0; rows * columns];
        for i in 0..rows {
            for j in 0..columns {
                t[j * rows + i] = w[i * columns + j];
            }
        }
        Self::new(&t, columns, rows)
    }
}

/// y [m, n] = act(x [m, k] · w [k, n] + b `[n]`).
pub(crate) fn matmul(x: &[f32], w: &Packed, bias: Option<&[f32]>, act: Activation, y: &mut [f32]) {
    let n = w.columns;
    let mut start = 0;
    for (q, panel) in &w.panels {
        match q {
            4 => panel_rows::<4, 4>(x, panel, w.rows, bias, act, y, n, start),
            2 => panel_rows::<8, 2>(x, panel, w.rows, bias, act, y, n, start),
            _ => panel_rows::<8, 1>(x, panel, w.rows, bias, act, y, n, start),
        }
        start += q * LANES;
    }
}

#[allow(clippy::too_many_arguments)] // a kernel: its operands are its meaning
#[inline(always)]
fn panel_rows<const R: usize, const Q: usize>(
    x: &[f32],
    panel: &[f32x16],
    k: usize,
    bias: Option<&[f32]>,
    act: Activation,
    y: &mut [f32],
    n: usize,
    start: usize,
) {
    let mut init = [f32x16::ZERO; Q];
    if let Some(bias) = bias {
        for (v, slot) in init.iter_mut().enumerate() {
            *slot = load(&bias[(start + v * LANES).min(n)..]);
        }
    }
    let m = x.len().checked_div(k).unwrap_or(0);
    let mut row = 0;
    while row + R <= m {
        tile::<R, Q>(&x[row * k..(row + R) * k], panel, k, &init, act, &mut y[row * n..(row + R) * n], n, start);
        row += R;
    }
    while row < m {
        tile::<1, Q>(&x[row * k..(row + 1) * k], panel, k, &init, act, &mut y[row * n..(row + 1) * n], n, start);
        row += 1;
    }
}

#[allow(clippy::too_many_arguments)]
#[inline(always)]
fn tile<const R: usize, const Q: usize>(
    x: &[f32],
    panel: &[f32x16],
    k: usize,
    init: &[f32x16; Q],
    act: Activation,
    y: &mut [f32],
    n: usize,
    start: usize,
) {
    let mut acc = [*init; R];
    // Slices of exactly k, so that the loop below needs no bounds checks.
    let rows: [&[f32]; R] = std::array::from_fn(|r| &x[r * k..][..k]);
    let panel = &panel[..k * Q];
    for i in 0..k {
        let w = &panel[i * Q..][..Q];
        for (row, acc) in rows.iter().zip(&mut acc) {
            let a = f32x16::splat(row[i]);
            for v in 0..Q {
                acc[v] = a.mul_add(w[v], acc[v]);
            }
        }
    }
    for (r, acc) in acc.iter().enumerate() {
        for (v, value) in acc.iter().enumerate() {
            let from = (start + v * LANES).min(n);
            let to = (from + LANES).min(n);
            store(act.apply(*value), &mut y[r * n + from..r * n + to]);
        }
    }
}

/// dw [k, n] = xᵀ [k, m] · dz [m, n] and db `[n]` = Σ rows of dz, both summed over the rows in their order.
pub(crate) fn weight_gradient(x: &[f32], dz: &[f32], k: usize, n: usize) -> (Vec<f32>, Vec<f32>) {
    let vectors = n.div_ceil(LANES);
    let rows = dz.len().checked_div(n).unwrap_or(0);
    let mut dw = vec![f32x16::ZERO; k * vectors];
    let mut db = vec![f32x16::ZERO; vectors];
    // A block of rows stays in the first cache levels while all of dw passes over it.
    const BLOCK: usize = 128;
    let mut padded = vec![f32x16::ZERO; BLOCK * vectors];
    let mut first = 0;
    while first < rows {
        let count = BLOCK.min(rows - first);
        for r in 0..count {
            let row = &dz[(first + r) * n..(first + r + 1) * n];
            for v in 0..vectors {
                padded[r * vectors + v] = load(&row[v * LANES..]);
                db[v] += padded[r * vectors + v];
            }
        }
        let block = &padded[..count * vectors];
        let x = &x[first * k..(first + count) * k];
        let mut v = 0;
        while v < vectors {
            let left = vectors - v;
            if left >= 4 {
                gradient_columns::<4, 4>(x, block, k, vectors, v, &mut dw);
                v += 4;
            } else if left >= 2 {
                gradient_columns::<8, 2>(x, block, k, vectors, v, &mut dw);
                v += 2;
            } else {
                gradient_columns::<8, 1>(x, block, k, vectors, v, &mut dw);
                v += 1;
            }
        }
        first += count;
    }
    let flatten = |data: &[f32x16], rows: usize| {
        let mut out = vec![0.0; rows * n];
        for r in 0..rows {
            for v in 0..vectors {
                let to = n.min((v + 1) * LANES);
                store(data[r * vectors + v], &mut out[r * n + v * LANES..r * n + to]);
            }
        }
        out
    };
    (flatten(&dw, k), flatten(&db, 1))
}

#[inline(always)]
fn gradient_columns<const R: usize, const Q: usize>(
    x: &[f32],
    block: &[f32x16],
    k: usize,
    vectors: usize,
    v0: usize,
    dw: &mut [f32x16],
) {
    let mut i = 0;
    while i + R <= k {
        gradient_tile::<R, Q>(x, block, k, vectors, v0, i, dw);
        i += R;
    }
    while i < k {
        gradient_tile::<1, Q>(x, block, k, vectors, v0, i, dw);
        i += 1;
    }
}

#[inline(always)]
fn gradient_tile<const R: usize, const Q: usize>(
    x: &[f32],
    block: &[f32x16],
    k: usize,
    vectors: usize,
    v0: usize,
    i: usize,
    dw: &mut [f32x16],
) {
    let mut acc = [[f32x16::ZERO; Q]; R];
    for (r, acc) in acc.iter_mut().enumerate() {
        acc.copy_from_slice(&dw[(i + r) * vectors + v0..(i + r) * vectors + v0 + Q]);
    }
    for (x, dz) in x.chunks_exact(k).zip(block.chunks_exact(vectors)) {
        let x = &x[i..i + R];
        let dz = &dz[v0..v0 + Q];
        for (r, acc) in acc.iter_mut().enumerate() {
            let a = f32x16::splat(x[r]);
            for v in 0..Q {
                acc[v] = a.mul_add(dz[v], acc[v]);
            }
        }
    }
    for (r, acc) in acc.iter().enumerate() {
        dw[(i + r) * vectors + v0..(i + r) * vectors + v0 + Q].copy_from_slice(acc);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use magex_core::rng::{Key, Purpose};

    fn numbers(n: usize, tag: u32) -> Vec<f32> {
        let mut s = Key::new(1, Purpose::Bench, &[tag]).stream();
        (0..n).map(|_| s.normal() as f32).collect()
    }

    #[test]
    fn products_match_double_precision_for_odd_sizes() {
        for (m, k, n) in [(1, 1, 1), (7, 3, 5), (13, 36, 96), (9, 32, 33), (200, 9, 32), (64, 96, 64), (5, 17, 130)] {
            let (x, w, b) = (numbers(m * k, 1), numbers(k * n, 2), numbers(n, 3));
            let mut y = vec![0.0; m * n];
            matmul(&x, &Packed::new(&w, k, n), Some(&b), Activation::Identity, &mut y);
            let dz = numbers(m * n, 4);
            let (dw, db) = weight_gradient(&x, &dz, k, n);
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
