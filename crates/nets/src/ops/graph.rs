mod gradients;

use super::buffer::Buffer;
use super::matmul::{Activation, PANEL, Packed, Rows, Start, layer};
use super::operation::{Arg, Operation, apply3};
use super::simd::{LANES, ln_of_normal, sum, transpose};
use candle_core::{Result, Shape, Tensor, bail};
use std::sync::{Arc, OnceLock};
use wide::f32x16;

/// Where the Gumbel noise of a graph block comes from.
#[derive(Debug, Clone)]
pub enum GraphNoise {
    /// No noise: an edge is there if its logit is positive (evaluation, critic).
    Off,
    /// One key per joint state: the noise of a pair is a pure function of (key, block, i, j), so that the update replays
    /// exactly the graph of the rollout and the first importance ratio is exactly 1.
    Keyed(Arc<Vec<u64>>),
}

/// One block of the Graph Encoder (paper, eq. 7 and 8), all pairs of a joint state in one operation.
#[derive(Debug, Clone)]
pub struct GraphBlock {
    /// N: agents of a joint state.
    pub agents: usize,
    /// P: hidden units of the pair network f_g.
    pub pair_hidden: usize,
    /// F: features of a message.
    pub width: usize,
    /// Index of the block: the same key gives other noise in another block.
    pub block: u32,
    /// Whether the block's own features stay in the sum (they should; the literal reading of the paper drops them).
    pub self_path: bool,
    /// τ of the straight-through gradient.
    pub temperature: f32,
}

/// y [S·N, F] = relu(self_i + Σ_j a_ij z_j / max(1, Σ_j a_ij)), with hard edges
/// a_ij = 1[w2 · relu(u_i + v_j) + b2 + noise_ij > 0], j ≠ i, and the straight-through gradient of the two-channel
/// Gumbel softmax (the difference of two Gumbels is logistic).
///
/// `features` [S·N, 2P + 2F] holds u, v, z and self side by side; `relative` [S·N, P] is subtracted from u and added to v,
/// which makes the pair network see positions relative to each other only; `score` [P + 1] is w2 and b2.
pub fn graph_block(
    features: &Tensor,
    relative: &Tensor,
    score: &Tensor,
    block: GraphBlock,
    noise: GraphNoise,
) -> Result<Tensor> {
    let keep = [features, relative, score].into_iter().any(Tensor::track_op);
    apply3(Op { block, noise, keep, saved: OnceLock::new() }, [features, relative, score])
}

/// Agents whose edges are in the cache at once.
const TILE: usize = 48;

struct Op {
    block: GraphBlock,
    noise: GraphNoise,
    /// Whether there will be a gradient.
    keep: bool,
    saved: OnceLock<Saved>,
}

/// What the gradient needs of the way there.
struct Saved {
    /// [S·N, padded] logits plus noise.
    logits: Buffer,
    /// [S·N, F] mean messages.
    messages: Buffer,
}

/// Working memory of one joint state. `padded` is N rounded up to whole vectors.
struct Scratch {
    padded: usize,
    /// [N, P] u_i − q_i.
    sender: Vec<f32>,
    /// [P, padded] v_j + q_j, transposed so that one vector holds sixteen neighbours.
    receiver: Vec<f32>,
    /// [N, P] the same before it is transposed.
    rows: Vec<f32>,
}

impl Op {
    fn scratch(&self) -> Scratch {
        let padded = self.block.agents.div_ceil(LANES) * LANES;
        let p = self.block.pair_hidden;
        let zeros = |count: usize| vec![0.0; count];
        let own = self.block.agents * p;
        Scratch { padded, sender: zeros(own), receiver: zeros(p * padded), rows: zeros(own) }
    }

    fn columns(&self) -> usize {
        2 * self.block.pair_hidden + 2 * self.block.width
    }

    fn load_pairs(&self, features: &[f32], relative: &[f32], scratch: &mut Scratch) {
        let (n, p, columns) = (self.block.agents, self.block.pair_hidden, self.columns());
        let Scratch { padded, sender, receiver, rows } = scratch;
        for i in 0..n {
            let (row, q, to) = (&features[i * columns..], &relative[i * p..(i + 1) * p], i * p..(i + 1) * p);
            for ((to, u), q) in sender[to.clone()].iter_mut().zip(&row[..p]).zip(q) {
                *to = u - q;
            }
            for ((to, v), q) in rows[to].iter_mut().zip(&row[p..2 * p]).zip(q) {
                *to = v + q;
            }
        }
        transpose(Rows::new(rows, p), n, p, receiver, *padded);
    }

