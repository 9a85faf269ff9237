//! The way back through a graph block.

use super::{Op, Saved};
use crate::ops::simd::{LANES, load, sigmoid, store, sum};
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
        let (mut z, mut d_z) = (vec![0.0; width * padded], vec![0.0; n * width]);
        let (mut g, mut d_logits) = (vec![0.0; width], vec![0.0; padded]);
        let mut sums = PairSums::new(p, padded);
        for s in 0..states {
            let features = &features[s * n * columns..(s + 1) * n * columns];
            let d_features = &mut all_d_features[s * n * columns..(s + 1) * n * columns];
            self.load_pairs(features, &relative[s * n * p..(s + 1) * n * p], &mut scratch);
            for j in 0..n {
                for k in 0..width {
                    z[k * padded + j] = features[j * columns + 2 * p + k];
                }
            }
            sums.receiver.fill(f32x16::ZERO);
            d_z.fill(0.0);
            for i in 0..n {
                let row = s * n + i;
                let logits = &saved.logits[row * padded..(row + 1) * padded];
                let message = &saved.messages[row * width..(row + 1) * width];
                let degree = self.edges(i, logits, |_| {});
                let inverse = 1.0 / degree.max(1) as f32;
                let at = row * width;
                let mut through_mean = 0.0;
                for k in 0..width {
                    let d = if y[at + k] > 0.0 { dy[at + k] } else { 0.0 };
                    if self.block.self_path {
                        d_features[i * columns + 2 * p + width + k] = d;
                    }
                    g[k] = d * inverse;
                    through_mean += g[k] * message[k];
                }
                self.edges(i, logits, |j| {
                    for (d, g) in d_z[j * width..(j + 1) * width].iter_mut().zip(&g) {
                        *d += g;
                    }
                });
                if degree == 0 {
                    through_mean = 0.0;
                }
                self.edge_gradients(logits, &z, &g, through_mean, &mut d_logits);
                // Neither an agent itself nor what fills up the last vector is a neighbour.
                d_logits[i] = 0.0;
                d_logits[n..].fill(0.0);
                sums.row(&scratch.sender[i * p..(i + 1) * p], &scratch.receiver, &d_logits);
                for k in 0..p {
                    let d = score[k] * sum(sums.sender[k]);
                    d_features[i * columns + k] = d;
                    d_relative[row * p + k] = -d;
                }
            }
            for k in 0..p {
                for v in (0..padded).step_by(LANES) {
                    for (lane, d) in sums.receiver[(k * padded + v) / LANES].to_array().into_iter().enumerate() {
                        let j = v + lane;
                        if j < n {
                            let d = score[k] * d;
                            d_features[j * columns + p + k] = d;
                            d_relative[(s * n + j) * p + k] += d;
                        }
                    }
                }
            }
            for j in 0..n {
                d_features[j * columns + 2 * p..j * columns + 2 * p + width]
                    .copy_from_slice(&d_z[j * width..(j + 1) * width]);
            }
        }
        [all_d_features, d_relative, sums.score.into_iter().map(sum).collect()]
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

/// Gradients of the pair network w2 · relu(u_i + v_j) + b2. Those of u and v lack the factor w2, which is the same for a whole sum.
struct PairSums {
    /// `[P]` of u_i, over all j: the current row's.
    sender: Vec<f32x16>,
    /// [P, padded / 16] of v_j, over all i.
    receiver: Vec<f32x16>,
    /// [P + 1] of w2 and b2.
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
        for (((u, d_u), d_s), (receiver, d_receiver)) in
            sender.iter().zip(&mut self.sender).zip(&mut self.score).zip(receivers)
        {
            let (u, receiver, first) = (f32x16::splat(*u), &receiver[v..v + Q * LANES], v / LANES);
            let d_receiver = &mut d_receiver[first..first + Q];
            for q in 0..Q {
                let hidden = u + load(&receiver[q * LANES..]);
                let through = d[q] & hidden.simd_gt(f32x16::ZERO);
                *d_s = through.mul_add(hidden, *d_s);
                *d_u += through;
                d_receiver[q] += through;
            }
        }
    }
}
