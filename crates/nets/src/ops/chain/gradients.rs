//! From the last layer to the first.

use super::{Branch, Dense, Field, Layer, Layout, Op, Pack, TILE};
use crate::features::Features;
use crate::ops::buffer::Buffer;
use crate::ops::gradient::Gradient;
use crate::ops::matmul::{Activation, Rows, backward};
use crate::ops::norm::NormGradient;
use crate::ops::operation::Arg;
use crate::ops::pool::{PoolGradient, PoolWeights};
use crate::ops::simd::{LANES, load, store};
use candle_core::{Result, bail};
use std::ops::Range;
use wide::f32x16;

impl Op {
    /// The gradient of the parameters; writes that of the input to `d_input`.
    pub(in crate::ops) fn gradients(
        &self,
        (input, p): (Option<Arg<'_>>, &[f32]),
        y: &[f32],
        dy: &[f32],
        d_input: &mut [f32],
    ) -> Result<Vec<f32>> {
        let (rows, widths, layout) = (self.rows(input)?, self.layout.widths(), &self.layout);
        let Some(saved) = self.saved.get() else { bail!("chain: gradient without forward") };
        let transposed = self.transposed(p);
        let mut sums =
            Sums::new(layout, self.packs(p), |states, width| self.sharing(rows, states(&self.features), width))?;
        // Padded so that whole vectors can be read from any branch's first column on.
        let stride = widths.iter().max().map_or(0, |width| width.next_multiple_of(LANES) + LANES);
        let (mut d, mut below) = (Buffer::take(TILE * stride), Buffer::take(TILE * stride));
        d.fill(0.0);
        below.fill(0.0);
        for from in (0..rows).step_by(TILE) {
            let to = rows.min(from + TILE);
            let count = to - from;
            let entering = |l: usize| match input {
                Some(input) if l == 0 && layout.input_only() => &input.values[from * widths[0]..to * widths[0]],
                _ => &saved[l][from * widths[l]..to * widths[l]],
            };
            let last = widths.len() - 1;
            let n = widths[last];
            let act = layout.layers.last().map_or(Activation::Identity, Layer::act);
            slopes(act, &y[from * n..to * n], &dy[from * n..to * n], n, &mut d, stride);
            for l in (0..layout.layers.len()).rev() {
                let (x, k) = (entering(l), widths[l]);
                // The activation of the layer below, whose slope belongs to what it gave.
                let act = if l == 0 { Activation::Identity } else { layout.layers[l - 1].act() };
                match (&layout.layers[l], &mut sums.layers[l]) {
                    (Layer::Dense(_), LayerSums::Dense(gradient)) => {
                        gradient.add(Rows::new(x, k), Rows::new(&d, stride), count);
                        let Some(w) = &transposed[l] else { bail!("chain: weights and layers do not fit") };
                        backward(Rows::new(&d, stride), w, (act, Rows::new(x, k)), &mut below, stride, count);
                    }
                    (Layer::Norm(_, at), LayerSums::Norm(gradient)) => {
                        gradient.add(x, &p[*at..at + k], Rows::new(&d, stride), &mut below, stride);
                        if act != Activation::Identity {
                            for (x, d) in x.chunks_exact(k).zip(below.chunks_exact_mut(stride)) {
                                slope_in_place(act, x, d);
                            }
                        }
                    }
                    _ => bail!("chain: sums and layers do not fit"),
                }
                std::mem::swap(&mut d, &mut below);
            }
            let first = saved.first().map_or(y, |first| first);
            self.branch_gradients(from..to, first, &mut d, stride, &mut sums, d_input);
        }
        sums.write(layout, p.len(), &self.features)
    }

    /// Takes in the gradient of the first rows of a tile.
    fn branch_gradients(
        &self,
        tile: Range<usize>,
        first: &[f32],
        d: &mut [f32],
        stride: usize,
        sums: &mut Sums,
        d_input: &mut [f32],
    ) {
        let (rows, all) = (tile.len(), self.layout.first());
        let mut column = 0;
        for (branch, sums) in self.layout.branches.iter().zip(&mut sums.branches) {
            let width = branch.width();
            match (branch, sums) {
                (Branch::Features(dense, field, _), BranchSums::Features(gradient, team)) => {
                    if dense.act != Activation::Identity {
                        for (row, d) in tile.clone().zip(d.chunks_exact_mut(stride)) {
                            let at = row * all + column;
                            slope_in_place(dense.act, &first[at..at + width], &mut d[column..]);
                        }
                    }
                    let d = Rows::new(d, stride).skip(column);
                    let k = dense.k;
                    gradient.add(Rows::new(&field(&self.features)[tile.start * k..tile.end * k], k), d, rows);
                    if let Some(team) = team {
                        team.add(tile.clone(), d, width);
                    }
                }
                (Branch::Neighbours(dense, count), BranchSums::Neighbours(weights, gradient)) => {
                    let per_row = count * dense.k;
                    let neighbours = &self.features.neighbours[tile.start * per_row..tile.end * per_row];
                    let counts = &self.features.counts[tile.clone()];
                    weights.backward(neighbours, counts, &d[column..], stride, gradient);
                }
                (Branch::Input(_), _) => {
                    let out = d_input[tile.start * width..tile.end * width].chunks_exact_mut(width);
                    out.zip(d.chunks(stride)).for_each(|(out, d)| out.copy_from_slice(&d[column..column + width]));
                }
                _ => {}
            }
            column += width;
        }
    }
}

/// d [rows, stride] = dy [rows, n] · f'(z).
pub(in crate::ops) fn slopes(act: Activation, y: &[f32], dy: &[f32], n: usize, d: &mut [f32], stride: usize) {
    for ((y, dy), d) in y.chunks_exact(n).zip(dy.chunks_exact(n)).zip(d.chunks_exact_mut(stride)) {
        d[..n].copy_from_slice(dy);
        if act != Activation::Identity {
            slope_in_place(act, y, d);
        }
    }
}

/// d · f'(z) of one row.
#[inline(always)]
fn slope_in_place(act: Activation, y: &[f32], d: &mut [f32]) {
    let ((y, y_rest), (d, d_rest)) = (y.as_chunks::<LANES>(), d[..y.len()].as_chunks_mut::<LANES>());
    for (y, d) in y.iter().zip(d) {
        *d = act.slope(f32x16::new(*y), f32x16::new(*d)).to_array();
    }
    store(act.slope(load(y_rest), load(d_rest)), d_rest);
}

/// Gradients of all parameters while rows pass.
struct Sums<'a> {
    branches: Vec<BranchSums<'a>>,
    layers: Vec<LayerSums>,
}