    /// Logits [A, padded] of A agents from i on towards all others, sixteen neighbours at a time. Several vectors at once
    /// hide the latency of the multiply-adds; each lane's sum has the same order either way.
    #[inline(always)]
    fn row_logits<const A: usize>(&self, i: usize, score: &[f32], scratch: &Scratch, mut logits: [&mut [f32]; A]) {
        for (v, four) in blocks(scratch.padded) {
            match four {
                true => self.logits_of::<A, 4>(i, v, score, scratch, &mut logits),
                false => self.logits_of::<A, 1>(i, v, score, scratch, &mut logits),
            }
        }
    }

    #[inline(always)]
    fn logits_of<const A: usize, const Q: usize>(
        &self,
        i: usize,
        v: usize,
        score: &[f32],
        scratch: &Scratch,
        logits: &mut [&mut [f32]; A],
    ) {
        let (p, padded) = (self.block.pair_hidden, scratch.padded);
        let senders: [&[f32]; A] = std::array::from_fn(|a| &scratch.sender[(i + a) * p..][..p]);
        let mut acc = [[f32x16::splat(score[p]); Q]; A];
        for (k, (receiver, w)) in scratch.receiver.chunks_exact(padded).zip(&score[..p]).enumerate() {
            let w = f32x16::splat(*w);
            let receiver = vectors::<Q>(&receiver[v..]);
            for (acc, sender) in acc.iter_mut().zip(senders) {
                let u = f32x16::splat(sender[k]);
                for (acc, receiver) in acc.iter_mut().zip(receiver) {
                    *acc = w.mul_add((u + receiver).fast_max(f32x16::ZERO), *acc);
                }
            }
        }
        for (acc, logits) in acc.into_iter().zip(logits) {
            for (acc, logits) in acc.into_iter().zip(logits[v..].as_chunks_mut().0) {
                *logits = acc.to_array();
            }
        }
    }

    /// Adds noise to the logits of agent i.
    #[inline(always)]
    fn add_noise(&self, state: usize, i: usize, logits: &mut [f32]) {
        if let GraphNoise::Keyed(keys) = &self.noise {
            let (key, first) = (keys[state], (self.block.block << 27).wrapping_add((i * self.block.agents) as u32));
            for (v, logits) in (0..).zip(logits.as_chunks_mut().0) {
                let noise = logistic(key, first.wrapping_add(LANES as u32 * v));
                *logits = (f32x16::new(*logits) + noise).to_array();
            }
        }
    }

    /// Edges of agent i as ones and zeros [padded]. Returns the degree.
    #[inline(always)]
    fn edges(&self, i: usize, logits: &[f32], edges: &mut [f32]) -> usize {
        let mut degree = f32x16::ZERO;
        for ((logits, edges), others) in logits.as_chunks().0.iter().zip(edges.as_chunks_mut().0).zip(self.others(i)) {
            let there = f32x16::new(*logits).simd_gt(f32x16::ZERO) & others & f32x16::ONE;
            degree += there;
            *edges = there.to_array();
        }
        sum(degree) as usize
    }

    /// Masks of the agents other than agent i: neither it nor what fills up the last vector is a neighbour.
    #[inline(always)]
    fn others(&self, i: usize) -> impl Iterator<Item = f32x16> {
        // Not one number written behind the vectors: to read it back with its neighbours takes longer than the whole row.
        let (i, n) = (f32x16::splat(i as f32), f32x16::splat(self.block.agents as f32));
        let lanes = f32x16::new(std::array::from_fn(|lane| lane as f32));
        (0..).step_by(LANES).map(move |v: usize| {
            let at = lanes + f32x16::splat(v as f32);
            at.simd_ne(i) & at.simd_lt(n)
        })
    }

