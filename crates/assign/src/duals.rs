//! Entropic transport prices of an assignment problem (Cuturi 2013, "Sinkhorn distances").
//!
//! The assignment is the limit ε → 0 of the transport plan P_ij = exp((u_i + v_j − c_ij) / ε) with unit row sums and
//! equal column sums. Sinkhorn's iteration finds its potentials u, v; the reduced cost c_ij − u_i − v_j then says how
//! much worse than a global compromise a pair is, which plain distance does not know. ε falls geometrically and every
//! stage starts from the potentials of the one before (Schmitzer 2019, ε-scaling with absorption): inside a stage the
//! iteration is two multiplications per pair on a stored kernel, not an exponential. Every round but a stage's first is
//! overrelaxed, which halves the rounds needed.
//!
//! The bits of the answer do not depend on the machine: sums run in sixteen fixed lanes, multiply-adds are explicit,
//! and the exponential and the logarithm are polynomials of this file.

use crate::{Result, check_size, invalid_entry};
use wide::f32x16;

const LANES: usize = 16;
/// Exponents are kept above this, so that a starved column still has a sum to be divided by.
const FLOOR: f32 = -60.0;
/// Scalings are kept between this and its inverse; they are absorbed into the potentials at the end of a stage.
const LARGEST_SCALE: f32 = 1e30;
/// One relaxed correction is kept between this and its inverse, so that overshooting cannot feed itself.
const LARGEST_STEP: f32 = 1e4;

/// ε of the first and of the last stage, in units of the mean cost; it falls by the same factor from one to the next.
const FIRST: f32 = 0.1;
const LAST: f32 = 0.0003;
const STAGES: usize = 12;
/// Most Sinkhorn rounds (rows, then columns) per stage, and fewest for problems too large to converge in a fraction of a second.
const MOST_ROUNDS: usize = 128;
const FEWEST_ROUNDS: usize = 16;
/// Pairs times rounds that a stage may take.
const ROUND_PAIRS: usize = 64_000_000;
/// A stage ends early when every column of the plan is within this share of its mass.
const TOLERANCE: f32 = 0.05;

/// The potentials of a problem.
#[derive(Debug, Clone, PartialEq)]
pub struct Duals {
    /// `[rows]` price u_i of serving each row.
    pub rows: Vec<f32>,
    /// `[cols]` price v_j of each column.
    pub cols: Vec<f32>,
}

impl Duals {
    /// c_ij − u_i − v_j of one pair.
    pub fn reduced(&self, cost: f32, row: usize, col: usize) -> f32 {
        cost - self.rows[row] - self.cols[col]
    }
}

/// Sinkhorn potentials of `cost`, row-major `[rows, cols]`, in the units of the cost. Row sums are 1 and column sums
/// rows / cols. A problem whose mean |cost| is 0 has potentials 0.
/// Fails for mismatched shapes, and entries that are not finite or beyond 1e30.
pub fn sinkhorn_duals(cost: &[f32], rows: usize, cols: usize) -> Result<Duals> {
    check_size(cost.len(), rows, cols)?;
    if let Some(place) = cost.iter().position(|value| value.is_nan() || value.abs() > 1e30) {
        return Err(invalid_entry(place, cols, f64::from(cost[place])));
    }
    let mean = cost.iter().map(|&c| f64::from(c.abs())).sum::<f64>() / cost.len() as f64;
    // Work in units of the mean: ε is then a plain number and nothing over- or underflows.
    if mean < f64::from(f32::MIN_POSITIVE) {
        return Ok(Duals { rows: vec![0.0; rows], cols: vec![0.0; cols] });
    }
    let unit = mean as f32;
    let mut sinkhorn = Sinkhorn::new(cost, rows, cols, unit);
    let rounds = (ROUND_PAIRS / cost.len()).clamp(FEWEST_ROUNDS, MOST_ROUNDS);
    let fall = ln(LAST / FIRST) / (STAGES - 1) as f32;
    for stage in 0..STAGES {
        let left = (STAGES - 1 - stage) as f32;
        sinkhorn.stage(LAST * exp(-fall * left), rounds);
    }
    let in_units = |prices: &[f32]| prices.iter().map(|price| price * unit).collect();
    Ok(Duals { rows: in_units(&sinkhorn.by_col.price[..rows]), cols: in_units(&sinkhorn.by_row.price[..cols]) })
}

