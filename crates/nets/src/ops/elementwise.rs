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

/// min(max(x, low), high) with derivative 1 between the bounds, which count as between: one operation, where candle takes thirty with
/// the gradients of both bounds.
pub fn clamp(x: &Tensor, low: f32, high: f32) -> Result<Tensor> {
    apply1(Elementwise::Clamp(low, high), x)
}

/// Huber loss (Huber 1964): e²/2 for |e| ≤ δ, δ (|e| − δ/2) beyond (candle-nn's has the mean of them only). With m = min(|e|, δ)
/// both are m (|e| − m/2), whose derivative is m with the sign of e.
pub fn huber(error: &Tensor, delta: f32) -> Result<Tensor> {
    apply1(Elementwise::Huber(delta), error)
}

/// Exponential linear unit: x above zero, eˣ − 1 elsewhere.
pub fn elu(x: &Tensor) -> Result<Tensor> {
    apply1(Elementwise::Elu, x)
}

/// Gaussian error linear unit in its hyperbolic form (Hendrycks & Gimpel 2016): x/2 · (1 + tanh(√(2/π) (x + 0.044715 x³))),
/// within 5e-4 of x Φ(x).
pub fn gelu(x: &Tensor) -> Result<Tensor> {
    apply1(Gelu, x)
}

/// Softmax over the last dimension, on [`exp()`].
pub fn softmax(x: &Tensor) -> Result<Tensor> {
    let exps = exp(&x.broadcast_sub(&x.max_keepdim(D::Minus1)?.detach())?)?;
    exps.broadcast_div(&exps.sum_keepdim(D::Minus1)?)
}

/// A function whose derivative can be written in terms of its value (and of x, for a clamp).
enum Elementwise {
    Exp,
    Tanh,
    Elu,
    Clamp(f32, f32),
    Huber(f32),
}

impl Operation<1> for Elementwise {
    const NAME: &'static str = "elementwise";

    fn forward(&self, [x]: [Arg<'_>; 1]) -> Result<(Vec<f32>, Shape)> {
        if let Self::Huber(delta) = self {
            let losses = x.values.iter().map(|e| {
                let (size, inner) = (e.abs(), clamped(e.abs(), *delta));
                inner * (size - inner * 0.5)
            });
            return Ok((losses.collect(), Shape::from(x.dims)));
        }
        let mut y = vec![0.0; x.values.len()];
        let chunks = x.values.chunks(LANES).zip(y.chunks_mut(LANES));
        match self {
            Self::Exp | Self::Elu => chunks.for_each(|(x, y)| store(load(x).exp(), y)),
            Self::Tanh => chunks.for_each(|(x, y)| store(simd::tanh(load(x)), y)),
            Self::Clamp(low, high) => {
                // The bound first: of two operands the instruction gives the second one if one of them is NaN.
                let (low, high) = (f32x16::splat(*low), f32x16::splat(*high));
                chunks.for_each(|(x, y)| store(high.fast_min(low.fast_max(load(x))), y));
            }
            Self::Huber(_) => {}
        }
        if matches!(self, Self::Elu) {
            y.iter_mut().zip(x.values).for_each(|(y, &x)| *y = if x > 0.0 { x } else { *y - 1.0 });
        }
        Ok((y, Shape::from(x.dims)))
    }

    fn backward(&self, [x]: [Arg<'_>; 1], y: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 1]> {
        let pairs = y.iter().zip(dy);
        Ok([Some(match self {
            Self::Exp => pairs.map(|(y, d)| d * y).collect(),
            Self::Tanh => pairs.map(|(y, d)| d * (1.0 - y * y)).collect(),
            Self::Elu => pairs.map(|(y, d)| d * if *y > 0.0 { 1.0 } else { y + 1.0 }).collect(),
            Self::Huber(delta) => {
                let errors = x.values.iter().zip(dy);
                errors.map(|(e, d)| d * clamped(e.abs(), *delta).copysign(*e)).collect()
            }
            Self::Clamp(..) => x.values.iter().zip(pairs).map(|(x, (y, d))| if x == y { *d } else { 0.0 }).collect(),
        })])
    }
}

/// min(x, high) that keeps what is no number.
#[inline(always)]
fn clamped(x: f32, high: f32) -> f32 {
    if x > high { high } else { x }
}

struct Gelu;

const GELU_SCALE: f32 = 0.797_884_6;
const GELU_CUBE: f32 = 0.044_715;

/// tanh of the inner polynomial of GELU.
#[inline(always)]
fn gelu_gate(x: f32x16) -> f32x16 {
    let inner = (x * x).mul_add(f32x16::splat(GELU_CUBE), f32x16::ONE) * x;
    simd::tanh(inner * f32x16::splat(GELU_SCALE))
}

/// [`gelu`] of plain numbers, with the same bits.
pub(crate) fn gelu_in_place(x: &mut [f32]) {
    for x in x.chunks_mut(LANES) {
        store(gelu_lanes(load(x)), x);
    }
}

/// GELU of sixteen numbers.
#[inline(always)]
fn gelu_lanes(x: f32x16) -> f32x16 {
    let half = x * f32x16::splat(0.5);
    half.mul_add(gelu_gate(x), half)
}

impl Operation<1> for Gelu {
    const NAME: &'static str = "gelu";

    fn forward(&self, [x]: [Arg<'_>; 1]) -> Result<(Vec<f32>, Shape)> {
        let mut y = x.values.to_vec();
        gelu_in_place(&mut y);
        Ok((y, Shape::from(x.dims)))
    }

    fn backward(&self, [x]: [Arg<'_>; 1], _: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 1]> {
        let mut dx = vec![0.0; dy.len()];
        let (half, one) = (f32x16::splat(0.5), f32x16::ONE);
        for ((x, dy), dx) in x.values.chunks(LANES).zip(dy.chunks(LANES)).zip(dx.chunks_mut(LANES)) {
            let (x, dy) = (load(x), load(dy));
            let gate = gelu_gate(x);
            let inner = (x * x).mul_add(f32x16::splat(3.0 * GELU_CUBE), one) * f32x16::splat(GELU_SCALE);
            let slope = half * (one + gate) + half * x * (one - gate * gate) * inner;
            store(slope * dy, dx);
        }
        Ok([Some(dx)])
    }
}
