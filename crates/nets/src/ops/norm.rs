use super::simd::{LANES, load, store, sum};
use super::{rows, slice, with_values};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};
use wide::f32x16;

/// Layer normalisation over the last dimension with scale and shift `[n]`; ε = 1e-5. Unlike candle-nn's it has a gradient.
pub fn layer_norm(x: &Tensor, scale: &Tensor, shift: &Tensor) -> Result<Tensor> {
    x.contiguous()?.apply_op3(scale, shift, LayerNorm)
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

impl CustomOp3 for LayerNorm {
    fn name(&self) -> &'static str {
        "layer-norm"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        lx: &Layout,
        scale: &CpuStorage,
        ls: &Layout,
        shift: &CpuStorage,
        lb: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let n = lx.shape().dims().last().copied().unwrap_or(0);
        if ls.shape().dims() != [n] || lb.shape().dims() != [n] {
            bail!("layer norm: scale and shift must have {n} entries");
        }
        let (x, scale, shift) = (slice(x, lx)?, slice(scale, ls)?, slice(shift, lb)?);
        let mut y = vec![0.0; rows(lx) * n];
        for (row, out) in x.chunks_exact(n).zip(y.chunks_exact_mut(n)) {
            let (mean, inverse) = moments(row);
            let inverse = f32x16::splat(inverse);
            for i in (0..n).step_by(LANES) {
                let to = n.min(i + LANES);
                let normal = centred(&row[i..to], mean) * inverse;
                store(normal.mul_add(load(&scale[i..to]), load(&shift[i..to])), &mut out[i..to]);
            }
        }
        Ok((CpuStorage::F32(y), lx.shape().clone()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        scale: &Tensor,
        _shift: &Tensor,
        _y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let n = scale.elem_count();
        let dy = dy.contiguous()?;
        let gains = scale.to_vec1::<f32>()?;
        let (dx, ds, db) = with_values(x, |x| {
            with_values(&dy, |dy| {
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
                let flat = |data: Vec<f32x16>| data.iter().flat_map(|v| v.to_array()).take(n).collect::<Vec<f32>>();
                (dx, flat(ds), flat(db))
            })
        })??;
        let device = x.device();
        Ok((
            Some(Tensor::from_vec(dx, x.shape(), device)?),
            Some(Tensor::from_vec(ds, n, device)?),
            Some(Tensor::from_vec(db, n, device)?),
        ))
    }
}
