use super::buffer::Buffer;
use super::gradient::Gradient;
use super::matmul::{Activation, Packed, Rows, Start, layer};
use super::operation::{Arg, Operation, apply2};
use super::simd::{LANES, parts, parts_mut, sigmoid, tanh};
use crate::params::{Init, ParamBuilder, ParamError};
use candle_core::{Result, Shape, Tensor, bail};
use std::ops::Range;
use std::sync::{Arc, OnceLock};
use wide::f32x16;

/// Gated recurrent unit of H units on I inputs, gates in the order reset, update, new (the convention of PyTorch), with the projection
/// of its inputs: one operation, so that the gates' 3H numbers of a row never leave the cache.
#[derive(Clone)]
pub struct Gru {
    sizes: Sizes,
    /// w_x [I, 3H], b_x `[3H]`, w_h [H, 3H] and b_h `[3H]` one after the other.
    parameters: Tensor,
    packs: Arc<Packs>,
}

#[derive(Clone, Copy)]
struct Sizes {
    inputs: usize,
    hidden: usize,
}

impl Sizes {
    fn triple(self) -> usize {
        3 * self.hidden
    }

    /// Where w_x, b_x, w_h and b_h stand.
    fn ranges(self) -> [Range<usize>; 4] {
        let mut at = 0;
        [self.inputs * self.triple(), self.triple(), self.hidden * self.triple(), self.triple()].map(|len| {
            at += len;
            at - len..at
        })
    }
}

/// Weights of input and state as the kernels want them; made once for all uses.
#[derive(Default)]
struct Packs {
    forward: OnceLock<[Packed; 2]>,
    backward: OnceLock<[Packed; 2]>,
}

impl Gru {
    /// With the next parameters: `name.input.weight` and `name.input.bias`, `name.weight` and `name.bias`, each drawn as `inits` say.
    pub fn build(
        name: &str,
        (inputs, hidden): (usize, usize),
        inits: [Init; 4],
        params: &mut ParamBuilder,
    ) -> std::result::Result<Self, ParamError> {
        let names = ["input.weight", "input.bias", "weight", "bias"].map(|part| format!("{name}.{part}"));
        let triple = 3 * hidden;
        let shapes = [vec![inputs, triple], vec![triple], vec![hidden, triple], vec![triple]];
        let members = names.into_iter().zip(shapes).zip(inits).map(|((name, shape), init)| (name, shape, init));
        let parameters = params.group(members.collect())?;
        Ok(Self { sizes: Sizes { inputs, hidden }, parameters, packs: Arc::default() })
    }

    /// Over a sequence: `x` [L·R, I] holds the inputs of all steps, `h0` [R·H] the state that enters the sequence (constant: the
    /// gradient is truncated there), `firsts` [L, R] 1 where a sequence begins anew from a state of zeros (empty: nowhere). Returns
    /// all states [L·R, H].
    pub fn forward(&self, x: &Tensor, h0: Vec<f32>, firsts: Vec<u8>) -> Result<Tensor> {
        apply2(self.operation(h0, firsts, x.track_op()), [x, &self.parameters])
    }

    /// The operation of one use; `keep` says whether what it reads has a gradient.
    pub(super) fn operation(&self, h0: Vec<f32>, firsts: Vec<u8>, keep: bool) -> Op {
        let (packs, keep) = (self.packs.clone(), keep || self.parameters.track_op());
        Op { sizes: self.sizes, h0, firsts, packs, keep, saved: OnceLock::new() }
    }

    pub(super) fn parameters(&self) -> &Tensor {
        &self.parameters
    }
}

/// Rows that pass through all steps before the next ones do: their state stays in the first cache levels.
const TILE: usize = 96;

/// Rows of several steps that the gradient of the weights takes in at once: each pass reads and writes all of its sums.
const TOGETHER: usize = 96;

pub(super) struct Op {
    sizes: Sizes,
    h0: Vec<f32>,
    firsts: Vec<u8>,
    packs: Arc<Packs>,
    /// Whether there will be a gradient.
    keep: bool,
    /// [L, R, 4H]: reset, update, new, and h·W_n + b_n.
    saved: OnceLock<Buffer>,
}

