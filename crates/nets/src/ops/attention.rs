use super::operation::{Arg, Operation, apply3};
use super::simd::{LANES, load, store, sum};
use candle_core::{Result, Shape, Tensor, bail};
use std::sync::OnceLock;
use wide::f32x16;

/// Scaled dot-product attention among the N agents of each joint state (Vaswani et al. 2017, section 3.2).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Attention {
    /// N: agents of a joint state.
    pub agents: usize,
    /// Heads; each attends within its own part of the width.
    pub heads: usize,
    /// Whether agent i sees agents 0..=i only.
    pub causal: bool,
    /// Factor of the dot products: 1/√(width of a head) in transformers, 1 in DICG.
    pub scale: f32,
}

/// y [S·N, F], y_i = Σ_j softmax_j(scale · q_i·k_j) v_j, head by head, for q, k, v [S·N, F].
///
/// The bits of y_i depend on q_i and on the keys and values that agent i sees, in their order, and on nothing else: decoding agent by
/// agent (`attend`) and evaluating all agents at once give the same log-probabilities.
pub fn attention(q: &Tensor, k: &Tensor, v: &Tensor, shape: Attention) -> Result<Tensor> {
    apply3(Op { shape, weights: OnceLock::new() }, [q, &k.contiguous()?, &v.contiguous()?])
}

/// The keys of one head, transposed so that one vector holds sixteen agents: [width of a head, N rounded up to whole vectors].
#[derive(Debug, Clone)]
pub(crate) struct Keys {
    padded: usize,
    columns: Vec<f32>,
}

impl Keys {
    pub(crate) fn new(agents: usize, width: usize) -> Self {
        let padded = agents.next_multiple_of(LANES);
        Self { padded, columns: vec![0.0; width * padded] }
    }

    /// Sets the key of an agent.
    pub(crate) fn set(&mut self, agent: usize, key: &[f32]) {
        for (column, &key) in self.columns.chunks_exact_mut(self.padded).zip(key) {
            column[agent] = key;
        }
    }
}

/// One row of [`attention`]: a query against the first `count` keys and values. `value` gives the value of an agent; `weights` has
/// room for N rounded up to whole vectors and holds the attention weights afterwards.
#[inline(always)]
pub(crate) fn attend<'a>(
    query: &[f32],
    keys: &Keys,
    count: usize,
    scale: f32,
    value: impl Fn(usize) -> &'a [f32],
    weights: &mut [f32],
    out: &mut [f32],
) {
    let vectors = count.div_ceil(LANES);
    for v in 0..vectors {
        let mut score = f32x16::ZERO;
        for (c, &q) in query.iter().enumerate() {
            score = f32x16::splat(q).mul_add(load(&keys.columns[c * keys.padded + v * LANES..]), score);
        }
        store(score * f32x16::splat(scale), &mut weights[v * LANES..(v + 1) * LANES]);
    }
    let seen = &mut weights[..count];
    let most = seen.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let mut total = f32x16::ZERO;
    for lanes in seen.chunks_mut(LANES) {
        let exps = (load(lanes) - f32x16::splat(most)).exp();
        store(exps, lanes);
        // Lanes beyond the last key are zero here.
        total += load(lanes);
    }
    let inverse = 1.0 / sum(total);
    out.fill(0.0);
    for (j, weight) in seen.iter_mut().enumerate() {
        *weight *= inverse;
        for (out, value) in out.iter_mut().zip(value(j)) {
            *out = weight.mul_add(*value, *out);
        }
    }
}

struct Op {
    shape: Attention,
    /// [S, heads, N, N] weights, for the gradient.
    weights: OnceLock<Vec<f32>>,
}

impl Op {
    /// Keys that agent i sees.
    fn seen(&self, i: usize) -> usize {
        if self.shape.causal { i + 1 } else { self.shape.agents }
    }
}

impl Operation<3> for Op {
    const NAME: &'static str = "attention";

    fn forward(&self, [q, k, v]: [Arg<'_>; 3]) -> Result<(Vec<f32>, Shape)> {
        let ((rows, width), Attention { agents: n, heads, scale, .. }) = (q.rows(), self.shape);
        if k.dims != q.dims || v.dims != q.dims || width % heads != 0 || rows % n != 0 {
            bail!("attention: q {:?}, k {:?}, v {:?}, {heads} heads, {n} agents do not fit", q.dims, k.dims, v.dims);
        }
        let part = width / heads;
        let mut y = vec![0.0; q.values.len()];
        let mut saved = vec![0.0; rows * heads * n];
        let mut keys = Keys::new(n, part);
        let mut weights = vec![0.0; keys.padded];
        for (s, saved) in saved.chunks_exact_mut(heads * n * n).enumerate() {
            let row = |i: usize, h: usize| (s * n + i) * width + h * part;
            for (h, saved) in saved.chunks_exact_mut(n * n).enumerate() {
                (0..n).for_each(|j| keys.set(j, &k.values[row(j, h)..row(j, h) + part]));
                for (i, saved) in saved.chunks_exact_mut(n).enumerate() {
                    let (at, seen) = (row(i, h), self.seen(i));
                    let value = |j: usize| &v.values[row(j, h)..row(j, h) + part];
                    attend(&q.values[at..at + part], &keys, seen, scale, value, &mut weights, &mut y[at..at + part]);
                    saved[..seen].copy_from_slice(&weights[..seen]);
                }
            }
        }
        // Each call of `attention` makes its own operation: the cell is empty.
        let _ = self.weights.set(saved);
        Ok((y, Shape::from(q.dims)))
    }

    fn backward(&self, [q, k, v]: [Arg<'_>; 3], _: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 3]> {
        let Attention { agents: n, heads, scale, .. } = self.shape;
        let Some(saved) = self.weights.get() else { bail!("attention: gradient without forward") };
        let (_, width) = q.rows();
        let part = width / heads;
        let zeros = || vec![0.0; dy.len()];
        let (mut dq, mut dk, mut dv) = (zeros(), zeros(), zeros());
        let mut d_weights = vec![0.0; n];
        for (s, saved) in saved.chunks_exact(heads * n * n).enumerate() {
            for (h, saved) in saved.chunks_exact(n * n).enumerate() {
                let row = |i: usize| (s * n + i) * width + h * part..(s * n + i) * width + (h + 1) * part;
                for (i, weights) in saved.chunks_exact(n).enumerate() {
                    let (seen, d) = (self.seen(i), &dy[row(i)]);
                    let mut mean = 0.0f32;
                    for j in 0..seen {
                        d_weights[j] = dot(d, &v.values[row(j)]);
                        mean = weights[j].mul_add(d_weights[j], mean);
                        add_scaled(&mut dv[row(j)], weights[j], d);
                    }
                    for j in 0..seen {
                        let d_score = scale * weights[j] * (d_weights[j] - mean);
                        add_scaled(&mut dq[row(i)], d_score, &k.values[row(j)]);
                        add_scaled(&mut dk[row(j)], d_score, &q.values[row(i)]);
                    }
                }
            }
        }
        Ok([Some(dq), Some(dk), Some(dv)])
    }
}

#[inline(always)]
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut total = f32x16::ZERO;
    for (a, b) in a.chunks(LANES).zip(b.chunks(LANES)) {
        total = load(a).mul_add(load(b), total);
    }
    sum(total)
}

#[inline(always)]
fn add_scaled(to: &mut [f32], factor: f32, from: &[f32]) {
    for (to, from) in to.iter_mut().zip(from) {
        *to = factor.mul_add(*from, *to);
    }
}
