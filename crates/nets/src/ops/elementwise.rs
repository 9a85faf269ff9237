use super::simd::{self, LANES, load, store};
use super::{slice, values};
use candle_core::{CpuStorage, CustomOp1, D, Layout, Result, Shape, Tensor};
use wide::f32x16;

/// eˣ with the same bits on every machine (candle's calls the platform's libm). NaN, overflow and underflow as in IEEE.
pub fn exp(x: &Tensor) -> Result<Tensor> {
    x.contiguous()?.apply_op1(Elementwise::Exp)
}

/// Hyperbolic tangent with the same bits on every machine.
pub fn tanh(x: &Tensor) -> Result<Tensor> {
    x.contiguous()?.apply_op1(Elementwise::Tanh)
}

/// Softmax over the last dimension, on [`exp()`].
pub fn softmax(x: &Tensor) -> Result<Tensor> {
    let exps = exp(&x.broadcast_sub(&x.max_keepdim(D::Minus1)?.detach())?)?;
    exps.broadcast_div(&exps.sum_keepdim(D::Minus1)?)
}

/// A function whose derivative can be written in terms of its value.
enum Elementwise {
    Exp,
    Tanh,
}

impl CustomOp1 for Elementwise {
    fn name(&self) -> &'static str {
        match self {
            Self::Exp => "exp",
            Self::Tanh => "tanh",
        }
    }

    fn cpu_fwd(&self, x: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let x = slice(x, layout)?;
        let mut y = vec![0.0; x.len()];
        let f = match self {
            Self::Exp => f32x16::exp,
            Self::Tanh => simd::tanh,
        };
        for (x, y) in x.chunks(LANES).zip(y.chunks_mut(LANES)) {
            store(f(load(x)), y);
        }
        Ok((CpuStorage::F32(y), layout.shape().clone()))
    }

    fn bwd(&self, _x: &Tensor, y: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
        let mut dx = values(dy)?;
        for (d, y) in dx.iter_mut().zip(values(y)?) {
            *d *= match self {
                Self::Exp => y,
                Self::Tanh => 1.0 - y * y,
            };
        }
        Ok(Some(Tensor::from_vec(dx, y.shape(), y.device())?))
    }
}