impl Op {
    /// L and R.
    fn steps_and_rows(&self, x: &Arg<'_>) -> Result<(usize, usize)> {
        let Sizes { inputs, hidden } = self.sizes;
        let (all, width) = x.rows();
        let rows = self.h0.len() / hidden.max(1);
        if hidden == 0
            || hidden % LANES != 0
            || width != inputs
            || rows == 0
            || rows * hidden != self.h0.len()
            || all % rows != 0
        {
            bail!(
                "gru: input {:?} and {} initial states do not fit {inputs} inputs, {hidden} units",
                x.dims,
                self.h0.len()
            );
        }
        Ok((all / rows, rows))
    }

    /// Zeros the rows of a tile, in `to`, whose sequences begin with step t. `None` if none does.
    fn begun<'a>(&self, h: &[f32], t: usize, r: usize, tile: &Range<usize>, to: &'a mut Vec<f32>) -> Option<&'a [f32]> {
        let hidden = self.sizes.hidden;
        let firsts = self.firsts.get(t * r + tile.start..t * r + tile.end)?;
        if firsts.iter().all(|first| *first == 0) {
            return None;
        }
        to.clear();
        to.extend_from_slice(h);
        for (row, _) in firsts.iter().enumerate().filter(|(_, first)| **first != 0) {
            to[row * hidden..(row + 1) * hidden].fill(0.0);
        }
        Some(to)
    }
}

/// Tiles of about the same height, which is a multiple of the rows that a product holds in registers.
fn tiles(rows: usize) -> impl Iterator<Item = Range<usize>> {
    let height = rows.div_ceil(rows.div_ceil(TILE).max(1)).next_multiple_of(6);
    (0..rows).step_by(height.max(1)).map(move |from| from..rows.min(from + height))
}

impl Operation<2> for Op {
    const NAME: &'static str = "gru";

