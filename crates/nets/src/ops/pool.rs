use super::operation::{Arg, Operation, apply1};
use super::simd::{LANES, WIDE, load, store};
use candle_core::{Result, Shape, Tensor, bail};
use wide::f32x16;

/// Every agent's row beside the mean of the *other* agents' rows: [S·N, F] → [S·N, 2F], N rows per joint state. The second half is
/// the fully connected GCN of the paper (eq. 6) with degree normalisation and without the self term, which is the first half.
pub fn with_mean_of_others(x: &Tensor, agents: usize) -> Result<Tensor> {
    apply1(WithMeanOfOthers { agents }, x)
}

struct WithMeanOfOthers {
    agents: usize,
}

/// Σ of the rows, in their order.
fn sum_rows<'a>(rows: impl Iterator<Item = &'a [f32]>, total: &mut [f32]) {
    total.fill(0.0);
    rows.for_each(|row| total.iter_mut().zip(row).for_each(|(t, v)| *t += v));
}

impl Operation<1> for WithMeanOfOthers {
    const NAME: &'static str = "with-mean-of-others";

    fn forward(&self, [x]: [Arg<'_>; 1]) -> Result<(Vec<f32>, Shape)> {
        let ((rows, width), scale) = (x.rows(), 1.0 / (self.agents.max(2) - 1) as f32);
        if self.agents == 0 || rows % self.agents != 0 {
            bail!("mean of others: {rows} rows are not a multiple of {} agents", self.agents);
        }
        let (mut y, mut total) = (Vec::with_capacity(2 * x.values.len()), vec![0.0; width]);
        for state in x.values.chunks_exact(self.agents * width) {
            sum_rows(state.chunks_exact(width), &mut total);
            for row in state.chunks_exact(width) {
                y.extend_from_slice(row);
                y.extend(total.iter().zip(row).map(|(t, v)| (t - v) * scale));
            }
        }
        Ok((y, Shape::from((rows, 2 * width))))
    }

    fn backward(&self, [x]: [Arg<'_>; 1], _y: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 1]> {
        let (width, scale) = (x.rows().1, 1.0 / (self.agents.max(2) - 1) as f32);
        let (mut dx, mut total) = (Vec::with_capacity(x.values.len()), vec![0.0; width]);
        for state in dy.chunks_exact(2 * self.agents * width) {
            sum_rows(state.chunks_exact(2 * width).map(|row| &row[width..]), &mut total);
            for (own, others) in state.chunks_exact(2 * width).map(|row| row.split_at(width)) {
                dx.extend(own.iter().zip(others).zip(&total).map(|((own, d), t)| own + (t - d) * scale));
            }
        }
        Ok([Some(dx)])
    }
}

/// Weights of a pool, cut into columns of two vectors: the sum over an agent's nearest neighbours of relu(f · w + b), for constant
/// features f [R, k, c] of which the first `counts[r]` rows are real. What every neighbour adds is never stored.
pub(crate) struct PoolWeights {
    /// [h / 32, c + 1] two vectors each; the bias comes last.
    panels: Vec<Vec<Pair>>,
    channels: usize,
    width: usize,
    /// k · c: numbers of one agent.
    stride: usize,
}

type Pair = [f32x16; 2];

/// Runs `$do` for the real neighbours of an agent in their order, R at once: four (where there are registers for them), two and one.
macro_rules! in_groups {
    ($features:expr, $count:expr, $channels:expr, |$f:ident, $R:ident| $do:expr) => {{
        let (mut left, mut rest): (usize, &[f32]) = (usize::from($count), $features);
        in_groups!(if WIDE { 4 } else { 2 }, left, rest, $channels, |$f, $R| $do);
        in_groups!(2, left, rest, $channels, |$f, $R| $do);
        in_groups!(1, left, rest, $channels, |$f, $R| $do);
    }};
    ($size:expr, $left:ident, $rest:ident, $channels:expr, |$f:ident, $R:ident| $do:expr) => {{
        const $R: usize = $size;
        while $left >= $R {
            let $f = &$rest[..$R * $channels];
            $do;
            ($left, $rest) = ($left - $R, &$rest[$R * $channels..]);
        }
    }};
}

fn pair(row: &[f32], start: usize) -> Pair {
    let at = |start: usize| load(&row[start.min(row.len())..]);
    [at(start), at(start + LANES)]
}

fn put(pair: Pair, row: &mut [f32], start: usize) {
    let end = row.len();
    for (v, value) in pair.into_iter().enumerate() {
        let from = (start + v * LANES).min(end);
        store(value, &mut row[from..end.min(from + LANES)]);
    }
}

impl PoolWeights {
    /// Of w [c, h] and b `[h]`; `stride` numbers stand for one agent.
    pub(crate) fn new(w: &[f32], b: &[f32], stride: usize) -> Self {
        let width = b.len();
        let panel = |start| w.chunks_exact(width).chain([b]).map(|row| pair(row, start)).collect();
        let panels = (0..width).step_by(2 * LANES).map(panel).collect();
        Self { panels, channels: w.len() / width.max(1), width, stride }
    }

    /// Writes the pools of all agents into rows of y that are `stride` apart.
    pub(crate) fn forward(&self, features: &[f32], counts: &[u8], y: &mut [f32], stride: usize) {
        let add = |total: &mut Pair, z: &[Pair]| {
            for z in z {
                *total = [total[0] + z[0].fast_max(f32x16::ZERO), total[1] + z[1].fast_max(f32x16::ZERO)];
            }
        };
        for (index, panel) in self.panels.iter().enumerate() {
            for ((f, &count), y) in features.chunks_exact(self.stride).zip(counts).zip(y.chunks_mut(stride)) {
                let mut total = [f32x16::ZERO; 2];
                in_groups!(f, count, self.channels, |f, R| add(&mut total, &hidden::<R>(f, panel)));
                put(total, &mut y[..self.width], index * 2 * LANES);
            }
        }
    }

    /// Adds to the gradient of the weights, given that of the pools in rows that are `stride` apart.
    pub(crate) fn backward(
        &self,
        features: &[f32],
        counts: &[u8],
        dy: &[f32],
        stride: usize,
        gradient: &mut PoolGradient,
    ) {
        for ((index, panel), sums) in self.panels.iter().enumerate().zip(&mut gradient.panels) {
            for ((f, &count), dy) in features.chunks_exact(self.stride).zip(counts).zip(dy.chunks(stride)) {
                let dy = pair(&dy[..self.width], index * 2 * LANES);
                in_groups!(f, count, self.channels, |f, R| learn::<R>(f, panel, dy, sums));
            }
        }
    }
}

/// Sums of the gradient of [`PoolWeights`].
pub(crate) struct PoolGradient {
    panels: Vec<Vec<Pair>>,
    width: usize,
}

impl PoolGradient {
    pub(crate) fn new(weights: &PoolWeights) -> Self {
        let zeros = |panel: &Vec<Pair>| vec![[f32x16::ZERO; 2]; panel.len()];
        Self { panels: weights.panels.iter().map(zeros).collect(), width: weights.width }
    }

    /// Writes dw [c, h] and db `[h]`.
    pub(crate) fn write(&self, dw: &mut [f32], db: &mut [f32]) {
        for (index, panel) in self.panels.iter().enumerate() {
            let rows = dw.chunks_exact_mut(self.width).chain([db as &mut [f32]]);
            rows.zip(panel).for_each(|(row, sum)| put(*sum, row, index * 2 * LANES));
        }
    }
}

/// f · w + b of R neighbours.
#[inline(always)]
fn hidden<const R: usize>(features: &[f32], panel: &[Pair]) -> [Pair; R] {
    let channels = panel.len() - 1;
    let rows: [&[f32]; R] = std::array::from_fn(|r| &features[r * channels..][..channels]);
    let mut z = [panel[channels]; R];
    for (c, w) in panel[..channels].iter().enumerate() {
        for (z, row) in z.iter_mut().zip(rows) {
            let a = f32x16::splat(row[c]);
            *z = [a.mul_add(w[0], z[0]), a.mul_add(w[1], z[1])];
        }
    }
    z
}

/// Adds the features of R neighbours times their dz to the sums.
#[inline(always)]
fn learn<const R: usize>(features: &[f32], panel: &[Pair], dy: Pair, sums: &mut [Pair]) {
    let channels = panel.len() - 1;
    let dz =
        hidden::<R>(features, panel).map(|z| [z[0].simd_gt(f32x16::ZERO) & dy[0], z[1].simd_gt(f32x16::ZERO) & dy[1]]);
    let rows: [&[f32]; R] = std::array::from_fn(|r| &features[r * channels..][..channels]);
    for (c, sum) in sums[..channels].iter_mut().enumerate() {
        for (dz, row) in dz.iter().zip(rows) {
            let a = f32x16::splat(row[c]);
            *sum = [a.mul_add(dz[0], sum[0]), a.mul_add(dz[1], sum[1])];
        }
    }
    let bias = &mut sums[channels];
    dz.iter().for_each(|dz| *bias = [bias[0] + dz[0], bias[1] + dz[1]]);
}