/// Costs and potentials in units of the mean cost. Kernel and costs are kept twice, once by rows and once by columns, so
/// that row sums and column sums are both sums of weighted vectors: no sum runs across the lanes of a vector.
struct Sinkhorn {
    /// Rows and columns.
    shape: (usize, usize),
    by_row: Side,
    by_col: Side,
    /// `[rows]`, padded.
    best: Vec<f32>,
}

/// One orientation: a matrix [members, others], and what belongs to its others.
struct Side {
    /// Others, padded to whole lanes.
    stride: usize,
    /// `[members, stride]`
    cost: Vec<f32>,
    /// `[members, stride]` exp((u + v − c) / ε) with the potentials at the start of the stage; 0 in the padding.
    kernel: Vec<f32>,
    /// `[stride]` potentials of the others.
    price: Vec<f32>,
    /// `[stride]` scalings of the others.
    scale: Vec<f32>,
    /// `[stride]`
    sum: Vec<f32>,
}

impl Side {
    fn new(members: usize, others: usize, cost: impl Fn(usize, usize) -> f32) -> Self {
        let stride = others.next_multiple_of(LANES);
        let mut padded = vec![0.0; members * stride];
        for (member, row) in padded.chunks_exact_mut(stride).enumerate() {
            for (other, slot) in row[..others].iter_mut().enumerate() {
                *slot = cost(member, other);
            }
        }
        let zeros = vec![0.0; stride];
        let kernel = vec![0.0; members * stride];
        Self { stride, cost: padded, kernel, price: zeros.clone(), scale: zeros.clone(), sum: zeros }
    }
}

impl Sinkhorn {
    fn new(cost: &[f32], rows: usize, cols: usize, unit: f32) -> Self {
        let by_row = Side::new(rows, cols, |row, col| cost[row * cols + col] / unit);
        let by_col = Side::new(cols, rows, |col, row| cost[row * cols + col] / unit);
        let best = vec![0.0; by_col.stride];
        Self { shape: (rows, cols), by_row, by_col, best }
    }

    /// Scales the rows to sum 1, then the columns to rows / cols; returns how far they were from that.
    #[inline(always)]
    fn round(
        by_row: &mut Side,
        by_col: &mut Side,
        (rows, cols): (usize, usize),
        correct: impl Fn(f32, f32) -> f32 + Copy,
    ) -> f32 {
        weighted_sum(&by_col.kernel, by_col.stride, &by_row.scale[..cols], &mut by_col.sum);
        rescale(&mut by_col.scale, &mut by_col.sum, rows, 1.0, correct);
        weighted_sum(&by_row.kernel, by_row.stride, &by_col.scale[..rows], &mut by_row.sum);
        rescale(&mut by_row.scale, &mut by_row.sum, cols, rows as f32 / cols as f32, correct)
    }

