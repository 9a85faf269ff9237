use super::operation::{Arg, Operation, apply1, apply3};
use super::simd::{LANES, WIDE, load, store};
use candle_core::{Result, Shape, Tensor, bail};
use wide::f32x16;

/// For every agent the mean of the *other* agents' rows: [S·N, F] → [S·N, F], N rows per joint state. This is the fully
/// connected GCN of the paper (eq. 6) with degree normalisation and without the self term, which the caller keeps apart.
pub fn mean_of_others(x: &Tensor, agents: usize) -> Result<Tensor> {
    apply1(MeanOfOthers { agents }, x)
}

struct MeanOfOthers {
    agents: usize,
}

impl MeanOfOthers {
    /// The map is symmetric, so its gradient is itself.
    fn run(&self, x: &[f32], width: usize) -> Vec<f32> {
        let mut y = vec![0.0; x.len()];
        let scale = 1.0 / (self.agents.max(2) - 1) as f32;
        let mut total = vec![0.0; width];
        for (x, y) in x.chunks_exact(self.agents * width).zip(y.chunks_exact_mut(self.agents * width)) {
            total.fill(0.0);
            for row in x.chunks_exact(width) {
                for (t, v) in total.iter_mut().zip(row) {
                    *t += v;
                }
            }
            for (row, out) in x.chunks_exact(width).zip(y.chunks_exact_mut(width)) {
                for i in 0..width {
                    out[i] = (total[i] - row[i]) * scale;
                }
            }
        }
        y
    }
}

impl Operation<1> for MeanOfOthers {
    const NAME: &'static str = "mean-of-others";

