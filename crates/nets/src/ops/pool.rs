use super::simd::{LANES, load, store};
use super::{slice, with_values};
use candle_core::{CpuStorage, CustomOp1, CustomOp2, Layout, Result, Shape, Tensor, bail};
use wide::f32x16;

/// For every agent the mean of the *other* agents' rows: [S·N, F] → [S·N, F], N rows per joint state. This is the fully
/// connected GCN of the paper (eq. 6) with degree normalisation and without the self term, which the caller keeps apart.
pub fn mean_of_others(x: &Tensor, agents: usize) -> Result<Tensor> {
    x.contiguous()?.apply_op1(MeanOfOthers { agents })
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

impl CustomOp1 for MeanOfOthers {
    fn name(&self) -> &'static str {
        "mean-of-others"
    }

    fn cpu_fwd(&self, x: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let (rows, width) = layout.shape().dims2()?;
        if self.agents == 0 || rows % self.agents != 0 {
            bail!("mean of others: {rows} rows are not a multiple of {} agents", self.agents);
        }
        Ok((CpuStorage::F32(self.run(slice(x, layout)?, width)), layout.shape().clone()))
    }

    fn bwd(&self, x: &Tensor, _y: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
        let (_, width) = x.dims2()?;
        let dx = with_values(&dy.contiguous()?, |dy| self.run(dy, width))?;
        Ok(Some(Tensor::from_vec(dx, x.shape(), x.device())?))
    }
}

/// Sum over an agent's nearest neighbours of relu(f · w + b): y [R, h] from constant neighbour features f [R, k, c] of
/// which the first `counts[r]` rows are real. One fused operation: the [R·k, h] intermediate is never stored.
pub fn neighbour_pool(features: &Tensor, counts: std::sync::Arc<Vec<u8>>, w: &Tensor, b: &Tensor) -> Result<Tensor> {
    let (rows, neighbours, channels) = features.dims3()?;
    if counts.len() != rows {
        bail!("neighbour pool: {} counts for {rows} rows", counts.len());
    }
    let features = with_values(&features.contiguous()?, |f| f.to_vec())?;
    w.apply_op2(b, NeighbourPool { features, counts, neighbours, channels })
}

struct NeighbourPool {
    features: Vec<f32>,
    counts: std::sync::Arc<Vec<u8>>,
    neighbours: usize,
    channels: usize,
}

impl CustomOp2 for NeighbourPool {
    fn name(&self) -> &'static str {
        "neighbour-pool"
    }

    fn cpu_fwd(&self, w: &CpuStorage, lw: &Layout, b: &CpuStorage, lb: &Layout) -> Result<(CpuStorage, Shape)> {
        let (channels, width) = lw.shape().dims2()?;
        if channels != self.channels || lb.shape().dims() != [width] {
            bail!("neighbour pool: weights [{channels}, {width}] do not fit {} channels", self.channels);
        }
        let (w, b) = (slice(w, lw)?, slice(b, lb)?);
        let mut y = vec![0.0; self.counts.len() * width];
        for start in (0..width).step_by(LANES) {
            let end = (start + LANES).min(width);
            let columns: Vec<f32x16> = w.chunks_exact(width).map(|row| load(&row[start..end])).collect();
            let bias = load(&b[start..end]);
            let stride = self.neighbours * channels;
            for ((f, &count), y) in
                self.features.chunks_exact(stride).zip(self.counts.iter()).zip(y.chunks_exact_mut(width))
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
        Ok((CpuStorage::F32(y), Shape::from((self.counts.len(), width))))
    }

    fn bwd(&self, w: &Tensor, b: &Tensor, _y: &Tensor, dy: &Tensor) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let (channels, width) = w.dims2()?;
        let dy = dy.contiguous()?;
        let (dw, db) = with_values(w, |w| with_values(b, |b| with_values(&dy, |dy| self.gradient(w, b, dy, width))))???;
        Ok((Some(Tensor::from_vec(dw, (channels, width), w.device())?), Some(Tensor::from_vec(db, width, w.device())?)))
    }
}

impl NeighbourPool {
    fn gradient(&self, w: &[f32], b: &[f32], dy: &[f32], width: usize) -> (Vec<f32>, Vec<f32>) {
        let channels = self.channels;
        let (mut dw, mut db) = (vec![0.0; channels * width], vec![0.0; width]);
        for start in (0..width).step_by(LANES) {
            let end = (start + LANES).min(width);
            let columns: Vec<f32x16> = w.chunks_exact(width).map(|row| load(&row[start..end])).collect();
            let bias = load(&b[start..end]);
            let (mut gw, mut gb) = (vec![f32x16::ZERO; channels], f32x16::ZERO);
            let stride = self.neighbours * channels;
            for ((f, &count), dy) in
                self.features.chunks_exact(stride).zip(self.counts.iter()).zip(dy.chunks_exact(width))
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
        (dw, db)
    }
}
