use super::operation::{Arg, Operation, apply1};
use super::simd::{self, LANES, load, store};
use candle_core::{D, Result, Shape, Tensor};
use wide::f32x16;

/// eˣ with the same bits on every machine (candle's calls the platform's libm). NaN, overflow and underflow as in IEEE.
pub fn exp(x: &Tensor) -> Result<Tensor> {
    map(x, |x| x.exp(), |_, y| y)
}

/// Hyperbolic tangent with the same bits on every machine.
pub fn tanh(x: &Tensor) -> Result<Tensor> {
    map(x, simd::tanh, |_, y| f32x16::ONE - y * y)
}

/// min(max(x, low), high) with derivative 1 between the bounds, which count as between: one operation, where candle takes thirty with
/// the gradients of both bounds.
pub fn clamp(x: &Tensor, low: f32, high: f32) -> Result<Tensor> {
    map(x, move |x| between(x, low, high), |x, y| x.simd_eq(y) & f32x16::ONE)
}

/// Huber loss (Huber 1964): e²/2 for |e| ≤ δ, δ (|e| − δ/2) beyond (candle-nn's has the mean of them only). With m = min(|e|, δ)
/// both are m (|e| − m/2), whose derivative is m with the sign of e.
pub fn huber(error: &Tensor, delta: f32) -> Result<Tensor> {
    let value = move |e: f32x16| {
        let inner = between(e.abs(), 0.0, delta);
        inner * (e.abs() - inner * f32x16::splat(0.5))
    };
    map(error, value, move |e, _| between(e, -delta, delta))
}

/// Exponential linear unit: x above zero, eˣ − 1 elsewhere.
pub fn elu(x: &Tensor) -> Result<Tensor> {
    let (zero, one) = (f32x16::ZERO, f32x16::ONE);
    // The bound first, see `between`.
    let value = move |x: f32x16| zero.fast_max(x) + (zero.fast_min(x).exp() - one);
    map(x, value, move |_, y| one + zero.fast_min(y))
}

/// Gaussian error linear unit in its hyperbolic form (Hendrycks & Gimpel 2016): x/2 · (1 + tanh(√(2/π) (x + 0.044715 x³))),
/// within 5e-4 of x Φ(x).
pub fn gelu(x: &Tensor) -> Result<Tensor> {
    let (half, one) = (f32x16::splat(0.5), f32x16::ONE);
    map(x, gelu_lanes, move |x, _| {
        let gate = gelu_gate(x);
        let inner = (x * x).mul_add(f32x16::splat(3.0 * GELU_CUBE), one) * f32x16::splat(GELU_SCALE);
        half * (one + gate) + half * x * (one - gate * gate) * inner
    })
}

/// Softmax over the last dimension, on [`exp()`].
pub fn softmax(x: &Tensor) -> Result<Tensor> {
    let exps = exp(&x.broadcast_sub(&x.max_keepdim(D::Minus1)?.detach())?)?;
    exps.broadcast_div(&exps.sum_keepdim(D::Minus1)?)
}

/// A function of each number, and its derivative in terms of x and y.
struct Map<V, S> {
    value: V,
    slope: S,
}

fn map<V, S>(x: &Tensor, value: V, slope: S) -> Result<Tensor>
where
    V: Fn(f32x16) -> f32x16 + Send + Sync + 'static,
    S: Fn(f32x16, f32x16) -> f32x16 + Send + Sync + 'static,
{
    apply1(Map { value, slope }, x)
}

impl<V, S> Operation<1> for Map<V, S>
where
    V: Fn(f32x16) -> f32x16 + Send + Sync + 'static,
    S: Fn(f32x16, f32x16) -> f32x16 + Send + Sync + 'static,
{
    const NAME: &'static str = "elementwise";

    fn forward(&self, [x]: [Arg<'_>; 1]) -> Result<(Vec<f32>, Shape)> {
        let mut y = x.values.to_vec();
        y.chunks_mut(LANES).for_each(|y| store((self.value)(load(y)), y));
        Ok((y, Shape::from(x.dims)))
    }

    fn backward(&self, [x]: [Arg<'_>; 1], y: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 1]> {
        let mut dx = dy.to_vec();
        for ((x, y), d) in x.values.chunks(LANES).zip(y.chunks(LANES)).zip(dx.chunks_mut(LANES)) {
            store(load(d) * (self.slope)(load(x), load(y)), d);
        }
        Ok([Some(dx)])
    }
}

/// min(max(x, low), high). The bound comes first: of two operands the instruction gives the second one if one of them is NaN.
#[inline(always)]
fn between(x: f32x16, low: f32, high: f32) -> f32x16 {
    f32x16::splat(high).fast_min(f32x16::splat(low).fast_max(x))
}

const GELU_SCALE: f32 = 0.797_884_6;
const GELU_CUBE: f32 = 0.044_715;

/// tanh of the inner polynomial of GELU.
#[inline(always)]
fn gelu_gate(x: f32x16) -> f32x16 {
    let inner = (x * x).mul_add(f32x16::splat(GELU_CUBE), f32x16::ONE) * x;
    simd::tanh(inner * f32x16::splat(GELU_SCALE))
}

/// GELU of sixteen numbers.
#[inline(always)]
fn gelu_lanes(x: f32x16) -> f32x16 {
    let half = x * f32x16::splat(0.5);
    half.mul_add(gelu_gate(x), half)
}

/// [`gelu`] of plain numbers, with the same bits.
pub(crate) fn gelu_in_place(x: &mut [f32]) {
    x.chunks_mut(LANES).for_each(|x| store(gelu_lanes(load(x)), x));
}