    fn forward(&self, [x]: [Arg<'_>; 1]) -> Result<(Vec<f32>, Shape)> {
        let (rows, width) = x.rows();
        if self.agents == 0 || rows % self.agents != 0 {
            bail!("mean of others: {rows} rows are not a multiple of {} agents", self.agents);
        }
        Ok((self.run(x.values, width), Shape::from(x.dims)))
    }

    fn backward(&self, [x]: [Arg<'_>; 1], _y: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 1]> {
        Ok([Some(self.run(dy, x.rows().1))])
    }
}

/// Sum over an agent's nearest neighbours of relu(f · w + b): y [R, h] from constant neighbour features f [R, k, c] of
/// which the first `counts[r]` rows are real. One fused operation: the [R·k, h] intermediate is never stored.
pub fn neighbour_pool(features: &Tensor, counts: Vec<u8>, w: &Tensor, b: &Tensor) -> Result<Tensor> {
    apply3(NeighbourPool { counts }, [features, w, b])
}

struct NeighbourPool {
    counts: Vec<u8>,
}

impl Operation<3> for NeighbourPool {
    const NAME: &'static str = "neighbour-pool";

    fn forward(&self, [features, w, b]: [Arg<'_>; 3]) -> Result<(Vec<f32>, Shape)> {
        let [rows, neighbours, channels] = *features.dims else {
            bail!("neighbour pool: features {:?} are not [R, k, c]", features.dims)
        };
        let width = w.rows().1;
        if w.dims != [channels, width] || b.dims != [width] || self.counts.len() != rows {
            bail!(
                "neighbour pool: weights {:?}, {} counts and features {:?} do not fit",
                w.dims,
                self.counts.len(),
                features.dims
            );
        }
        let mut y = vec![0.0; rows * width];
        let weights = PoolWeights::new(w.values, b.values, neighbours * channels);
        weights.forward(features.values, &self.counts, &mut y, width);
        Ok((y, Shape::from((rows, width))))
    }

    fn backward(&self, [features, w, b]: [Arg<'_>; 3], _y: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 3]> {
        let ((channels, width), stride) = (w.rows(), features.rows().1 * features.dims[1]);
        let weights = PoolWeights::new(w.values, b.values, stride);
        let mut gradient = PoolGradient::new(&weights);
        weights.backward(features.values, &self.counts, dy, width, &mut gradient);
        let (mut dw, mut db) = (vec![0.0; channels * width], vec![0.0; width]);
        gradient.write(&mut dw, &mut db);
        Ok([None, Some(dw), Some(db)])
    }
}

/// Weights of a pool, cut into columns of two vectors.
pub(crate) struct PoolWeights {
    /// [h / 32, c + 1] two vectors each; the bias comes last.
    panels: Vec<Vec<Pair>>,
    channels: usize,
    width: usize,
    /// k · c: numbers of one agent.
    stride: usize,
}

type Pair = [f32x16; 2];

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
        for (index, panel) in self.panels.iter().enumerate() {
            for ((f, &count), y) in features.chunks_exact(self.stride).zip(counts).zip(y.chunks_mut(stride)) {
                let mut total = [f32x16::ZERO; 2];
                self.neighbours(f, count, |f, group| {
                    group.hidden(f, panel, self.channels, |z| {
                        for v in 0..2 {
                            total[v] += z[v].fast_max(f32x16::ZERO);
                        }
                    });
                });
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
                self.neighbours(f, count, |f, group| {
                    let (mut dz, mut at) = ([[f32x16::ZERO; 2]; 4], 0);
                    group.hidden(f, panel, self.channels, |z| {
                        dz[at] = [z[0].simd_gt(f32x16::ZERO) & dy[0], z[1].simd_gt(f32x16::ZERO) & dy[1]];
                        at += 1;
                    });
                    group.gradient(f, self.channels, &dz, sums);
                });
            }
        }
    }

    /// Calls `f` for the real neighbours of an agent in their order, in groups of four (where there are registers for them), two and
    /// one.
    #[inline(always)]
    fn neighbours(&self, features: &[f32], count: u8, mut f: impl FnMut(&[f32], Group)) {
        let (mut left, mut features) = (usize::from(count), features);
        let first = if WIDE { (4, Group::Four) } else { (2, Group::Two) };
        for (size, group) in [first, (2, Group::Two), (1, Group::One)] {
            while left >= size {
                f(&features[..size * self.channels], group);
                features = &features[size * self.channels..];
                left -= size;
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

/// How many neighbours are in registers at once.
#[derive(Clone, Copy)]
enum Group {
    Four,
    Two,
    One,
}

impl Group {
    /// Calls `f` with f · w + b of each neighbour in turn.
    #[inline(always)]
    fn hidden(self, features: &[f32], panel: &[Pair], channels: usize, f: impl FnMut(Pair)) {
        match self {
            Self::Four => hidden4(features, panel, channels, f),
            Self::Two => hidden2(features, panel, channels, f),
            Self::One => hidden1(features, panel, channels, f),
        }
    }

    /// Adds the neighbours' features times their dz to the sums.
    #[inline(always)]
    fn gradient(self, features: &[f32], channels: usize, dz: &[Pair; 4], sums: &mut [Pair]) {
        match self {
            Self::Four => gradient4(features, channels, dz, sums),
            Self::Two => gradient2(features, channels, dz, sums),
            Self::One => gradient1(features, channels, dz, sums),
        }
    }
}

macro_rules! group {
    ($hidden:ident, $gradient:ident, $size:literal, $($r:literal)*) => {
        #[inline(always)]
        fn $hidden(features: &[f32], panel: &[Pair], channels: usize, mut f: impl FnMut(Pair)) {
            let rows: [&[f32]; $size] = [$(&features[$r * channels..][..channels]),*];
            let mut z = [panel[channels]; $size];
            for (c, w) in panel[..channels].iter().enumerate() {
                $(
                    let a = f32x16::splat(rows[$r][c]);
                    z[$r] = [a.mul_add(w[0], z[$r][0]), a.mul_add(w[1], z[$r][1])];
                )*
            }
            $(f(z[$r]);)*
        }

        #[inline(always)]
        fn $gradient(features: &[f32], channels: usize, dz: &[Pair; 4], sums: &mut [Pair]) {
            let rows: [&[f32]; $size] = [$(&features[$r * channels..][..channels]),*];
            let (sums, rest) = sums.split_at_mut(channels);
            for (c, sum) in sums.iter_mut().enumerate() {
                $(
                    let a = f32x16::splat(rows[$r][c]);
                    *sum = [a.mul_add(dz[$r][0], sum[0]), a.mul_add(dz[$r][1], sum[1])];
                )*
            }
            if let Some(bias) = rest.first_mut() {
                $(*bias = [bias[0] + dz[$r][0], bias[1] + dz[$r][1]];)*
            }
        }
    };
}

group!(hidden1, gradient1, 1, 0);
group!(hidden2, gradient2, 2, 0 1);
group!(hidden4, gradient4, 4, 0 1 2 3);