    fn aggregate(&self, features: &[f32], relative: &[f32], score: &[f32]) -> Vec<f32> {
        let (n, columns, width, p) = (self.block.agents, self.columns(), self.block.width, self.block.pair_hidden);
        let states = features.len() / (n * columns);
        // Grown row by row: a vector of zeros would be written twice.
        let mut y = Vec::with_capacity(states * n * width);
        let (mut scratch, mut z) = (self.scratch(), Packed::zeros(n, width, PANEL));
        let padded = scratch.padded;
        let kept = if self.keep { states * n } else { TILE };
        let (mut logits, mut messages) = (Buffer::take(kept * padded), Buffer::take(kept * width));
        let (mut edges, mut degrees) = (Buffer::take(TILE * padded), [0; TILE]);
        for s in 0..states {
            let features = &features[s * n * columns..(s + 1) * n * columns];
            self.load_pairs(features, &relative[s * n * p..(s + 1) * n * p], &mut scratch);
            // The sum over the neighbours is a product of ones and zeros with z: the same sums in the same order as one by one.
            z.fill(Rows::new(features, columns).skip(2 * p));
            for first in (0..n).step_by(TILE) {
                let rows = TILE.min(n - first);
                let at = if self.keep { s * n + first } else { 0 };
                let logits = &mut logits[at * padded..(at + rows) * padded];
                for (i, logits) in (first..).step_by(2).zip(logits.chunks_mut(2 * padded)) {
                    match logits.split_at_mut(padded) {
                        (one, []) => self.row_logits(i, score, &scratch, [one]),
                        (one, two) => self.row_logits(i, score, &scratch, [one, two]),
                    }
                }
                let pairs = logits.chunks_exact_mut(padded).zip(edges.chunks_exact_mut(padded));
                for ((i, (logits, edges)), degree) in (first..).zip(pairs).zip(&mut degrees) {
                    self.add_noise(s, i, logits);
                    *degree = self.edges(i, logits, edges);
                }
                let messages = &mut messages[at * width..(at + rows) * width];
                layer(Rows::new(&edges, padded), &z, Start::Zero, Activation::Identity, messages, width, rows);
                for ((i, message), degree) in (first..).zip(messages.chunks_exact_mut(width)).zip(degrees) {
                    let inverse = 1.0 / degree.max(1) as f32;
                    let own = &features[i * columns + 2 * p + width..(i + 1) * columns];
                    message.iter_mut().for_each(|message| *message *= inverse);
                    y.extend(message.iter().zip(own).map(|(message, own)| {
                        let own = if self.block.self_path { *own } else { 0.0 };
                        (own + message).max(0.0)
                    }));
                }
            }
        }
        if self.keep {
            // Each call of `graph_block` makes its own operation: the cell is empty.
            let _ = self.saved.set(Saved { logits, messages });
        }
        y
    }
}

/// Where the blocks of a row of whole vectors begin, and whether they are of four vectors or of one.
#[inline(always)]
fn blocks(padded: usize) -> impl Iterator<Item = (usize, bool)> {
    let fours = padded / (4 * LANES);
    (0..fours).map(|b| (4 * LANES * b, true)).chain((4 * LANES * fours..padded).step_by(LANES).map(|v| (v, false)))
}

/// The first Q vectors.
#[inline(always)]
fn vectors<const Q: usize>(from: &[f32]) -> [f32x16; Q] {
    from.as_chunks().0.first_chunk().map_or([f32x16::ZERO; Q], |all: &[_; Q]| all.map(f32x16::new))
}

/// Sixteen logistic numbers for counters `counter..counter + 16`.
#[inline(always)]
fn logistic(key: u64, counter: u32) -> f32x16 {
    let mut uniform = [0.0f32; LANES];
    for (lane, slot) in uniform.iter_mut().enumerate() {
        // 23 bits and a half: never 0 and never 1.
        let bits = magex_core::rng::mix(key, counter.wrapping_add(lane as u32)) >> 9;
        *slot = (bits as f32 + 0.5) * (1.0 / 8_388_608.0);
    }
    let u = f32x16::new(uniform);
    ln_of_normal(u / (f32x16::ONE - u))
}

impl Operation<3> for Op {
    const NAME: &'static str = "graph-block";

    fn forward(&self, [features, relative, score]: [Arg<'_>; 3]) -> Result<(Vec<f32>, Shape)> {
        let ((rows, columns), n, p) = (features.rows(), self.block.agents, self.block.pair_hidden);
        if n == 0 || rows % n != 0 || columns != self.columns() {
            bail!("graph block: features [{rows}, {columns}] do not fit {n} agents, {p} pair units");
        }
        if relative.dims != [rows, p] || score.dims != [p + 1] {
            bail!("graph block: relative {:?} or score {:?} do not fit", relative.dims, score.dims);
        }
        if let GraphNoise::Keyed(keys) = &self.noise
            && keys.len() != rows / n
        {
            bail!("graph block: {} noise keys for {} joint states", keys.len(), rows / n);
        }
        let y = self.aggregate(features.values, relative.values, score.values);
        Ok((y, Shape::from((rows, self.block.width))))
    }

    fn backward(&self, args: [Arg<'_>; 3], y: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 3]> {
        let Some(saved) = self.saved.get() else { bail!("graph block: gradient without forward") };
        Ok(self.gradients(saved, args.map(|arg| arg.values), y, dy).map(Some))
    }
}
