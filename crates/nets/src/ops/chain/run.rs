//! From the first layer to the last.

use super::{Branch, Layer, Op, Pack, TILE};
use crate::ops::buffer::Buffer;
use crate::ops::matmul::{Activation, Rows, Start, layer};
use crate::ops::norm::normalise;
use crate::ops::operation::Arg;
use candle_core::{Result, Shape, bail};
use std::ops::Range;

impl Op {
    pub(super) fn run(&self, input: Option<Arg<'_>>, p: &[f32]) -> Result<(Vec<f32>, Shape)> {
        let (rows, widths, packs) = (self.rows(input)?, self.layout.widths(), self.packs(p));
        let [inner @ .., last] = &widths[..] else { bail!("chain: nothing in it") };
        // Rows that enter each layer: all of them for a gradient, otherwise a tile's.
        let kept = if self.keep { rows } else { TILE.min(rows) };
        let own = |(at, width): (usize, &usize)| match at == 0 && self.layout.input_only() {
            true => Buffer::default(),
            false => Buffer::take(kept * width),
        };
        let mut saved: Vec<Buffer> = inner.iter().enumerate().map(own).collect();
        // Grown tile by tile: a vector of zeros would be written twice.
        let mut y = Vec::with_capacity(rows * last);
        let mut result = Buffer::take(TILE.min(rows) * last);
        let teams = self.teams(rows, packs, p)?;
        for from in (0..rows).step_by(TILE) {
            let to = rows.min(from + TILE);
            let tile = if self.keep { from..to } else { 0..to - from };
            let first = match saved.first_mut() {
                None => Some(&mut result[..(to - from) * last]),
                Some(_) if self.layout.input_only() => None,
                Some(first) => Some(&mut first[tile.start * widths[0]..tile.end * widths[0]]),
            };
            if let Some(first) = first {
                self.branches(from..to, input, packs, p, &teams, first, widths[0]);
            }
            let packs = &packs[self.layout.branches.len()..];
            for (l, (step, pack)) in self.layout.layers.iter().zip(packs).enumerate() {
                let (before, after) = saved.split_at_mut(l + 1);
                let (k, n) = (widths[l], widths[l + 1]);
                let x = match (l, input) {
                    (0, Some(input)) if self.layout.input_only() => &input.values[from * k..to * k],
                    _ => &before[l][tile.start * k..tile.end * k],
                };
                let out = match after.first_mut() {
                    Some(next) => &mut next[tile.start * n..tile.end * n],
                    None => &mut result[..(to - from) * n],
                };
                match (step, pack) {
                    (Layer::Dense(d), Pack::Dense(w)) => {
                        layer(Rows::new(x, k), w, Start::Bias(&p[d.bias()]), d.act, out, n, to - from);
                    }
                    (Layer::Norm(_, at), _) => normalise(x, &p[*at..at + n], &p[at + n..at + 2 * n], out),
                    _ => bail!("chain: weights and layers do not fit"),
                }
            }
            y.extend_from_slice(&result[..(to - from) * last]);
        }
        if self.keep {
            // Each call of `forward` makes its own operation: the cell is empty.
            let _ = self.saved.set(saved);
        }
        Ok((y, Shape::from((rows, *last))))
    }

    /// b + state · w' of every joint state, for each branch that has it, and the rows that share it.
    fn teams(&self, rows: usize, packs: &[Pack], p: &[f32]) -> Result<Vec<(Buffer, usize)>> {
        let mut out = Vec::new();
        for (branch, pack) in self.layout.branches.iter().zip(packs) {
            let mut own = (Buffer::default(), 1);
            if let (Branch::Features(d, _, Some((width, _, field))), Pack::Two(_, w)) = (branch, pack) {
                let states = field(&self.features);
                let sharing = self.sharing(rows, states, *width)?;
                let mut team = Buffer::take(rows / sharing * d.n);
                let bias = Start::Bias(&p[d.bias()]);
                layer(Rows::new(states, *width), w, bias, Activation::Identity, &mut team, d.n, rows / sharing);
                own = (team, sharing);
            }
            out.push(own);
        }
        Ok(out)
    }

    /// The first rows of a tile.
    #[allow(clippy::too_many_arguments)] // its operands are its meaning
    fn branches(
        &self,
        tile: Range<usize>,
        input: Option<Arg<'_>>,
        packs: &[Pack],
        p: &[f32],
        teams: &[(Buffer, usize)],
        out: &mut [f32],
        stride: usize,
    ) {
        let rows = tile.len();
        let mut column = 0;
        for ((branch, pack), (team, sharing)) in self.layout.branches.iter().zip(packs).zip(teams) {
            let out = &mut out[column..];
            match (branch, pack) {
                (Branch::Features(d, field, _), Pack::Dense(w)) => {
                    let x = Rows::new(&field(&self.features)[tile.start * d.k..tile.end * d.k], d.k);
                    layer(x, w, Start::Bias(&p[d.bias()]), d.act, out, stride, rows);
                }
                (Branch::Features(d, field, _), Pack::Two(w, _)) => {
                    for (row, out) in tile.clone().zip(out.chunks_mut(stride)) {
                        let at = row / sharing * d.n;
                        out[..d.n].copy_from_slice(&team[at..at + d.n]);
                    }
                    let x = Rows::new(&field(&self.features)[tile.start * d.k..tile.end * d.k], d.k);
                    layer(x, w, Start::Output, d.act, out, stride, rows);
                }
                (Branch::Neighbours(d, count), Pack::Pool(w)) => {
                    let width = count * d.k;
                    let neighbours = &self.features.neighbours[tile.start * width..tile.end * width];
                    w.forward(neighbours, &self.features.counts[tile.clone()], out, stride);
                }
                (Branch::Input(width), _) => {
                    let input = input.map_or(&[][..], |input| input.values);
                    let rows = input[tile.start * width..tile.end * width].chunks_exact(*width);
                    rows.zip(out.chunks_mut(stride)).for_each(|(x, out)| out[..*width].copy_from_slice(x));
                }
                _ => {}
            }
            column += branch.width();
        }
    }
}