    /// One ε: the kernel, rounds of scaling until the columns are within [`TOLERANCE`] of their mass, absorption.
    fn stage(&mut self, epsilon: f32, rounds: usize) {
        let Self { shape, by_row, by_col, best } = self;
        let shape @ (rows, cols) = *shape;
        let rate = 1.0 / epsilon;
        let lines = by_row.kernel.chunks_exact_mut(by_row.stride).zip(by_row.cost.chunks_exact(by_row.stride));
        for ((kernel, costs), best) in lines.zip(best.iter_mut()) {
            *best = row_exponents(costs, &by_row.price, rate, cols, kernel);
            for value in kernel.iter_mut() {
                *value = exp(maximum(*value - *best, FLOOR));
            }
            kernel[cols..].fill(0.0);
        }
        let lines = by_col.kernel.chunks_exact_mut(by_col.stride).zip(by_col.cost.chunks_exact(by_col.stride));
        for ((kernel, costs), &price) in lines.zip(&by_row.price) {
            for ((value, &cost), &best) in kernel.iter_mut().zip(costs).zip(best.iter()) {
                *value = exp(maximum((price - cost) * rate - best, FLOOR));
            }
            kernel[rows..].fill(0.0);
        }
        for (price, &best) in by_col.price[..rows].iter_mut().zip(best.iter()) {
            *price = -best * epsilon;
        }
        by_col.scale.fill(1.0);
        by_row.scale.fill(1.0);
        for round in 0..rounds {
            // The first round repairs what the smaller ε broke, by any factor; the others accelerate.
            let worst = if round == 0 {
                Self::round(by_row, by_col, shape, plain)
            } else {
                Self::round(by_row, by_col, shape, relaxed)
            };
            if worst < TOLERANCE {
                break;
            }
        }
        for (side, count) in [(by_col, rows), (by_row, cols)] {
            for (price, &scale) in side.price[..count].iter_mut().zip(&side.scale) {
                *price = epsilon.mul_add(ln(scale), *price);
            }
        }
    }
}

/// Scales towards sums of `mass` and returns the largest |mass / sum − 1| before that.
#[inline(always)]
fn rescale(scales: &mut [f32], sums: &mut [f32], count: usize, mass: f32, correct: impl Fn(f32, f32) -> f32) -> f32 {
    // The padding has its mass and stays as it is.
    sums[count..].fill(mass);
    let mut worst = [0.0; LANES];
    for (scales, sums) in scales.as_chunks_mut::<LANES>().0.iter_mut().zip(sums.as_chunks::<LANES>().0) {
        for lane in 0..LANES {
            let ratio = mass / (sums[lane] * scales[lane]);
            worst[lane] = maximum((ratio - 1.0).abs(), worst[lane]);
            scales[lane] = correct(scales[lane], ratio);
        }
    }
    worst.into_iter().fold(0.0, maximum)
}

/// Σ of the rows of `matrix` [members, stride] times their weights.
fn weighted_sum(matrix: &[f32], stride: usize, weights: &[f32], out: &mut [f32]) {
    let mut start = 0;
    while start < stride {
        start += match (stride - start) / LANES {
            8.. => panel::<8>(matrix, stride, start, weights, out),
            4..8 => panel::<4>(matrix, stride, start, weights, out),
            2..4 => panel::<2>(matrix, stride, start, weights, out),
            _ => panel::<1>(matrix, stride, start, weights, out),
        };
    }
}

/// The same for Q vectors of columns from `start` on, odd and even rows apart to keep the adders busy; returns the columns done.
#[inline(always)]
fn panel<const Q: usize>(matrix: &[f32], stride: usize, start: usize, weights: &[f32], out: &mut [f32]) -> usize {
    let width = Q * LANES;
    let (mut even, mut odd) = ([f32x16::ZERO; Q], [f32x16::ZERO; Q]);
    let values = |row: usize| matrix[row * stride + start..][..width].as_chunks::<LANES>().0;
    let (pairs, rest) = weights.as_chunks::<2>();
    for (pair, weight) in pairs.iter().enumerate() {
        let (first, second) = (values(2 * pair), values(2 * pair + 1));
        let weight = weight.map(f32x16::splat);
        // Indices: this loop must be unrolled whatever the optimiser thinks of iterators.
        for q in 0..Q {
            even[q] = f32x16::new(first[q]).mul_add(weight[0], even[q]);
            odd[q] = f32x16::new(second[q]).mul_add(weight[1], odd[q]);
        }
    }
    if let Some(&weight) = rest.first() {
        let last = values(weights.len() - 1);
        for q in 0..Q {
            even[q] = f32x16::new(last[q]).mul_add(f32x16::splat(weight), even[q]);
        }
    }
    for ((out, even), odd) in out[start..start + width].as_chunks_mut::<LANES>().0.iter_mut().zip(even).zip(odd) {
        *out = (even + odd).to_array();
    }
    width
}

