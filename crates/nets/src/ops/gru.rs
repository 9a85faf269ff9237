use super::buffer::Buffer;
use super::gradient::Gradient;
use super::matmul::{Activation, Packed, Rows, Start, layer};
use super::operation::{Arg, Operation, apply3};
use super::simd::{LANES, load, sigmoid, store, tanh};
use candle_core::{Result, Shape, Tensor, bail};
use std::ops::Range;
use std::sync::{Arc, OnceLock};
use wide::f32x16;

/// Gated recurrent unit of H units, gates in the order reset, update, new (the convention of PyTorch).
#[derive(Clone)]
pub struct Gru {
    /// [H, 3H]
    weight: Tensor,
    /// `[3H]`
    bias: Tensor,
    packs: Arc<Packs>,
}

#[derive(Default)]
struct Packs {
    forward: OnceLock<Packed>,
    backward: OnceLock<Packed>,
}

impl Gru {
    /// With recurrent weights [H, 3H] and their bias `[3H]`.
    pub fn new(weight: Tensor, bias: Tensor) -> Self {
        Self { weight, bias, packs: Arc::default() }
    }

    /// Over a sequence: `input` [L, R, 3H] is x·W_x + b_x for all steps at once, `h0` [R·H] the state that enters the sequence
    /// (constant: the gradient is truncated there), `firsts` [L, R] 1 where a sequence begins anew from a state of zeros (empty:
    /// nowhere). Returns all states [L, R, H].
    pub fn forward(&self, input: &Tensor, h0: Vec<f32>, firsts: Vec<u8>) -> Result<Tensor> {
        let keep = [input, &self.weight, &self.bias].into_iter().any(Tensor::track_op);
        let op = Op { h0, firsts, packs: self.packs.clone(), keep, saved: OnceLock::new() };
        apply3(op, [input, &self.weight, &self.bias])
    }
}

/// Rows that pass through all steps before the next ones do: their state stays in the first cache levels.
const TILE: usize = 48;

struct Op {
    h0: Vec<f32>,
    firsts: Vec<u8>,
    packs: Arc<Packs>,
    /// Whether there will be a gradient.
    keep: bool,
    /// [L, R, 4H]: reset, update, new, and h·W_n + b_n.
    saved: OnceLock<Buffer>,
}

/// L, R and H.
fn sizes(x: &Arg<'_>) -> Result<(usize, usize, usize)> {
    let [steps, rows, triple] = *x.dims else { bail!("gru: input {:?} is not [L, R, 3H]", x.dims) };
    Ok((steps, rows, triple / 3))
}

impl Op {
    /// Zeros the rows of a tile, in `out`, whose sequences begin with step t. `None` if none does.
    fn begun<'a>(
        &self,
        old: &[f32],
        t: usize,
        (rows, hidden): (usize, usize),
        tile: &Range<usize>,
        out: &'a mut Vec<f32>,
    ) -> Option<&'a [f32]> {
        let firsts = self.firsts.get(t * rows + tile.start..t * rows + tile.end)?;
        if firsts.iter().all(|first| *first == 0) {
            return None;
        }
        out.clear();
        out.extend_from_slice(old);
        for (row, _) in firsts.iter().enumerate().filter(|(_, first)| **first != 0) {
            out[row * hidden..(row + 1) * hidden].fill(0.0);
        }
        Some(out)
    }
}

fn tiles(rows: usize) -> impl Iterator<Item = Range<usize>> {
    (0..rows).step_by(TILE).map(move |from| from..rows.min(from + TILE))
}

impl Operation<3> for Op {
    const NAME: &'static str = "gru";

