//! The way back through a graph block.

use super::{Op, Saved, TILE};
use crate::ops::gradient::Gradient;
use crate::ops::matmul::Rows;
use crate::ops::simd::{self, LANES, load, sigmoid, store, sum, transpose};
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
        let (mut all_d_features, mut d_relative) = (vec![0.0; features.len()], vec![0.0; relative.len()]);
        let (mut z, mut d_logits) = (vec![0.0; width * padded], vec![0.0; padded]);
        // Rows of a tile: gradients of their messages in whole vectors, and their edges.
        let stride = width.next_multiple_of(LANES);
        let (mut all_g, mut edges, mut d_z) =
            (vec![0.0; TILE * stride], vec![0.0; TILE * padded], vec![0.0; n * width]);
        let mut sums = PairSums::new(p, padded);
        let (mut d_score, mut all) = (vec![0.0f32; p + 1], vec![0.0; p]);
        let (mut scaled, mut d_receiver) = (vec![0.0; p * padded], vec![0.0; padded * p]);
        for s in 0..states {
            let features = &features[s * n * columns..(s + 1) * n * columns];
            let d_features = &mut all_d_features[s * n * columns..(s + 1) * n * columns];
            let d_relative = &mut d_relative[s * n * p..(s + 1) * n * p];
            self.load_pairs(features, &relative[s * n * p..(s + 1) * n * p], &mut scratch);
            transpose(Rows::new(features, columns).skip(2 * p), n, width, &mut z, padded);
            sums.receiver.fill(f32x16::ZERO);
            let mut through_edges = Gradient::new(n, width);
            for i in 0..n {
                let row = s * n + i;
                let logits = &saved.logits[row * padded..(row + 1) * padded];
                let message = &saved.messages[row * width..(row + 1) * width];
                let degree = self.edges(i, logits, &mut edges[i % TILE * padded..][..padded]);
                let at = row * width..(row + 1) * width;
                let own =
                    &mut d_features[i * columns + 2 * p + width..][..if self.block.self_path { width } else { 0 }];
                let g = &mut all_g[i % TILE * stride..][..width];
                let through_mean = message_gradient((&y[at.clone()], &dy[at], message), degree, g, own);
                self.edge_gradients(logits, &z, g, through_mean, &mut d_logits);
                // Neither an agent itself nor what fills up the last vector is a neighbour.
                d_logits[i] = 0.0;
                d_logits[n..].fill(0.0);
                let sender = &scratch.sender[i * p..(i + 1) * p];
                sums.row(sender, &scratch.receiver, &d_logits);
                simd::sums(&sums.sender, &mut all);
                let (d_u, d_q) = (&mut d_features[i * columns..][..p], &mut d_relative[i * p..][..p]);
                for k in 0..p {
                    d_score[k] = sender[k].mul_add(all[k], d_score[k]);
                    d_u[k] = score[k] * all[k];
                    d_q[k] = -d_u[k];
                }
                if (i + 1) % TILE == 0 || i + 1 == n {
                    // z_j has a part in the messages of all agents with an edge to it.
                    through_edges.add(Rows::new(&edges, padded), Rows::new(&all_g, stride), i % TILE + 1);
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
                add(d, &mut d_relative[j * p..][..p]);
            }
        }
        d_score.iter_mut().zip(sums.score).for_each(|(d, receivers)| *d += sum(receivers));
        [all_d_features, d_relative, d_score]
    }

    /// d a_ij = g_i · (z_j − mean message), then through σ'((logit + noise) / τ), for the edges of one agent.
    #[inline(always)]
    fn edge_gradients(&self, logits: &[f32], z: &[f32], g: &[f32], through_mean: f32, d_logits: &mut [f32]) {
        let padded = logits.len();
        let mut v = 0;
        while v < padded {
            if v + 4 * LANES <= padded {
                self.edge_gradients_of::<4>(v, logits, z, g, through_mean, d_logits);
                v += 4 * LANES;
            } else {
                self.edge_gradients_of::<1>(v, logits, z, g, through_mean, d_logits);
                v += LANES;
            }
        }
    }

    #[inline(always)]
    fn edge_gradients_of<const Q: usize>(
        &self,
        v: usize,
        logits: &[f32],
        z: &[f32],
        g: &[f32],
        through_mean: f32,
        d_logits: &mut [f32],
    ) {
        let padded = logits.len();
        let inverse_temperature = f32x16::splat(1.0 / self.block.temperature);
        let mut d_logit = [f32x16::splat(-through_mean); Q];
        for (g, z) in g.iter().zip(z.chunks_exact(padded)) {
            let (g, z) = (f32x16::splat(*g), &z[v..v + Q * LANES]);
            for (q, d) in d_logit.iter_mut().enumerate() {
                *d = g.mul_add(load(&z[q * LANES..]), *d);
            }
        }
        for (q, d) in d_logit.into_iter().enumerate() {
            let at = v + q * LANES;
            let soft = sigmoid(load(&logits[at..]) * inverse_temperature);
            let slope = soft * (f32x16::ONE - soft) * inverse_temperature;
            store(d * slope, &mut d_logits[at..]);
        }
    }
}

