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

use crate::{AssignError, check_shape};

const LANES: usize = 16;
/// Exponents are kept above this, so that a starved column still has a sum to be divided by.
const FLOOR: f32 = -60.0;
/// Scalings are kept between this and its inverse; they are absorbed into the potentials at the end of a stage.
const LARGEST_SCALE: f32 = 1e30;
/// One relaxed correction is kept between this and its inverse, so that overshooting cannot feed itself.
const LARGEST_STEP: f32 = 1e4;

/// How ε falls. Lengths are in units of the mean cost.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Schedule {
    /// ε of the first stage / mean cost.
    pub first: f32,
    /// ε of the last stage / mean cost.
    pub last: f32,
    /// Stages; ε falls by the same factor from one to the next.
    pub stages: usize,
    /// Sinkhorn rounds (rows, then columns) per stage.
    pub rounds: usize,
}

impl Default for Schedule {
    fn default() -> Self {
        Self { first: 0.1, last: 0.001, stages: 12, rounds: 16 }
    }
}

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
///
/// # Errors
/// Empty or mismatched shapes, entries that are not finite or beyond 1e30, and a schedule out of range.
pub fn sinkhorn_duals(cost: &[f32], rows: usize, cols: usize, schedule: &Schedule) -> Result<Duals, AssignError> {
    check(cost, rows, cols, schedule)?;
    let mean = cost.iter().map(|&c| f64::from(c.abs())).sum::<f64>() / cost.len() as f64;
    // Work in units of the mean: ε is then a plain number and nothing over- or underflows.
    if mean < f64::from(f32::MIN_POSITIVE) {
        return Ok(Duals { rows: vec![0.0; rows], cols: vec![0.0; cols] });
    }
    let unit = mean as f32;
    let mut sinkhorn = Sinkhorn::new(cost, rows, cols, unit);
    let fall =
        if schedule.stages > 1 { ln(schedule.last / schedule.first) / (schedule.stages - 1) as f32 } else { 0.0 };
    for stage in 0..schedule.stages {
        let left = (schedule.stages - 1 - stage) as f32;
        sinkhorn.stage(schedule.last * exp(-fall * left), schedule.rounds);
    }
    sinkhorn.col_price.truncate(cols);
    let in_units = |prices: Vec<f32>| prices.into_iter().map(|price| price * unit).collect();
    Ok(Duals { rows: in_units(sinkhorn.row_price), cols: in_units(sinkhorn.col_price) })
}

fn check(cost: &[f32], rows: usize, cols: usize, schedule: &Schedule) -> Result<(), AssignError> {
    check_shape(rows, cols)?;
    let expected = rows.saturating_mul(cols);
    if cost.len() != expected {
        return Err(AssignError::Size { field: "cost", found: cost.len(), expected });
    }
    if let Some(place) = cost.iter().position(|value| value.is_nan() || value.abs() > 1e30) {
        return Err(AssignError::Entry { row: place / cols, col: place % cols, value: f64::from(cost[place]) });
    }
    let epsilons = [("schedule.first", schedule.first), ("schedule.last", schedule.last)];
    for (field, value) in epsilons {
        if !(1e-4..=100.0).contains(&value) {
            let remedy = "use a share of the mean cost between 0.0001 and 100";
            return Err(AssignError::Parameter { field, value: f64::from(value), remedy });
        }
    }
    for (field, value) in [("schedule.stages", schedule.stages), ("schedule.rounds", schedule.rounds)] {
        if !(1..=100_000).contains(&value) {
            return Err(AssignError::Parameter { field, value: value as f64, remedy: "use 1 to 100000" });
        }
    }
    Ok(())
}

/// Costs and potentials in units of the mean cost; columns padded to whole lanes.
struct Sinkhorn {
    stride: usize,
    cols: usize,
    /// rows / cols, the sum of every column of the plan.
    col_mass: f32,
    /// `[rows, stride]`
    cost: Vec<f32>,
    /// `[rows, stride]` exp((u + v − c) / ε) with the potentials at the start of the stage.
    kernel: Vec<f32>,
    row_price: Vec<f32>,
    col_price: Vec<f32>,
    row_scale: Vec<f32>,
    col_scale: Vec<f32>,
    col_sum: Vec<f32>,
}

