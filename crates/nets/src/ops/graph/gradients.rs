//! The way back through a graph block.

use super::{Op, Saved, TILE, blocks, vectors};
use crate::ops::gradient::Gradient;
use crate::ops::matmul::{Activation, PANEL, Packed, Rows, Start, layer};
use crate::ops::simd::{self, LANES, WIDE, load, sigmoid, store, sum, transpose};
use wide::f32x16;

impl Op {
    /// Gradients of features, relative and score.
    pub(super) fn gradients(
        &self,
        saved: &Saved,
        [features, relative, score]: [&[f32]; 3],
        y: &[f32],
        dy: &[f32],
    ) -> [Vec<f32>; 3] {
        let (n, columns, width, p) = (self.block.agents, self.columns(), self.block.width, self.block.pair_hidden);
        let states = features.len() / (n * columns);
        let mut scratch = self.scratch();
        let padded = scratch.padded;
        // Grown state by state: a vector of zeros would be written twice.
        let mut all_d_features = Vec::with_capacity(features.len());
        let (mut d_features, mut d_relative) = (vec![0.0; n * columns], vec![0.0; relative.len()]);
        let (mut d_logits, mut z) = (vec![0.0; TILE * padded], Packed::zeros(width, n, PANEL));
        // Rows of a tile: gradients of their messages in whole vectors, and their edges.
        let stride = width.next_multiple_of(LANES);
        let (mut all_g, mut edges, mut d_z) =
            (vec![0.0; TILE * stride], vec![0.0; TILE * padded], vec![0.0; n * width]);
        let mut sums = PairSums::new(p, padded);
        let (mut d_score, mut all) = (vec![0.0f32; p + 1], vec![0.0; p]);
        let (mut scaled, mut d_receiver) = (vec![0.0; p * padded], vec![0.0; padded * p]);
        for s in 0..states {
            let features = &features[s * n * columns..(s + 1) * n * columns];
            let d_relative = &mut d_relative[s * n * p..(s + 1) * n * p];
            self.load_pairs(features, &relative[s * n * p..(s + 1) * n * p], &mut scratch);
            z.fill_transposed(Rows::new(features, columns).skip(2 * p));
            sums.receiver.fill(f32x16::ZERO);
            let mut through_edges = Gradient::new(n, width);
            for first in (0..n).step_by(TILE) {
                let rows = TILE.min(n - first);
                for (at, i) in (first..first + rows).enumerate() {
                    let row = s * n + i;
                    let logits = &saved.logits[row * padded..(row + 1) * padded];
                    let message = &saved.messages[row * width..(row + 1) * width];
                    let degree = self.edges(i, logits, &mut edges[at * padded..][..padded]);
                    let of_row = row * width..(row + 1) * width;
                    let own =
                        &mut d_features[i * columns + 2 * p + width..][..if self.block.self_path { width } else { 0 }];
                    let g = &mut all_g[at * stride..][..width];
                    let through_mean = message_gradient((&y[of_row.clone()], &dy[of_row], message), degree, g, own);
                    d_logits[at * padded..][..padded].fill(-through_mean);
                }
                // z_j has a part in the messages of all agents with an edge to it.
                through_edges.add(Rows::new(&edges, padded), Rows::new(&all_g, stride), rows);
                // d a_ij = g_i · (z_j − mean message).
                let g = Rows::new(&all_g, stride);
                layer(g, &z, Start::Output, Activation::Identity, &mut d_logits, padded, rows);
                let logits = saved.logits[(s * n + first) * padded..].chunks_exact(padded);
                for ((i, logits), d) in (first..).zip(logits).zip(d_logits.chunks_exact_mut(padded)).take(rows) {
                    self.through_softmax(i, logits, d, &mut sums.score[p]);
                }
                let mut i = first;
                while i < first + rows {
                    let d_logits = &d_logits[(i - first) * padded..];
                    let sender = &scratch.sender[i * p..];
                    let count = match first + rows - i {
                        4.. if WIDE && padded == LANES => sums.rows::<4>(sender, &scratch.receiver, d_logits, padded),
                        2.. if WIDE => sums.rows::<2>(sender, &scratch.receiver, d_logits, padded),
                        _ => sums.rows::<1>(sender, &scratch.receiver, d_logits, padded),
                    };
                    for sender in sums.sender.chunks_exact(p).take(count) {
                        simd::sums(sender, &mut all);
                        let sender = &scratch.sender[i * p..(i + 1) * p];
                        let (d_u, d_q) = (&mut d_features[i * columns..][..p], &mut d_relative[i * p..][..p]);
                        for k in 0..p {
                            d_score[k] = sender[k].mul_add(all[k], d_score[k]);
                            d_u[k] = score[k] * all[k];
                            d_q[k] = -d_u[k];
                        }
                        i += 1;
                    }
                }
            }
            for (k, (d, receiver)) in
                sums.receiver.chunks_exact(padded / LANES).zip(scratch.receiver.chunks_exact(padded)).enumerate()
            {
                for (v, d) in d.iter().enumerate() {
                    let at = v * LANES;
                    sums.score[k] = load(&receiver[at..]).mul_add(*d, sums.score[k]);
                    store(*d * f32x16::splat(score[k]), &mut scaled[k * padded + at..]);
                }
            }
            transpose(Rows::new(&scaled, padded), p, padded, &mut d_receiver, p);
            through_edges.write(&mut d_z, None);
            for (j, d) in d_z.chunks_exact(width).enumerate() {
                d_features[j * columns + 2 * p..][..width].copy_from_slice(d);
            }
            for (j, d) in d_receiver.chunks_exact(p).take(n).enumerate() {
                d_features[j * columns + p..][..p].copy_from_slice(d);
                d_relative[j * p..][..p].iter_mut().zip(d).for_each(|(to, d)| *to += d);
            }
            all_d_features.extend_from_slice(&d_features);
        }
        d_score.iter_mut().zip(sums.score).for_each(|(d, receivers)| *d += sum(receivers));
        [all_d_features, d_relative, d_score]
    }