/// Through relu(self_i + mean message): the gradient of one message in `g`, that of the agent's own features in `own` (which may be
/// empty), and Σ g · mean message, which the number of edges takes away from each of them.
#[inline(always)]
fn message_gradient((y, dy, message): (&[f32], &[f32], &[f32]), degree: usize, g: &mut [f32], own: &mut [f32]) -> f32 {
    let inverse = f32x16::splat(1.0 / degree.max(1) as f32);
    let mut through_mean = f32x16::ZERO;
    for at in (0..g.len()).step_by(LANES) {
        let d = load(&y[at..]).simd_gt(f32x16::ZERO) & load(&dy[at..]);
        if let Some(own) = own.get_mut(at..) {
            store(d, own);
        }
        let d = d * inverse;
        through_mean = d.mul_add(load(&message[at..]), through_mean);
        store(d, &mut g[at..]);
    }
    if degree == 0 { 0.0 } else { sum(through_mean) }
}

/// to += d.
#[inline(always)]
fn add(d: &[f32], to: &mut [f32]) {
    for (d, to) in d.chunks(LANES).zip(to.chunks_mut(LANES)) {
        store(load(to) + load(d), to);
    }
}

/// Gradients of the pair network w2 · relu(u_i + v_j) + b2. Those of u and v lack the factor w2, which is the same for a whole sum.
struct PairSums {
    /// `[P]` of u_i, over all j: the current row's.
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
        Self { sender: zeros(p), receiver: zeros(p * padded / LANES), score: zeros(p + 1) }
    }

    /// Takes in the edges of one agent.
    #[inline(always)]
    fn row(&mut self, sender: &[f32], receiver: &[f32], d_logits: &[f32]) {
        let padded = d_logits.len();
        self.sender.fill(f32x16::ZERO);
        let mut v = 0;
        while v < padded {
            if v + 4 * LANES <= padded {
                self.part::<4>(sender, receiver, &d_logits[v..], v, padded);
                v += 4 * LANES;
            } else {
                self.part::<1>(sender, receiver, &d_logits[v..], v, padded);
                v += LANES;
            }
        }
    }

    #[inline(always)]
    fn part<const Q: usize>(&mut self, sender: &[f32], receiver: &[f32], d_logits: &[f32], v: usize, padded: usize) {
        let d: [f32x16; Q] = std::array::from_fn(|q| load(&d_logits[q * LANES..]));
        let p = sender.len();
        for d in d {
            self.score[p] += d;
        }
        let receivers = receiver.chunks_exact(padded).zip(self.receiver.chunks_exact_mut(padded / LANES));
        for ((u, d_u), (receiver, d_receiver)) in sender.iter().zip(&mut self.sender).zip(receivers) {
            let (u, receiver, first) = (f32x16::splat(*u), &receiver[v..v + Q * LANES], v / LANES);
            let d_receiver = &mut d_receiver[first..first + Q];
            for q in 0..Q {
                let hidden = u + load(&receiver[q * LANES..]);
                let through = d[q] & hidden.simd_gt(f32x16::ZERO);
                *d_u += through;
                d_receiver[q] += through;
            }
        }
    }
}
