use super::matmul::{Activation, Packed, matmul, weight_gradient};
use super::{rows, slice, with_values};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};

/// y [.., n] = act(x [.., k] · w [k, n] + b `[n]`). With `constant_input` no gradient is computed for x: candle would
/// otherwise compute one even for observations.
pub fn linear(x: &Tensor, w: &Tensor, b: &Tensor, act: Activation, constant_input: bool) -> Result<Tensor> {
    x.contiguous()?.apply_op3(w, b, Linear { act, constant_input })
}

struct Linear {
    act: Activation,
    constant_input: bool,
}

impl CustomOp3 for Linear {
    fn name(&self) -> &'static str {
        "linear"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        lx: &Layout,
        w: &CpuStorage,
        lw: &Layout,
        b: &CpuStorage,
        lb: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (k, n) = lw.shape().dims2()?;
        let mut dims = lx.shape().dims().to_vec();
        if dims.last() != Some(&k) || lb.shape().dims() != [n] {
            bail!("linear: x {dims:?}, w [{k}, {n}], b {:?} do not fit", lb.shape().dims());
        }
        let m = rows(lx);
        let mut y = vec![0.0; m * n];
        matmul(slice(x, lx)?, &Packed::new(slice(w, lw)?, k, n), Some(slice(b, lb)?), self.act, &mut y);
        if let Some(last) = dims.last_mut() {
            *last = n;
        }
        Ok((CpuStorage::F32(y), Shape::from(dims)))
    }

    fn bwd(
        &self,
        x: &Tensor,
        w: &Tensor,
        _b: &Tensor,
        y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (k, n) = w.dims2()?;
        let dy = dy.contiguous()?;
        let dz = with_values(y, |y| with_values(&dy, |dy| self.act.backward(y, dy)))??;
        let (dw, db) = with_values(x, |x| weight_gradient(x, &dz, k, n))?;
        let dx = if self.constant_input {
            None
        } else {
            let mut dx = vec![0.0; x.elem_count()];
            let packed = with_values(w, |w| Packed::transposed(w, k, n))?;
            matmul(&dz, &packed, None, Activation::Identity, &mut dx);
            Some(Tensor::from_vec(dx, x.shape(), x.device())?)
        };
        let dw = Tensor::from_vec(dw, (k, n), w.device())?;
        let db = Tensor::from_vec(db, n, w.device())?;
        Ok((dx, Some(dw), Some(db)))
    }
}