    /// d · σ'((logit + noise) / τ) of the edges of agent i, and their sum into `b2`.
    #[inline(always)]
    fn through_softmax(&self, i: usize, logits: &[f32], d: &mut [f32], b2: &mut f32x16) {
        let inverse_temperature = f32x16::splat(1.0 / self.block.temperature);
        for ((logits, d), others) in logits.as_chunks().0.iter().zip(d.as_chunks_mut().0).zip(self.others(i)) {
            let soft = sigmoid(f32x16::new(*logits) * inverse_temperature);
            let slope = soft * (f32x16::ONE - soft) * inverse_temperature;
            let through = (f32x16::new(*d) * slope) & others;
            *b2 += through;
            *d = through.to_array();
        }
    }
}

/// Through relu(self_i + mean message): the gradient of one message in `g`, that of the agent's own features in `own` (which may be
/// empty), and Σ g · mean message, which the number of edges takes away from each of them.
#[inline(always)]
fn message_gradient((y, dy, message): (&[f32], &[f32], &[f32]), degree: usize, g: &mut [f32], own: &mut [f32]) -> f32 {
    let inverse = f32x16::splat(1.0 / degree.max(1) as f32);
    let mut through_mean = f32x16::ZERO;
    let mut part = |y: f32x16, dy: f32x16, message: f32x16| {
        let d = y.simd_gt(f32x16::ZERO) & dy;
        through_mean = (d * inverse).mul_add(message, through_mean);
        (d, d * inverse)
    };
    let ((y, y_rest), (dy, dy_rest), (message, message_rest)) = (y.as_chunks(), dy.as_chunks(), message.as_chunks());
    let ((g, g_rest), (own, own_rest)) = (g.as_chunks_mut(), own.as_chunks_mut());
    let mut own = own.iter_mut();
    for (((y, dy), message), g) in y.iter().zip(dy).zip(message).zip(g) {
        let (d, scaled) = part(f32x16::new(*y), f32x16::new(*dy), f32x16::new(*message));
        *g = scaled.to_array();
        if let Some(own) = own.next() {
            *own = d.to_array();
        }
    }
    if !y_rest.is_empty() {
        let (d, scaled) = part(load(y_rest), load(dy_rest), load(message_rest));
        store(scaled, g_rest);
        store(d, own_rest);
    }
    if degree == 0 { 0.0 } else { sum(through_mean) }
}

/// Gradients of the pair network w2 · relu(u_i + v_j) + b2. Those of u and v lack the factor w2, which is the same for a whole sum.
struct PairSums {
    /// [4, P] of u_i, over all j: the current rows'.
    sender: Vec<f32x16>,
    /// [P, padded / 16] of v_j, over all i.
    receiver: Vec<f32x16>,
    /// [P + 1] of w2 and b2. Where u_i + v_j > 0, an edge adds d · (u_i + v_j) to that of w2, so the sum over all edges is
    /// Σ u · du + Σ v · dv, and only the second part of it stands here.
    score: Vec<f32x16>,
}

impl PairSums {
    fn new(p: usize, padded: usize) -> Self {
        let zeros = |count: usize| vec![f32x16::ZERO; count];
        Self { sender: zeros(4 * p), receiver: zeros(p * padded / LANES), score: zeros(p + 1) }
    }

    /// Takes in the edges of some agents.
    #[inline(always)]
    fn rows<const A: usize>(&mut self, sender: &[f32], receiver: &[f32], d_logits: &[f32], padded: usize) -> usize {
        self.sender.fill(f32x16::ZERO);
        for (v, four) in blocks(padded) {
            match four {
                true => self.part::<A, 4>(sender, receiver, d_logits, v, padded),
                false => self.part::<A, 1>(sender, receiver, d_logits, v, padded),
            }
        }
        A
    }

    #[inline(always)]
    fn part<const A: usize, const Q: usize>(
        &mut self,
        sender: &[f32],
        receiver: &[f32],
        d_logits: &[f32],
        v: usize,
        padded: usize,
    ) {
        let d: [[f32x16; Q]; A] = std::array::from_fn(|a| vectors(&d_logits[a * padded + v..]));
        let p = self.score.len() - 1;
        let receivers = receiver.chunks_exact(padded).zip(self.receiver.chunks_exact_mut(padded / LANES));
        let senders: [&[f32]; A] = std::array::from_fn(|a| &sender[a * p..][..p]);
        for (k, (receiver, d_receiver)) in receivers.enumerate().take(p) {
            let receiver: [f32x16; Q] = vectors(&receiver[v..]);
            let d_receiver = &mut d_receiver[v / LANES..][..Q];
            let u: [f32x16; A] = std::array::from_fn(|a| f32x16::splat(senders[a][k]));
            let mut d_u: [f32x16; A] = std::array::from_fn(|a| self.sender[a * p + k]);
            for q in 0..Q {
                for a in 0..A {
                    let through = d[a][q] & (u[a] + receiver[q]).simd_gt(f32x16::ZERO);
                    d_u[a] += through;
                    d_receiver[q] += through;
                }
            }
            for a in 0..A {
                self.sender[a * p + k] = d_u[a];
            }
        }
    }
}
