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
    let n = scale.len();
    for row in x.chunks_exact_mut(n) {
        let (mean, inverse) = moments(row);
        let inverse = f32x16::splat(inverse);
        for i in (0..n).step_by(LANES) {
            let to = n.min(i + LANES);
            let normal = centred(&row[i..to], mean) * inverse;
            store(normal.mul_add(load(&scale[i..to]), load(&shift[i..to])), &mut row[i..to]);
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
    for chunk in row.chunks(LANES) {
        total += load(chunk);
    }
    let mean = sum(total) / n;
    for chunk in row.chunks(LANES) {
        let gap = centred(chunk, mean);
        square = gap.mul_add(gap, square);
    }
    (mean, 1.0 / (sum(square) / n + EPSILON).sqrt())
}

/// x − mean; lanes beyond the end of the row are zero.
#[inline(always)]
fn centred(chunk: &[f32], mean: f32) -> f32x16 {
    if chunk.len() == LANES {
        load(chunk) - f32x16::splat(mean)
    } else {
        let mut lanes = [0.0; LANES];
        for (lane, x) in lanes.iter_mut().zip(chunk) {
            *lane = x - mean;
        }
        f32x16::new(lanes)
    }
}

impl Operation<3> for LayerNorm {
    const NAME: &'static str = "layer-norm";

    fn forward(&self, [x, scale, shift]: [Arg<'_>; 3]) -> Result<(Vec<f32>, Shape)> {
        let (_, n) = x.rows();
        if scale.dims != [n] || shift.dims != [n] {
            bail!("layer norm: scale and shift must have {n} entries");
        }
        let (shape, x, scale, shift) = (Shape::from(x.dims), x.values, scale.values, shift.values);
        let mut y = x.to_vec();
        layer_norm_in_place(&mut y, scale, shift);
        Ok((y, shape))
    }

    fn backward(&self, [x, gains, _]: [Arg<'_>; 3], _y: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 3]> {
        let (x, gains, n) = (x.values, gains.values, gains.values.len());
        let mut dx = vec![0.0; x.len()];
        let vectors = n.div_ceil(LANES);
        let (mut ds, mut db) = (vec![f32x16::ZERO; vectors], vec![f32x16::ZERO; vectors]);
        for ((row, dy), dx) in x.chunks_exact(n).zip(dy.chunks_exact(n)).zip(dx.chunks_exact_mut(n)) {
            let (mean, inverse) = moments(row);
            let spread = f32x16::splat(inverse);
            let (mut a, mut b) = (f32x16::ZERO, f32x16::ZERO);
            for v in 0..vectors {
                let (from, to) = (v * LANES, n.min((v + 1) * LANES));
                let normal = centred(&row[from..to], mean) * spread;
                let d = load(&dy[from..to]);
                let g = d * load(&gains[from..to]);
                a += g;
                b = g.mul_add(normal, b);
                ds[v] = d.mul_add(normal, ds[v]);
                db[v] += d;
            }
            let (a, b) = (f32x16::splat(sum(a) / n as f32), f32x16::splat(sum(b) / n as f32));
            for v in 0..vectors {
                let (from, to) = (v * LANES, n.min((v + 1) * LANES));
                let normal = centred(&row[from..to], mean) * spread;
                let g = load(&dy[from..to]) * load(&gains[from..to]);
                store(spread * (g - a - normal * b), &mut dx[from..to]);
            }
        }
        let flat = |data: Vec<f32x16>| data.iter().flat_map(|v| v.to_array()).take(n).collect();
        Ok([Some(dx), Some(flat(ds)), Some(flat(db))])
    }
}
