//! Gradients of weights: dw [k, n] = xᵀ [k, m] · dz [m, n] and db `[n]` = Σ rows of dz, both summed over the rows in their order,
//! however many rows come at once.

use super::matmul::Rows;
use super::simd::{LANES, WIDE, load, store};
use wide::f32x16;

/// Rows that pass over a tile of sums while it is in registers: a tile of a chain, few enough for dz to stay in the first cache level.
const BLOCK: usize = 96;

/// Vectors of a row of sums that are in registers at once, at most.
const VECTORS: usize = if WIDE { 4 } else { 1 };

/// Sums of one layer.
pub(crate) struct Gradient {
    /// [k, n rounded up], or its transpose [n, k] for a layer of few outputs: their vectors would be mostly padding.
    dw: Vec<f32>,
    /// `[n rounded up]`
    db: Vec<f32>,
    k: usize,
    n: usize,
    transposed: bool,
}

impl Gradient {
    /// Of a layer [k, n], zero.
    pub(crate) fn new(k: usize, n: usize) -> Self {
        let padded = n.next_multiple_of(LANES);
        let transposed = n < LANES / 2 && k.is_multiple_of(LANES);
        let dw = vec![0.0; if transposed { n * k } else { k * padded }];
        Self { dw, db: vec![0.0; padded], k, n, transposed }
    }

    /// Takes in some rows: x [rows, k] and dz [rows, n], in whole vectors (what stands beyond column n is of no account).
    pub(crate) fn add(&mut self, x: Rows<'_>, dz: Rows<'_>, rows: usize) {
        let (k, n, padded) = (self.k, self.n, self.db.len());
        for first in (0..rows).step_by(BLOCK) {
            let count = BLOCK.min(rows - first);
            let x = x.skip(first * x.stride);
            let dz = dz.skip(first * dz.stride);
            // Several sums at once hide the latency of an addition; each has its own order either way.
            let fours = padded / (4 * LANES) * 4 * LANES;
            for v in (0..fours).step_by(4 * LANES) {
                bias::<4>(dz.skip(v), &mut self.db[v..], count);
            }
            for v in (fours..padded).step_by(LANES) {
                bias::<1>(dz.skip(v), &mut self.db[v..], count);
            }
            if self.transposed {
                block(dz, n, x, k, &mut self.dw, count, VECTORS);
            } else {
                block(x, k, dz, padded, &mut self.dw, count, VECTORS);
            }
        }
    }

    /// Writes dw [k, n] and, where there is a bias, db `[n]`.
    pub(crate) fn write(&self, dw: &mut [f32], db: Option<&mut [f32]>) {
        let (k, n) = (self.k, self.n);
        if self.transposed {
            for (i, row) in dw.chunks_exact_mut(n).enumerate() {
                row.iter_mut().enumerate().for_each(|(j, dw)| *dw = self.dw[j * k + i]);
            }
        } else {
            for (row, sums) in dw.chunks_exact_mut(n).zip(self.dw.chunks_exact(self.db.len())) {
                row.copy_from_slice(&sums[..n]);
            }
        }
        if let Some(db) = db {
            db.copy_from_slice(&self.db[..n]);
        }
    }
}

/// sums += rows of dz.
#[inline(always)]
fn bias<const Q: usize>(dz: Rows<'_>, sums: &mut [f32], rows: usize) {
    let mut acc: [f32x16; Q] = std::array::from_fn(|q| load(&sums[q * LANES..]));
    for dz in dz.values.chunks(dz.stride).take(rows) {
        for (q, acc) in acc.iter_mut().enumerate() {
            *acc += load(&dz[q * LANES..]);
        }
    }
    acc.into_iter().zip(sums.chunks_mut(LANES)).for_each(|(acc, sums)| store(acc, sums));
}

/// sums [k, width] += xᵀ · dz for a block of rows; `width` is a multiple of the vectors' length.
fn block(x: Rows<'_>, k: usize, dz: Rows<'_>, width: usize, sums: &mut [f32], rows: usize, most: usize) {
    let mut column = 0;
    while column < width {
        let left = most.min((width - column) / LANES);
        let dz = dz.skip(column);
        if left >= 4 {
            columns::<4>(x, k, dz, &mut sums[column..], width, rows);
            column += 4 * LANES;
        } else if left >= 2 {
            columns::<2>(x, k, dz, &mut sums[column..], width, rows);
            column += 2 * LANES;
        } else {
            columns::<1>(x, k, dz, &mut sums[column..], width, rows);
            column += LANES;
        }
    }
}

#[inline(always)]
fn columns<const Q: usize>(x: Rows<'_>, k: usize, dz: Rows<'_>, sums: &mut [f32], width: usize, rows: usize) {
    let mut i = 0;
    while i < k {
        let (left, x, sums) = (k - i, x.skip(i), &mut sums[i * width..]);
        i += if WIDE && Q < 4 && left >= 8 {
            tile8::<Q>(x, dz, sums, width, rows);
            8
        } else if left >= 6 && left != 8 {
            tile6::<Q>(x, dz, sums, width, rows);
            6
        } else if left >= 4 {
            tile4::<Q>(x, dz, sums, width, rows);
            4
        } else {
            tile1::<Q>(x, dz, sums, width, rows);
            1
        };
    }
}

macro_rules! tile {
    ($name:ident, $inputs:literal, $($i:literal)*) => {
        #[inline(always)]
        fn $name<const Q: usize>(x: Rows<'_>, dz: Rows<'_>, sums: &mut [f32], width: usize, rows: usize) {
            let mut acc = [[f32x16::ZERO; Q]; $inputs];
            $(
                for (acc, sums) in acc[$i].iter_mut().zip(sums[$i * width..][..Q * LANES].as_chunks().0) {
                    *acc = f32x16::new(*sums);
                }
            )*
            for (x, dz) in x.values.chunks(x.stride).zip(dz.values.chunks(dz.stride)).take(rows) {
                let (Some(x), Some(dz)) = (x.first_chunk::<$inputs>(), dz.as_chunks().0.first_chunk::<Q>()) else { break };
                let dz = dz.map(f32x16::new);
                $(
                    let a = f32x16::splat(x[$i]);
                    for q in 0..Q {
                        acc[$i][q] = a.mul_add(dz[q], acc[$i][q]);
                    }
                )*
            }
            $(
                for (acc, sums) in acc[$i].iter().zip(sums[$i * width..][..Q * LANES].as_chunks_mut().0) {
                    *sums = acc.to_array();
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

    /// What another instruction set would do.
    #[test]
    fn the_number_of_sums_at_once_does_not_change_a_bit() {
        let (rows, k, width) = (37, 23, 7 * LANES);
        let numbers = |count: usize| (0..count).map(|i| libm::sinf(i as f32)).collect::<Vec<f32>>();
        let (x, dz) = (numbers(rows * k), numbers(rows * width));
        let sums = |most: usize| {
            let mut sums = vec![0.0; k * width];
            block(Rows::new(&x, k), k, Rows::new(&dz, width), width, &mut sums, rows, most);
            sums
        };
        assert!(sums(1) == sums(4) && sums(2) == sums(4));
    }
}