impl Sinkhorn {
    fn new(cost: &[f32], rows: usize, cols: usize, unit: f32) -> Self {
        let stride = cols.next_multiple_of(LANES);
        let mut padded = vec![0.0; rows * stride];
        for (padded, costs) in padded.chunks_exact_mut(stride).zip(cost.chunks_exact(cols)) {
            for (slot, cost) in padded.iter_mut().zip(costs) {
                *slot = cost / unit;
            }
        }
        Self {
            stride,
            cols,
            col_mass: rows as f32 / cols as f32,
            cost: padded,
            kernel: vec![0.0; rows * stride],
            row_price: vec![0.0; rows],
            col_price: vec![0.0; stride],
            row_scale: vec![1.0; rows],
            col_scale: vec![0.0; stride],
            col_sum: vec![0.0; stride],
        }
    }

    /// One ε: the kernel from the current potentials, `rounds` of scaling, absorption.
    fn stage(&mut self, epsilon: f32, rounds: usize) {
        let rate = 1.0 / epsilon;
        for (row, (kernel, costs)) in
            self.kernel.chunks_exact_mut(self.stride).zip(self.cost.chunks_exact(self.stride)).enumerate()
        {
            let best = row_exponents(costs, &self.col_price, rate, self.cols, kernel);
            for value in kernel.iter_mut() {
                *value = exp(maximum(*value - best, FLOOR));
            }
            kernel[self.cols..].fill(0.0);
            self.row_price[row] = -best * epsilon;
        }
        self.row_scale.fill(1.0);
        self.col_scale[..self.cols].fill(1.0);
        for round in 0..rounds {
            // The first round repairs what the smaller ε broke, by any factor; the others accelerate.
            if round == 0 {
                self.round(plain);
            } else {
                self.round(relaxed);
            }
        }
        for (price, &scale) in self.row_price.iter_mut().zip(&self.row_scale) {
            *price = epsilon.mul_add(ln(scale), *price);
        }
        for (price, &scale) in self.col_price[..self.cols].iter_mut().zip(&self.col_scale) {
            *price = epsilon.mul_add(ln(scale), *price);
        }
    }

    /// Scales the rows to sum 1, then the columns to their mass, in one pass over the kernel. `correct` turns
    /// (scale, wanted sum / present sum) into the new scale.
    fn round(&mut self, correct: impl Fn(f32, f32) -> f32) {
        self.col_sum.fill(0.0);
        for (kernel, scale) in self.kernel.chunks_exact(self.stride).zip(&mut self.row_scale) {
            *scale = correct(*scale, 1.0 / (dot(kernel, &self.col_scale) * *scale));
            for (sum, &value) in self.col_sum.iter_mut().zip(kernel) {
                *sum = value.mul_add(*scale, *sum);
            }
        }
        for (scale, &sum) in self.col_scale[..self.cols].iter_mut().zip(&self.col_sum) {
            *scale = correct(*scale, self.col_mass / (sum * *scale));
        }
    }
}

/// Sinkhorn's own step.
fn plain(scale: f32, ratio: f32) -> f32 {
    clamp(scale * ratio, LARGEST_SCALE)
}

/// The step taken one and a half times: ratio^1.5 (Thibault et al. 2017, "Overrelaxed Sinkhorn–Knopp").
fn relaxed(scale: f32, ratio: f32) -> f32 {
    let ratio = clamp(ratio, LARGEST_STEP);
    clamp(scale * (ratio * ratio.sqrt()), LARGEST_SCALE)
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

fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0f32; LANES];
    for (a, b) in a.as_chunks::<LANES>().0.iter().zip(b.as_chunks::<LANES>().0) {
        for lane in 0..LANES {
            sums[lane] = a[lane].mul_add(b[lane], sums[lane]);
        }
    }
    let mut width = LANES / 2;
    while width > 0 {
        for lane in 0..width {
            sums[lane] += sums[lane + width];
        }
        width /= 2;
    }
    sums[0]
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

/// Natural logarithm of a positive normal number, absolute error below 4e-7 near 1: x = m · 2^n with m in
/// [√½, √2), ln m = 2 artanh((m − 1) / (m + 1)).
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
