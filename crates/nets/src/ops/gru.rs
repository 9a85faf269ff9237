use super::matmul::{Activation, Packed, matmul, weight_gradient};
use super::simd::{LANES, load, sigmoid, store, tanh};
use super::{slice, values, with_values};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};
use std::sync::OnceLock;
use wide::f32x16;

/// Gated recurrent unit over a sequence, gates in the order reset, update, new (the convention of PyTorch).
///
/// `input` [L, R, 3H] is x·W_x + b_x for all steps at once, `w` [H, 3H], `b` `[3H]`, `h0` [R·H] the state that enters the
/// sequence (constant: the gradient is truncated there). Returns all states [L, R, H].
pub fn gru(input: &Tensor, w: &Tensor, b: &Tensor, h0: Vec<f32>) -> Result<Tensor> {
    input.contiguous()?.apply_op3(w, b, Gru { h0, saved: OnceLock::new() })
}

struct Gru {
    h0: Vec<f32>,
    /// [L, R, 4H]: reset, update, new, and h·W_n + b_n, for the gradient.
    saved: OnceLock<Vec<f32>>,
}

impl CustomOp3 for Gru {
    fn name(&self) -> &'static str {
        "gru"
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
        let (steps, rows, triple) = lx.shape().dims3()?;
        let hidden = triple / 3;
        if hidden % LANES != 0 || lw.shape().dims() != [hidden, triple] || self.h0.len() != rows * hidden {
            bail!(
                "gru: input [{steps}, {rows}, {triple}], w {:?}, {} initial states do not fit",
                lw.dims(),
                self.h0.len()
            );
        }
        let (x, w, b) = (slice(x, lx)?, Packed::new(slice(w, lw)?, hidden, triple), slice(b, lb)?);
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
        Ok((CpuStorage::F32(states), Shape::from((steps, rows, hidden))))
    }

    fn bwd(
        &self,
        x: &Tensor,
        w: &Tensor,
        b: &Tensor,
        states: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (steps, rows, triple) = x.dims3()?;
        let hidden = triple / 3;
        let Some(saved) = self.saved.get() else { bail!("gru: gradient without forward") };
        let transposed = Packed::transposed(&values(w)?, hidden, triple);
        let dy = dy.contiguous()?;
        // Gradients of the input projections and of the recurrent projections; they differ in the new gate only.
        let mut dx = vec![0.0; steps * rows * triple];
        let mut du = vec![0.0; steps * rows * triple];
        let mut previous = vec![0.0; steps * rows * hidden];
        let mut dh = vec![0.0; rows * hidden];
        let mut back = vec![0.0; rows * hidden];
        let size = rows * hidden;
        with_values(states, |states| {
            previous[..size].copy_from_slice(&self.h0);
            previous[size..].copy_from_slice(&states[..(steps - 1) * size]);
        })?;
        with_values(&dy, |dy| {
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
        })?;
        let (dw, db) = weight_gradient(&previous, &du, hidden, triple);
        let device = x.device();
        Ok((
            Some(Tensor::from_vec(dx, x.shape(), device)?),
            Some(Tensor::from_vec(dw, w.shape(), device)?),
            Some(Tensor::from_vec(db, b.shape(), device)?),
        ))
    }
}