/// Sinkhorn's own step.
fn plain(scale: f32, ratio: f32) -> f32 {
    clamp(scale * ratio, LARGEST_SCALE)
}

/// The step taken one and three quarter times: ratio^1.75 (Thibault et al. 2017, "Overrelaxed Sinkhorn–Knopp").
fn relaxed(scale: f32, ratio: f32) -> f32 {
    let ratio = clamp(ratio, LARGEST_STEP);
    let root = ratio.sqrt();
    clamp(scale * (ratio * root * root.sqrt()), LARGEST_SCALE)
}

fn clamp(value: f32, largest: f32) -> f32 {
    maximum(minimum(value, largest), 1.0 / largest)
}

/// (v_j − c_j) · rate for one row into `out`; returns the largest over the real columns.
fn row_exponents(costs: &[f32], prices: &[f32], rate: f32, cols: usize, out: &mut [f32]) -> f32 {
    for ((out, &cost), &price) in out.iter_mut().zip(costs).zip(prices) {
        *out = (price - cost) * rate;
    }
    out[cols..].fill(f32::MIN);
    let mut best = [f32::MIN; LANES];
    for values in out.as_chunks::<LANES>().0 {
        for lane in 0..LANES {
            best[lane] = maximum(values[lane], best[lane]);
        }
    }
    best.into_iter().fold(f32::MIN, maximum)
}

// Comparisons instead of f32::max / min: one instruction, and NaN cannot occur here.
#[inline(always)]
fn maximum(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

#[inline(always)]
fn minimum(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

/// e^x for −87 ≤ x ≤ 88, relative error below 3e-7: 2^n times a polynomial on |r| ≤ ln 2 / 2.
#[inline(always)]
fn exp(x: f32) -> f32 {
    // Adding and subtracting 1.5 · 2^23 rounds to a whole number, which then stands in the low bits.
    const ROUND: f32 = 12_582_912.0;
    let shifted = x.mul_add(std::f32::consts::LOG2_E, ROUND);
    let whole = shifted - ROUND;
    let r = whole.mul_add(-1.428_606_8e-6, whole.mul_add(-0.693_145_75, x));
    let p = r.mul_add(1.0 / 720.0, 1.0 / 120.0);
    let p = r.mul_add(p, 1.0 / 24.0);
    let p = r.mul_add(p, 1.0 / 6.0);
    let p = r.mul_add(p, 0.5);
    let p = r.mul_add(p, 1.0);
    let p = r.mul_add(p, 1.0);
    let exponent = shifted.to_bits().wrapping_sub(ROUND.to_bits()).wrapping_add(127) << 23;
    p * f32::from_bits(exponent)
}

/// ln of a positive normal number, absolute error below 4e-7 near 1: x = m · 2^n, ln m = 2 artanh((m − 1) / (m + 1)).
fn ln(x: f32) -> f32 {
    let bits = x.to_bits();
    // 0x3f3504f3 is √½; subtracting it makes the exponent field count from there.
    let shifted = bits.wrapping_sub(0x3f35_04f3);
    let whole = (shifted as i32) >> 23;
    let m = f32::from_bits(bits.wrapping_sub((whole as u32) << 23));
    let s = (m - 1.0) / (m + 1.0);
    let square = s * s;
    let p = square.mul_add(2.0 / 9.0, 2.0 / 7.0);
    let p = square.mul_add(p, 2.0 / 5.0);
    let p = square.mul_add(p, 2.0 / 3.0);
    let p = square.mul_add(p, 2.0);
    (whole as f32).mul_add(std::f32::consts::LN_2, s * p)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_and_ln_are_close_to_the_real_ones() {
        for step in 0..120_000 {
            let x = -60.0 + step as f32 * 1e-3;
            let exact = f64::from(x).exp();
            assert!((f64::from(exp(x)) / exact - 1.0).abs() < 3e-7, "exp {x}");
            let y = exp(x);
            assert!((f64::from(ln(y)) - f64::from(y).ln()).abs() < 4e-7 + 1e-7 * f64::from(x.abs()), "ln {y}");
        }
    }
}
