use super::operation::{Arg, Operation, apply1, apply3};
use super::simd::{LANES, load, store};
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
        let (w, b) = (w.values, b.values);
        let mut y = vec![0.0; self.counts.len() * width];
        for start in (0..width).step_by(LANES) {
            let end = (start + LANES).min(width);
            let columns: Vec<f32x16> = w.chunks_exact(width).map(|row| load(&row[start..end])).collect();
            let bias = load(&b[start..end]);
            let stride = neighbours * channels;
            for ((f, &count), y) in
                features.values.chunks_exact(stride).zip(self.counts.iter()).zip(y.chunks_exact_mut(width))
            {
                let mut total = f32x16::ZERO;
                for f in f.chunks_exact(channels).take(count.into()) {
                    let mut z = bias;
                    for (f, column) in f.iter().zip(&columns) {
                        z = f32x16::splat(*f).mul_add(*column, z);
                    }
                    total += z.fast_max(f32x16::ZERO);
                }
                store(total, &mut y[start..end]);
            }
        }
        Ok((y, Shape::from((rows, width))))
    }

    fn backward(&self, [features, w, b]: [Arg<'_>; 3], _y: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 3]> {
        let ((channels, width), stride) = (w.rows(), features.rows().1 * features.dims[1]);
        let (w, b) = (w.values, b.values);
        let (mut dw, mut db) = (vec![0.0; channels * width], vec![0.0; width]);
        for start in (0..width).step_by(LANES) {
            let end = (start + LANES).min(width);
            let columns: Vec<f32x16> = w.chunks_exact(width).map(|row| load(&row[start..end])).collect();
            let bias = load(&b[start..end]);
            let (mut gw, mut gb) = (vec![f32x16::ZERO; channels], f32x16::ZERO);
            for ((f, &count), dy) in
                features.values.chunks_exact(stride).zip(self.counts.iter()).zip(dy.chunks_exact(width))
            {
                let dy = load(&dy[start..end]);
                for f in f.chunks_exact(channels).take(count.into()) {
                    let mut z = bias;
                    for (f, column) in f.iter().zip(&columns) {
                        z = f32x16::splat(*f).mul_add(*column, z);
                    }
                    let dz = z.simd_gt(f32x16::ZERO) & dy;
                    gb += dz;
                    for (f, g) in f.iter().zip(&mut gw) {
                        *g = f32x16::splat(*f).mul_add(dz, *g);
                    }
                }
            }
            for (g, row) in gw.iter().zip(dw.chunks_exact_mut(width)) {
                store(*g, &mut row[start..end]);
            }
            store(gb, &mut db[start..end]);
        }
        Ok([None, Some(dw), Some(db)])
    }
}
