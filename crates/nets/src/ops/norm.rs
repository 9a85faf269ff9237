use super::{rows, slice, with_numbers};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};

/// Layer normalisation over the last dimension with scale and shift [n]; ε = 1e-5. Unlike candle-nn's it has a gradient.
pub fn layer_norm(x: &Tensor, scale: &Tensor, shift: &Tensor) -> Result<Tensor> {
    x.contiguous()?.apply_op3(scale, shift, LayerNorm)
}

struct LayerNorm;

const EPSILON: f32 = 1e-5;

/// Mean and reciprocal deviation of a row, summed in index order.
fn moments(row: &[f32]) -> (f32, f32) {
    let n = row.len() as f32;
    let mean = row.iter().sum::<f32>() / n;
    let variance = row.iter().map(|x| (x - mean) * (x - mean)).sum::<f32>() / n;
    (mean, 1.0 / (variance + EPSILON).sqrt())
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
            for i in 0..n {
                out[i] = ((row[i] - mean) * inverse).mul_add(scale[i], shift[i]);
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
        let (dx, ds, db) = with_numbers(x, |x| {
            with_numbers(&dy, |dy| {
                let mut dx = vec![0.0; x.len()];
                let (mut ds, mut db) = (vec![0.0; n], vec![0.0; n]);
                let mut normal = vec![0.0; n];
                for ((row, dy), dx) in x.chunks_exact(n).zip(dy.chunks_exact(n)).zip(dx.chunks_exact_mut(n)) {
                    let (mean, inverse) = moments(row);
                    let (mut a, mut b) = (0.0, 0.0);
                    for i in 0..n {
                        normal[i] = (row[i] - mean) * inverse;
                        let g = dy[i] * gains[i];
                        a += g;
                        b += g * normal[i];
                        ds[i] += dy[i] * normal[i];
                        db[i] += dy[i];
                    }
                    let (a, b) = (a / n as f32, b / n as f32);
                    for i in 0..n {
                        dx[i] = inverse * (dy[i] * gains[i] - a - normal[i] * b);
                    }
                }
                (dx, ds, db)
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