enum BranchSums<'a> {
    Features(Gradient, Option<TeamSums>),
    Neighbours(&'a PoolWeights, PoolGradient),
    Input,
}

enum LayerSums {
    Dense(Gradient),
    Norm(NormGradient),
}

/// [R / N, n]: dz summed over the rows that share a state of the team.
struct TeamSums {
    dz: Vec<f32>,
    stride: usize,
    sharing: usize,
}

impl TeamSums {
    fn add(&mut self, tile: Range<usize>, d: Rows<'_>, width: usize) {
        for (row, d) in tile.zip(d.values.chunks(d.stride)) {
            let at = row / self.sharing * self.stride;
            if self.dz.len() < at + self.stride {
                self.dz.resize(at + self.stride, 0.0);
            }
            self.dz[at..at + width].iter_mut().zip(d).for_each(|(sum, d)| *sum += d);
        }
    }
}

impl<'a> Sums<'a> {
    /// `sharing` tells how many rows share one of these states.
    fn new(layout: &Layout, packs: &'a [Pack], sharing: impl Fn(Field, usize) -> Result<usize>) -> Result<Self> {
        let branch = |(branch, pack): (&Branch, &'a Pack)| {
            Ok(match (branch, pack) {
                (Branch::Features(d, _, shared), _) => {
                    let team = |(width, _, field): (usize, usize, Field)| -> Result<TeamSums> {
                        let stride = d.n.next_multiple_of(LANES);
                        Ok(TeamSums { dz: Vec::new(), stride, sharing: sharing(field, width)? })
                    };
                    BranchSums::Features(Gradient::new(d.k, d.n), shared.map(team).transpose()?)
                }
                (Branch::Neighbours(..), Pack::Pool(weights)) => {
                    BranchSums::Neighbours(weights, PoolGradient::new(weights))
                }
                _ => BranchSums::Input,
            })
        };
        let layer = |layer: &Layer| match layer {
            Layer::Dense(d) => LayerSums::Dense(Gradient::new(d.k, d.n)),
            Layer::Norm(n, _) => LayerSums::Norm(NormGradient::new(*n)),
        };
        Ok(Self {
            branches: layout.branches.iter().zip(packs).map(branch).collect::<Result<_>>()?,
            layers: layout.layers.iter().map(layer).collect(),
        })
    }

    /// All in their places.
    fn write(&self, layout: &Layout, count: usize, features: &Features) -> Result<Vec<f32>> {
        let mut out = vec![0.0; count];
        // Weights and their bias may be apart: they are written one after the other.
        let dense = |d: &Dense, gradient: &Gradient, out: &mut [f32]| {
            let mut bias = vec![0.0; d.n];
            gradient.write(&mut out[d.weights()], Some(&mut bias));
            out[d.bias()].copy_from_slice(&bias);
        };
        for (branch, sums) in layout.branches.iter().zip(&self.branches) {
            match (branch, sums) {
                (Branch::Features(d, _, shared), BranchSums::Features(gradient, team)) => {
                    dense(d, gradient, &mut out);
                    if let (Some((width, at, field)), Some(team)) = (shared, team) {
                        let mut gradient = Gradient::new(*width, d.n);
                        let rows = team.dz.len() / team.stride;
                        gradient.add(Rows::new(field(features), *width), Rows::new(&team.dz, team.stride), rows);
                        gradient.write(&mut out[*at..at + width * d.n], None);
                    }
                }
                (Branch::Neighbours(d, _), BranchSums::Neighbours(_, gradient)) => {
                    let mut bias = vec![0.0; d.n];
                    gradient.write(&mut out[d.weights()], &mut bias);
                    out[d.bias()].copy_from_slice(&bias);
                }
                _ => {}
            }
        }
        for (layer, sums) in layout.layers.iter().zip(&self.layers) {
            match (layer, sums) {
                (Layer::Dense(d), LayerSums::Dense(gradient)) => dense(d, gradient, &mut out),
                (Layer::Norm(n, at), LayerSums::Norm(gradient)) => {
                    let (scale, shift) = out[*at..at + 2 * n].split_at_mut(*n);
                    gradient.write(scale, shift);
                }
                _ => bail!("chain: sums and layers do not fit"),
            }
        }
        Ok(out)
    }
}