    fn forward(&self, [x, w, b]: [Arg<'_>; 3]) -> Result<(Vec<f32>, Shape)> {
        let (steps, rows, hidden) = sizes(&x)?;
        let triple = 3 * hidden;
        if hidden % LANES != 0 || w.dims != [hidden, triple] || b.dims != [triple] || self.h0.len() != rows * hidden {
            bail!("gru: input {:?}, w {:?}, {} initial states do not fit", x.dims, w.dims, self.h0.len());
        }
        let pack = self.packs.forward.get_or_init(|| Packed::new(w.values, hidden, triple));
        let mut states = vec![0.0; steps * rows * hidden];
        let mut saved = Buffer::take(if self.keep { steps * rows * 4 * hidden } else { 4 * hidden });
        let mut recurrent = Buffer::take(TILE.min(rows) * triple);
        let mut begun = Vec::new();
        for tile in tiles(rows) {
            for t in 0..steps {
                let (before, now) = states.split_at_mut(t * rows * hidden);
                let before = match t {
                    0 => &self.h0[..],
                    _ => &before[(t - 1) * rows * hidden..],
                };
                let old = &before[tile.start * hidden..tile.end * hidden];
                let old = self.begun(old, t, (rows, hidden), &tile, &mut begun).unwrap_or(old);
                let u = &mut recurrent[..tile.len() * triple];
                layer(Rows::new(old, hidden), pack, Start::Bias(b.values), Activation::Identity, u, triple, tile.len());
                for (i, (r, u)) in tile.clone().zip(u.chunks_exact(triple)).enumerate() {
                    let at = t * rows + r;
                    let keep = if self.keep { at } else { 0 };
                    gates(
                        &x.values[at * triple..][..triple],
                        u,
                        &old[i * hidden..][..hidden],
                        &mut now[r * hidden..][..hidden],
                        &mut saved[keep * 4 * hidden..][..4 * hidden],
                    );
                }
            }
        }
        if self.keep {
            // Each call of `forward` makes its own operation: the cell is empty.
            let _ = self.saved.set(saved);
        }
        Ok((states, Shape::from((steps, rows, hidden))))
    }

    fn backward(&self, [x, w, _]: [Arg<'_>; 3], states: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 3]> {
        let (steps, rows, hidden) = sizes(&x)?;
        let triple = 3 * hidden;
        let Some(saved) = self.saved.get() else { bail!("gru: gradient without forward") };
        let transposed = self.packs.backward.get_or_init(|| Packed::transposed(w.values, hidden, triple));
        // Gradients of the input projections and of the recurrent projections; they differ in the new gate only.
        let mut dx = vec![0.0; steps * rows * triple];
        let mut du = Buffer::take(TILE.min(rows) * triple);
        let mut dh = Buffer::take(TILE.min(rows) * hidden);
        let mut gradient = Gradient::new(hidden, triple);
        let mut begun = Vec::new();
        for tile in tiles(rows) {
            let dh = &mut dh[..tile.len() * hidden];
            dh.fill(0.0);
            for t in (0..steps).rev() {
                let before = match t {
                    0 => &self.h0[..],
                    _ => &states[(t - 1) * rows * hidden..],
                };
                let before = &before[tile.start * hidden..tile.end * hidden];
                let before = self.begun(before, t, (rows, hidden), &tile, &mut begun).unwrap_or(before);
                for (i, r) in tile.clone().enumerate() {
                    let at = t * rows + r;
                    gate_gradients(
                        &saved[at * 4 * hidden..][..4 * hidden],
                        &before[i * hidden..][..hidden],
                        &dy[at * hidden..][..hidden],
                        &mut dh[i * hidden..][..hidden],
                        &mut dx[at * triple..][..triple],
                        &mut du[i * triple..][..triple],
                    );
                }
                let du = Rows::new(&du[..tile.len() * triple], triple);
                gradient.add(Rows::new(before, hidden), du, tile.len());
                layer(du, transposed, Start::Output, Activation::Identity, dh, hidden, tile.len());
                // A sequence that began here has no step before.
                if let Some(firsts) = self.firsts.get(t * rows + tile.start..t * rows + tile.end) {
                    for (row, _) in firsts.iter().enumerate().filter(|(_, first)| **first != 0) {
                        dh[row * hidden..(row + 1) * hidden].fill(0.0);
                    }
                }
            }
        }
        let (mut dw, mut db) = (vec![0.0; hidden * triple], vec![0.0; triple]);
        gradient.write(&mut dw, Some(&mut db));
        Ok([Some(dx), Some(dw), Some(db)])
    }
}

/// One row of one step: x and u [3H] are the projections of input and state.
#[inline(always)]
fn gates(x: &[f32], u: &[f32], old: &[f32], state: &mut [f32], keep: &mut [f32]) {
    let hidden = old.len();
    for v in (0..hidden).step_by(LANES) {
        let reset = sigmoid(load(&x[v..]) + load(&u[v..]));
        let update = sigmoid(load(&x[hidden + v..]) + load(&u[hidden + v..]));
        let candidate = load(&u[2 * hidden + v..]);
        let new = tanh(reset.mul_add(candidate, load(&x[2 * hidden + v..])));
        store(update.mul_add(load(&old[v..]) - new, new), &mut state[v..]);
        store(reset, &mut keep[v..]);
        store(update, &mut keep[hidden + v..]);
        store(new, &mut keep[2 * hidden + v..]);
        store(candidate, &mut keep[3 * hidden + v..]);
    }
}

/// The way back. `dh` holds the gradient that comes from the next step, and then what goes straight to the step before.
#[inline(always)]
fn gate_gradients(keep: &[f32], old: &[f32], dy: &[f32], dh: &mut [f32], dx: &mut [f32], du: &mut [f32]) {
    let (hidden, one) = (old.len(), f32x16::ONE);
    for v in (0..hidden).step_by(LANES) {
        let (reset, update) = (load(&keep[v..]), load(&keep[hidden + v..]));
        let (new, candidate) = (load(&keep[2 * hidden + v..]), load(&keep[3 * hidden + v..]));
        let d = load(&dh[v..]) + load(&dy[v..]);
        let d_new = d * (one - update) * (one - new * new);
        let d_update = d * (load(&old[v..]) - new) * update * (one - update);
        let d_reset = d_new * candidate * reset * (one - reset);
        store(d_reset, &mut dx[v..]);
        store(d_update, &mut dx[hidden + v..]);
        store(d_new, &mut dx[2 * hidden + v..]);
        store(d_reset, &mut du[v..]);
        store(d_update, &mut du[hidden + v..]);
        store(d_new * reset, &mut du[2 * hidden + v..]);
        store(d * update, &mut dh[v..]);
    }
}
