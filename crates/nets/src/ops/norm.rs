use super::matmul::Rows;
use super::operation::{Arg, Operation, apply3};
use super::simd::{LANES, load, store, sum};
use candle_core::{Result, Shape, Tensor, bail};
use wide::f32x16;

/// Layer normalisation over the last dimension with scale and shift `[n]`; ε = 1e-5. Unlike candle-nn's it has a gradient.
pub fn layer_norm(x: &Tensor, scale: &Tensor, shift: &Tensor) -> Result<Tensor> {
    apply3(LayerNorm, [x, scale, shift])
}

/// The same for rows [R, n] of plain numbers, with the same bits.
pub(crate) fn layer_norm_in_place(x: &mut [f32], scale: &[f32], shift: &[f32]) {
    let mut y = vec![0.0; scale.len()];
    for row in x.chunks_exact_mut(scale.len()) {
        normalise(row, scale, shift, &mut y);
        row.copy_from_slice(&y);
    }
}

/// The same from rows x to rows y.
pub(crate) fn normalise(x: &[f32], scale: &[f32], shift: &[f32], y: &mut [f32]) {
    let n = scale.len();
    for (row, out) in x.chunks_exact(n).zip(y.chunks_exact_mut(n)) {
        let (mean, inverse) = moments(row);
        let (mean, inverse) = (f32x16::splat(mean), f32x16::splat(inverse));
        let normal = |x: f32x16, scale: f32x16, shift: f32x16| ((x - mean) * inverse).mul_add(scale, shift);
        let ((x, x_rest), (out, out_rest)) = (row.as_chunks::<LANES>(), out.as_chunks_mut::<LANES>());
        let ((scale, scale_rest), (shift, shift_rest)) = (scale.as_chunks::<LANES>(), shift.as_chunks::<LANES>());
        for ((x, out), (scale, shift)) in x.iter().zip(out).zip(scale.iter().zip(shift)) {
            *out = normal(f32x16::new(*x), f32x16::new(*scale), f32x16::new(*shift)).to_array();
        }
        if !x_rest.is_empty() {
            store(normal(load(x_rest), load(scale_rest), load(shift_rest)), out_rest);
        }
    }
}

struct LayerNorm;

const EPSILON: f32 = 1e-5;

/// Mean and reciprocal deviation of a row, summed in sixteen fixed lanes.
#[inline(always)]
fn moments(row: &[f32]) -> (f32, f32) {
    let n = row.len() as f32;
    let (mut total, mut square) = (f32x16::ZERO, f32x16::ZERO);
    let (whole, rest) = row.as_chunks::<LANES>();
    whole.iter().for_each(|chunk| total += f32x16::new(*chunk));
    if !rest.is_empty() {
        total += load(rest);
    }
    let mean = sum(total) / n;
    for chunk in whole {
        let gap = f32x16::new(*chunk) - f32x16::splat(mean);
        square = gap.mul_add(gap, square);
    }
    if !rest.is_empty() {
        let gap = centred(rest, mean);
        square = gap.mul_add(gap, square);
    }
    (mean, 1.0 / (sum(square) / n + EPSILON).sqrt())
}

/// x − mean of less than a vector; lanes beyond the end of the row are zero.
#[inline(always)]
fn centred(rest: &[f32], mean: f32) -> f32x16 {
    let mut lanes = [0.0; LANES];
    for (lane, x) in lanes.iter_mut().zip(rest) {
        *lane = x - mean;
    }
    f32x16::new(lanes)
}

impl Operation<3> for LayerNorm {
    const NAME: &'static str = "layer-norm";

    fn forward(&self, [x, scale, shift]: [Arg<'_>; 3]) -> Result<(Vec<f32>, Shape)> {
        let (_, n) = x.rows();
        if scale.dims != [n] || shift.dims != [n] {
            bail!("layer norm: scale and shift must have {n} entries");
        }
        let mut y = vec![0.0; x.values.len()];
        normalise(x.values, scale.values, shift.values, &mut y);
        Ok((y, Shape::from(x.dims)))
    }

    fn backward(&self, [x, gains, _]: [Arg<'_>; 3], _y: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 3]> {
        let (x, gains, n) = (x.values, gains.values, gains.values.len());
        let mut dx = vec![0.0; x.len()];
        let mut gradient = NormGradient::new(n);
        gradient.add(x, gains, Rows::new(dy, n), &mut dx, n);
        let (mut ds, mut db) = (vec![0.0; n], vec![0.0; n]);
        gradient.write(&mut ds, &mut db);
        Ok([Some(dx), Some(ds), Some(db)])
    }
}

/// Sums of the gradients of scale and shift.
pub(crate) struct NormGradient {
    scale: Vec<f32x16>,
    shift: Vec<f32x16>,
}

impl NormGradient {
    /// Of rows of n numbers, zero.
    pub(crate) fn new(n: usize) -> Self {
        let zeros = || vec![f32x16::ZERO; n.div_ceil(LANES)];
        Self { scale: zeros(), shift: zeros() }
    }

    /// Takes in rows x [rows, n] and dy; writes dx in rows that are `stride` apart.
    pub(crate) fn add(&mut self, x: &[f32], gains: &[f32], dy: Rows<'_>, dx: &mut [f32], stride: usize) {
        let n = gains.len();
        let (gains, gains_rest) = gains.as_chunks::<LANES>();
        for ((row, dy), dx) in x.chunks_exact(n).zip(dy.values.chunks(dy.stride)).zip(dx.chunks_mut(stride)) {
            let (mean, inverse) = moments(row);
            let spread = f32x16::splat(inverse);
            let (mut a, mut b) = (f32x16::ZERO, f32x16::ZERO);
            let mut sums = self.scale.iter_mut().zip(&mut self.shift);
            let mut take = |normal: f32x16, d: f32x16, gain: f32x16| {
                let g = d * gain;
                a += g;
                b = g.mul_add(normal, b);
                if let Some((scale, shift)) = sums.next() {
                    *scale = d.mul_add(normal, *scale);
                    *shift += d;
                }
            };
            let ((row, row_rest), (dy, dy_rest)) = (row.as_chunks::<LANES>(), dy[..n].as_chunks::<LANES>());
            let normal = |row: &[f32; LANES]| (f32x16::new(*row) - f32x16::splat(mean)) * spread;
            for ((row, dy), gain) in row.iter().zip(dy).zip(gains) {
                take(normal(row), f32x16::new(*dy), f32x16::new(*gain));
            }
            if !row_rest.is_empty() {
                take(centred(row_rest, mean) * spread, load(dy_rest), load(gains_rest));
            }
            let (a, b) = (f32x16::splat(sum(a) / n as f32), f32x16::splat(sum(b) / n as f32));
            let give = |normal: f32x16, d: f32x16, gain: f32x16| spread * (d * gain - a - normal * b);
            let (dx, dx_rest) = dx[..n].as_chunks_mut::<LANES>();
            for (((row, dy), gain), dx) in row.iter().zip(dy).zip(gains).zip(dx) {
                *dx = give(normal(row), f32x16::new(*dy), f32x16::new(*gain)).to_array();
            }
            if !row_rest.is_empty() {
                store(give(centred(row_rest, mean) * spread, load(dy_rest), load(gains_rest)), dx_rest);
            }
        }
    }

    /// Writes the gradients of scale and shift `[n]`.
    pub(crate) fn write(&self, scale: &mut [f32], shift: &mut [f32]) {
        for (sums, out) in [(&self.scale, scale), (&self.shift, shift)] {
            sums.iter().zip(out.chunks_mut(LANES)).for_each(|(sum, out)| store(*sum, out));
        }
    }
}
