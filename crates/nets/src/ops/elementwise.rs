use super::operation::{Arg, Operation, apply1};
use super::simd::{self, LANES, load, store};
use candle_core::{D, Result, Shape, Tensor};
use wide::f32x16;

/// eˣ with the same bits on every machine (candle's calls the platform's libm). NaN, overflow and underflow as in IEEE.
pub fn exp(x: &Tensor) -> Result<Tensor> {
    apply1(Elementwise::Exp, x)
}

/// Hyperbolic tangent with the same bits on every machine.
pub fn tanh(x: &Tensor) -> Result<Tensor> {
    apply1(Elementwise::Tanh, x)
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

impl Operation<1> for Elementwise {
    const NAME: &'static str = "elementwise";

    fn forward(&self, [x]: [Arg<'_>; 1]) -> Result<(Vec<f32>, Shape)> {
        let mut y = vec![0.0; x.values.len()];
        let f = match self {
            Self::Exp => f32x16::exp,
            Self::Tanh => simd::tanh,
        };
        for (x, y) in x.values.chunks(LANES).zip(y.chunks_mut(LANES)) {
            store(f(load(x)), y);
        }
        Ok((y, Shape::from(x.dims)))
    }

    fn backward(&self, _: [Arg<'_>; 1], y: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 1]> {
        let dx = y.iter().zip(dy).map(|(y, d)| match self {
            Self::Exp => d * y,
            Self::Tanh => d * (1.0 - y * y),
        });
        Ok([Some(dx.collect())])
    }
}