    fn forward(&self, [x, p]: [Arg<'_>; 2]) -> Result<(Vec<f32>, Shape)> {
        let (steps, rows) = self.steps_and_rows(&x)?;
        let (Sizes { inputs, hidden }, triple, [w_x, b_x, w_h, b_h]) =
            (self.sizes, self.sizes.triple(), self.sizes.ranges());
        let packs = self
            .packs
            .forward
            .get_or_init(|| [Packed::new(&p.values[w_x], inputs, triple), Packed::new(&p.values[w_h], hidden, triple)]);
        let biases = [&p.values[b_x], &p.values[b_h]];
        let mut states = vec![0.0; steps * rows * hidden];
        let mut saved = Buffer::take(if self.keep { steps * rows * 4 * hidden } else { 4 * hidden });
        let mut gates = Buffer::take(2 * TILE * triple);
        let (of_input, of_state) = gates.split_at_mut(TILE * triple);
        let mut begun = Vec::new();
        for tile in tiles(rows) {
            for t in 0..steps {
                let (before, now) = states.split_at_mut(t * rows * hidden);
                let before = match t {
                    0 => &self.h0[..],
                    _ => &before[(t - 1) * rows * hidden..],
                };
                let old = &before[tile.start * hidden..tile.end * hidden];
                let old = self.begun(old, t, rows, &tile, &mut begun).unwrap_or(old);
                let x = &x.values[(t * rows + tile.start) * inputs..(t * rows + tile.end) * inputs];
                for (from, w, b, to) in [
                    (Rows::new(x, inputs), &packs[0], biases[0], &mut *of_input),
                    (Rows::new(old, hidden), &packs[1], biases[1], &mut *of_state),
                ] {
                    layer(from, w, Start::Bias(b), Activation::Identity, to, triple, tile.len());
                }
                let projected = of_input.chunks_exact(triple).zip(of_state.chunks_exact(triple));
                for ((i, r), (x, u)) in tile.clone().enumerate().zip(projected) {
                    let keep = if self.keep { t * rows + r } else { 0 };
                    gate(
                        x,
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
        Ok((states, Shape::from((steps * rows, hidden))))
    }

    fn backward(&self, [x, p]: [Arg<'_>; 2], states: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 2]> {
        let mut dx = vec![0.0; x.values.len()];
        let d = self.gradients([x, p], states, dy, &mut dx)?;
        Ok([Some(dx), Some(d)])
    }
}

impl Op {
    /// The gradient of the parameters; writes that of the input to dx.
    pub(super) fn gradients(&self, [x, p]: [Arg<'_>; 2], h: &[f32], dy: &[f32], dx: &mut [f32]) -> Result<Vec<f32>> {
        let (steps, rows) = self.steps_and_rows(&x)?;
        let (Sizes { inputs, hidden }, triple, [w_x, b_x, w_h, b_h]) =
            (self.sizes, self.sizes.triple(), self.sizes.ranges());
        let Some(saved) = self.saved.get() else { bail!("gru: gradient without forward") };
        let [to_input, to_state] = self.packs.backward.get_or_init(|| {
            let [w_x, w_h] = [&p.values[w_x.clone()], &p.values[w_h.clone()]];
            [Packed::transposed(w_x, inputs, triple), Packed::transposed(w_h, hidden, triple)]
        });
        let mut dh = Buffer::take(TILE.min(rows) * hidden);
        let mut collected = Collected::new(self.sizes);
        let mut begun = Vec::new();
        for tile in tiles(rows) {
            let dh = &mut dh[..tile.len() * hidden];
            dh.fill(0.0);
            for t in (0..steps).rev() {
                let before = match t {
                    0 => &self.h0[..],
                    _ => &h[(t - 1) * rows * hidden..],
                };
                let before = &before[tile.start * hidden..tile.end * hidden];
                let before = self.begun(before, t, rows, &tile, &mut begun).unwrap_or(before);
                let at = t * rows + tile.start..t * rows + tile.end;
                let inputs = at.start * inputs..at.end * inputs;
                let (d_input, d_state) = collected.room(&x.values[inputs.clone()], before, tile.len());
                for (i, at) in at.enumerate() {
                    gate_gradients(
                        &saved[at * 4 * hidden..][..4 * hidden],
                        &before[i * hidden..][..hidden],
                        &dy[at * hidden..][..hidden],
                        &mut dh[i * hidden..][..hidden],
                        &mut d_input[i * apart(triple)..][..triple],
                        &mut d_state[i * apart(triple)..][..triple],
                    );
                }
                let (identity, count, dx) = (Activation::Identity, tile.len(), &mut dx[inputs]);
                layer(Rows::new(d_input, apart(triple)), to_input, Start::Zero, identity, dx, self.sizes.inputs, count);
                layer(Rows::new(d_state, apart(triple)), to_state, Start::Output, identity, dh, hidden, count);
                // A sequence that began here has no step before.
                if let Some(firsts) = self.firsts.get(t * rows + tile.start..t * rows + tile.end) {
                    for (row, _) in firsts.iter().enumerate().filter(|(_, first)| **first != 0) {
                        dh[row * hidden..(row + 1) * hidden].fill(0.0);
                    }
                }
            }
        }
        collected.add();
        let mut d = vec![0.0; p.values.len()];
        let [of_input, of_state] = &collected.gradients;
        for (gradient, w, b) in [(of_input, w_x, b_x), (of_state, w_h, b_h)] {
            let (dw, db) = d[w.start..b.end].split_at_mut(w.len());
            gradient.write(dw, Some(db));
        }
        Ok(d)
    }
}

/// Rows of several steps on their way into the gradient of the weights.
struct Collected {
    sizes: Sizes,
    /// Of w_x and b_x, and of w_h and b_h.
    gradients: [Gradient; 2],
    /// [rows, I] and [rows, H]: what the weights were multiplied with.
    inputs: Buffer,
    states: Buffer,
    /// [rows, 3H] gradients of both projections, which differ in the new gate only.
    d_inputs: Buffer,
    d_states: Buffer,
    rows: usize,
}

impl Collected {
    fn new(sizes: Sizes) -> Self {
        let triple = sizes.triple();
        Self {
            sizes,
            gradients: [Gradient::new(sizes.inputs, triple), Gradient::new(sizes.hidden, triple)],
            inputs: Buffer::take(TOGETHER * apart(sizes.inputs)),
            states: Buffer::take(TOGETHER * apart(sizes.hidden)),
            d_inputs: Buffer::take(TOGETHER * apart(triple)),
            d_states: Buffer::take(TOGETHER * apart(triple)),
            rows: 0,
        }
    }

    /// Takes in the inputs and states of some rows, and gives the places of their gradients, rows [`apart`].
    fn room(&mut self, inputs: &[f32], states: &[f32], rows: usize) -> (&mut [f32], &mut [f32]) {
        if self.rows + rows > TOGETHER {
            self.add();
        }
        let (from, to) = (self.rows, self.rows + rows);
        let Sizes { inputs: i, hidden: h } = self.sizes;
        for (values, width, to) in [(inputs, i, &mut self.inputs), (states, h, &mut self.states)] {
            let places = to[from * apart(width)..].chunks_exact_mut(apart(width));
            places.zip(values.chunks_exact(width)).for_each(|(place, row)| place[..width].copy_from_slice(row));
        }
        self.rows = to;
        let range = from * apart(self.sizes.triple())..to * apart(self.sizes.triple());
        (&mut self.d_inputs[range.clone()], &mut self.d_states[range])
    }

    /// Adds what has come together to the gradients.
    fn add(&mut self) {
        let (Sizes { inputs, hidden }, triple) = (self.sizes, apart(self.sizes.triple()));
        let [of_input, of_state] = &mut self.gradients;
        of_input.add(Rows::new(&self.inputs, apart(inputs)), Rows::new(&self.d_inputs, triple), self.rows);
        of_state.add(Rows::new(&self.states, apart(hidden)), Rows::new(&self.d_states, triple), self.rows);
        self.rows = 0;
    }
}

/// An odd number of the caches' lines for a row: a column of rows that are 512 bytes apart has room in eight sets of the first cache
/// level, and the gradient of the weights, which reads such columns, took 1.8 times as long.
fn apart(width: usize) -> usize {
    (width.div_ceil(LANES) | 1) * LANES
}

/// One row of one step: x and u [3H] are the projections of input and state.
#[inline(always)]
fn gate(x: &[f32], u: &[f32], old: &[f32], state: &mut [f32], keep: &mut [f32]) {
    let n = old.len() / LANES;
    let ([x_r, x_z, x_n], [u_r, u_z, u_n], [old]) = (parts(x, n), parts(u, n), parts(old, n));
    let ([state], [k_r, k_z, k_n, k_c]) = (parts_mut(state, n), parts_mut(keep, n));
    let of = f32x16::new;
    for v in 0..n {
        let reset = sigmoid(of(x_r[v]) + of(u_r[v]));
        let update = sigmoid(of(x_z[v]) + of(u_z[v]));
        let candidate = of(u_n[v]);
        let new = tanh(reset.mul_add(candidate, of(x_n[v])));
        state[v] = update.mul_add(of(old[v]) - new, new).to_array();
        (k_r[v], k_z[v], k_n[v], k_c[v]) = (reset.to_array(), update.to_array(), new.to_array(), candidate.to_array());
    }
}

/// The way back. `dh` holds the gradient that comes from the next step, and then what goes straight to the step before.
#[inline(always)]
fn gate_gradients(keep: &[f32], old: &[f32], dy: &[f32], dh: &mut [f32], dx: &mut [f32], du: &mut [f32]) {
    let (n, one, of) = (old.len() / LANES, f32x16::ONE, f32x16::new);
    let ([k_r, k_z, k_n, k_c], [old], [dy]) = (parts(keep, n), parts(old, n), parts(dy, n));
    let ([dh], [dx_r, dx_z, dx_n], [du_r, du_z, du_n]) = (parts_mut(dh, n), parts_mut(dx, n), parts_mut(du, n));
    for v in 0..n {
        let (reset, update, new, candidate) = (of(k_r[v]), of(k_z[v]), of(k_n[v]), of(k_c[v]));
        let d = of(dh[v]) + of(dy[v]);
        let d_new = d * (one - update) * (one - new * new);
        let d_update = (d * (of(old[v]) - new) * update * (one - update)).to_array();
        let d_reset = (d_new * candidate * reset * (one - reset)).to_array();
        (dx_r[v], dx_z[v], dx_n[v]) = (d_reset, d_update, d_new.to_array());
        (du_r[v], du_z[v], du_n[v]) = (d_reset, d_update, (d_new * reset).to_array());
        dh[v] = (d * update).to_array();
    }
}
