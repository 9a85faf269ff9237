use super::matmul::{Activation, Packed, matmul, weight_gradient};
use super::operation::{Arg, Operation, apply3};
use super::simd::{LANES, load, sigmoid, store, tanh};
use candle_core::{Result, Shape, Tensor, bail};
use std::sync::OnceLock;
use wide::f32x16;

/// Gated recurrent unit over a sequence, gates in the order reset, update, new (the convention of PyTorch).
///
/// `input` [L, R, 3H] is x·W_x + b_x for all steps at once, `w` [H, 3H], `b` `[3H]`, `h0` [R·H] the state that enters the
/// sequence (constant: the gradient is truncated there). Returns all states [L, R, H].
pub fn gru(input: &Tensor, w: &Tensor, b: &Tensor, h0: Vec<f32>) -> Result<Tensor> {
    apply3(Gru { h0, saved: OnceLock::new() }, [input, w, b])
}

struct Gru {
    h0: Vec<f32>,
    /// [L, R, 4H]: reset, update, new, and h·W_n + b_n, for the gradient.
    saved: OnceLock<Vec<f32>>,
}

impl Operation<3> for Gru {
    const NAME: &'static str = "gru";

    fn forward(&self, [x, w, b]: [Arg<'_>; 3]) -> Result<(Vec<f32>, Shape)> {
        let [steps, rows, triple] = *x.dims else { bail!("gru: input {:?} is not [L, R, 3H]", x.dims) };
        let hidden = triple / 3;
        if hidden % LANES != 0 || w.dims != [hidden, triple] || self.h0.len() != rows * hidden {
            bail!("gru: input {:?}, w {:?}, {} initial states do not fit", x.dims, w.dims, self.h0.len());
        }
        let (x, w, b) = (x.values, Packed::new(w.values, hidden, triple), b.values);
        let mut states = vec![0.0; steps * rows * hidden];
        let mut saved = vec![0.0; steps * rows * 4 * hidden];
        let mut recurrent = vec![0.0; rows * triple];
        let mut h = self.h0.clone();
        for t in 0..steps {
            matmul(&h, &w, Some(b), Activation::Identity, &mut recurrent);
            for r in 0..rows {
                let x = &x[(t * rows + r) * triple..][..triple];
                let u = &recurrent[r * triple..][..triple];
                let keep = &mut saved[(t * rows + r) * 4 * hidden..][..4 * hidden];
                let h = &mut h[r * hidden..][..hidden];
                for v in (0..hidden).step_by(LANES) {
                    let reset = sigmoid(load(&x[v..]) + load(&u[v..]));
                    let update = sigmoid(load(&x[hidden + v..]) + load(&u[hidden + v..]));
                    let candidate = load(&u[2 * hidden + v..]);
                    let new = tanh(reset.mul_add(candidate, load(&x[2 * hidden + v..])));
                    let old = load(&h[v..]);
                    store(update.mul_add(old - new, new), &mut h[v..]);
                    store(reset, &mut keep[v..]);
                    store(update, &mut keep[hidden + v..]);
                    store(new, &mut keep[2 * hidden + v..]);
                    store(candidate, &mut keep[3 * hidden + v..]);
                }
            }
            states[t * rows * hidden..(t + 1) * rows * hidden].copy_from_slice(&h);
        }
        // A second forward through the same operation cannot happen: each call of `gru` makes its own.
        let _ = self.saved.set(saved);
        Ok((states, Shape::from((steps, rows, hidden))))
    }

    fn backward(&self, [x, w, _]: [Arg<'_>; 3], states: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 3]> {
        let [steps, rows, triple] = *x.dims else { bail!("gru: input {:?} is not [L, R, 3H]", x.dims) };
        let hidden = triple / 3;
        let Some(saved) = self.saved.get() else { bail!("gru: gradient without forward") };
        let transposed = Packed::transposed(w.values, hidden, triple);
        // Gradients of the input projections and of the recurrent projections; they differ in the new gate only.
        let mut dx = vec![0.0; steps * rows * triple];
        let mut du = vec![0.0; steps * rows * triple];
        let size = rows * hidden;
        let (mut dh, mut back) = (vec![0.0; size], vec![0.0; size]);
        let previous = [&self.h0[..], &states[..(steps - 1) * size]].concat();
        for t in (0..steps).rev() {
            for r in 0..rows {
                let keep = &saved[(t * rows + r) * 4 * hidden..][..4 * hidden];
                let at = (t * rows + r) * triple;
                for v in (0..hidden).step_by(LANES) {
                    let one = f32x16::ONE;
                    let (reset, update) = (load(&keep[v..]), load(&keep[hidden + v..]));
                    let (new, candidate) = (load(&keep[2 * hidden + v..]), load(&keep[3 * hidden + v..]));
                    let old = load(&previous[(t * rows + r) * hidden + v..]);
                    let d = load(&dh[r * hidden + v..]) + load(&dy[(t * rows + r) * hidden + v..]);
                    let d_new = d * (one - update) * (one - new * new);
                    let d_update = d * (old - new) * update * (one - update);
                    let d_reset = d_new * candidate * reset * (one - reset);
                    let d_candidate = d_new * reset;
                    store(d_reset, &mut dx[at + v..]);
                    store(d_update, &mut dx[at + hidden + v..]);
                    store(d_new, &mut dx[at + 2 * hidden + v..at + triple]);
                    store(d_reset, &mut du[at + v..]);
                    store(d_update, &mut du[at + hidden + v..]);
                    store(d_candidate, &mut du[at + 2 * hidden + v..at + triple]);
                    store(d * update, &mut dh[r * hidden + v..]);
                }
            }
            let du = &du[t * rows * triple..(t + 1) * rows * triple];
            matmul(du, &transposed, None, Activation::Identity, &mut back);
            for (d, b) in dh.iter_mut().zip(&back) {
                *d += b;
            }
        }
        let (dw, db) = weight_gradient(&previous, &du, hidden, triple);
        Ok([Some(dx), Some(dw), Some(db)])
    }
}
