//! Loads and stores for the vector type. One vector is always sixteen lanes, whatever the machine's registers are, so
//! that a result does not depend on the instruction set (fused multiply-add is required: x86-64-v3 or AArch64).

use wide::{f32x8, f32x16, i32x16};

pub(crate) const LANES: usize = 16;

/// Whether there are thirty-two registers of sixteen lanes, or sixteen of eight (where one vector takes two of them). Kernels hold
/// as many sums at once as there is room for; each sum has its own fixed order either way.
pub(crate) const WIDE: bool = cfg!(target_feature = "avx512f");

/// Rows of numbers, `stride` apart.
#[derive(Clone, Copy)]
pub(crate) struct Rows<'a> {
    pub(crate) values: &'a [f32],
    pub(crate) stride: usize,
}

impl<'a> Rows<'a> {
    pub(crate) fn new(values: &'a [f32], stride: usize) -> Self {
        Self { values, stride }
    }

    /// Without the first `column` numbers.
    pub(crate) fn skip(self, column: usize) -> Self {
        Self { values: &self.values[column..], ..self }
    }
}

/// The first sixteen numbers; a shorter slice is filled up with zeros.
#[inline(always)]
pub(crate) fn load(slice: &[f32]) -> f32x16 {
    match slice.first_chunk::<LANES>() {
        Some(chunk) => f32x16::new(*chunk),
        None => {
            let mut lanes = [0.0; LANES];
            lanes[..slice.len()].copy_from_slice(slice);
            f32x16::new(lanes)
        }
    }
}

/// Writes sixteen numbers, or as many as the slice has room for.
#[inline(always)]
pub(crate) fn store(value: f32x16, slice: &mut [f32]) {
    let lanes = value.to_array();
    match slice.first_chunk_mut::<LANES>() {
        Some(chunk) => *chunk = lanes,
        // A copy of a length that is not known is a call.
        None => slice.iter_mut().zip(lanes).for_each(|(out, lane)| *out = std::hint::black_box(lane)),
    }
}

/// Whole vectors of a row, `H / 16` of each of its parts.
#[inline(always)]
pub(crate) fn parts<const P: usize>(row: &[f32], vectors: usize) -> [&[[f32; LANES]]; P] {
    let all = row.as_chunks().0;
    std::array::from_fn(|p| &all[p * vectors..][..vectors])
}

/// The same to write to.
#[inline(always)]
pub(crate) fn parts_mut<const P: usize>(row: &mut [f32], vectors: usize) -> [&mut [[f32; LANES]]; P] {
    let mut left = row.as_chunks_mut().0;
    std::array::from_fn(|_| {
        let (part, rest) = std::mem::take(&mut left).split_at_mut(vectors);
        left = rest;
        part
    })
}

/// Sum of the lanes in a fixed order (a balanced tree), the same on every instruction set.
#[inline(always)]
pub(crate) fn sum(value: f32x16) -> f32 {
    let a = value.to_array();
    let mut half = [0.0f32; 8];
    for i in 0..8 {
        half[i] = a[i] + a[i + 8];
    }
    let quarter = [half[0] + half[4], half[1] + half[5], half[2] + half[6], half[3] + half[7]];
    (quarter[0] + quarter[2]) + (quarter[1] + quarter[3])
}

/// [`sum`] of each of several vectors, with the same bits, eight at a time.
#[inline(always)]
pub(crate) fn sums(values: &[f32x16], out: &mut [f32]) {
    let (eights, rest) = values.as_chunks::<8>();
    let (out_eights, out_rest) = out.as_chunks_mut::<8>();
    for (eight, out) in eights.iter().zip(out_eights) {
        let halves = eight.map(|value| {
            let lanes = value.to_array();
            let (low, high) = lanes.split_at(8);
            let half = |lanes: &[f32]| lanes.first_chunk().map_or(f32x8::ZERO, |lanes| f32x8::new(*lanes));
            half(low) + half(high)
        });
        let half = f32x8::transpose(halves);
        let quarter: [f32x8; 4] = std::array::from_fn(|i| half[i] + half[i + 4]);
        *out = ((quarter[0] + quarter[2]) + (quarter[1] + quarter[3])).to_array();
    }
    out_rest.iter_mut().zip(rest).for_each(|(out, value)| *out = sum(*value));
}

/// out [columns, stride] gets the transpose of the first `rows` rows and `columns` columns of x. Where there is room, zeros fill up the
/// last eight rows; what is beyond them stays.
#[inline(always)]
pub(crate) fn transpose(x: Rows<'_>, rows: usize, columns: usize, out: &mut [f32], stride: usize) {
    let blocks = if rows.next_multiple_of(8) <= stride { rows.div_ceil(8) } else { rows / 8 };
    let (whole_rows, whole_columns) = (8 * blocks, columns / 8 * 8);
    for row in (0..whole_rows).step_by(8) {
        for column in (0..whole_columns).step_by(8) {
            let line = |i: usize| {
                let from = if row + i < rows { x.values.get((row + i) * x.stride + column..) } else { None };
                from.and_then(|from| from.first_chunk()).map_or(f32x8::ZERO, |from| f32x8::new(*from))
            };
            // Written out: the compiler makes a call of `from_fn`.
            let block = f32x8::transpose([0, 1, 2, 3, 4, 5, 6, 7].map(line));
            for (i, line) in block.into_iter().enumerate() {
                let at = (column + i) * stride + row;
                out[at..at + 8].copy_from_slice(&line.to_array());
            }
        }
    }
    for row in 0..rows {
        for column in if row < whole_rows { whole_columns } else { 0 }..columns {
            out[column * stride + row] = x.values[row * x.stride + column];
        }
    }
}

/// eˣ for |x| ≤ 87, within 2 units in the last place: `wide`'s takes three times as long, because it looks after infinities,
/// subnormal numbers and NaN (which stays NaN here, too).
#[inline(always)]
pub(crate) fn exp_within(x: f32x16) -> f32x16 {
    // x = k ln 2 + r with |r| ≤ ln 2 / 2. A number this large has no room for fractions: the sum is rounded to a whole k.
    let round = f32x16::splat(12_582_912.0);
    let shifted = x.mul_add(f32x16::LOG2_E, round);
    let k = shifted - round;
    let r = k.mul_neg_add(f32x16::splat(0.693_359_4), x);
    let r = k.mul_neg_add(f32x16::splat(-2.121_944_4e-4), r);
    // The polynomial of Cephes' expf (Moshier).
    let mut p = f32x16::splat(1.987_569_1e-4);
    for c in [1.398_199_9e-3, 8.333_452e-3, 4.166_579_6e-2, 0.166_666_65, 0.5] {
        p = p.mul_add(r, f32x16::splat(c));
    }
    let e = p.mul_add(r * r, r) + f32x16::ONE;
    // The last bits of `shifted` are k: into the exponent with them.
    let scale: i32x16 = (wide::bytemuck::cast::<f32x16, i32x16>(shifted) << 23) + i32x16::splat(0x3f80_0000);
    e * wide::bytemuck::cast::<i32x16, f32x16>(scale)
}

/// eˣ for x ≤ 0; what is smaller than e^−87 counts as that.
#[inline(always)]
pub(crate) fn exp_of_negative(x: f32x16) -> f32x16 {
    exp_within(f32x16::splat(-87.0).fast_max(x))
}

/// ln x of positive normal numbers, within 2 units in the last place of 1 or of the result: `wide`'s looks after all others, too.
#[inline(always)]
pub(crate) fn ln_of_normal(x: f32x16) -> f32x16 {
    // x = 2ᵉ m with m between √½ and √2.
    let bits = wide::bytemuck::cast::<f32x16, i32x16>(x);
    let e = (bits - i32x16::splat(0x3f35_04f3)) >> 23;
    let m = wide::bytemuck::cast::<i32x16, f32x16>(bits - (e << 23));
    let (e, f) = (f32x16::from_i32x16(e), m - f32x16::ONE);
    // The polynomial of Cephes' logf (Moshier).
    let mut p = f32x16::splat(7.037_683_6e-2);
    for c in [
        -0.115_146_1,
        0.116_769_99,
        -0.124_201_41,
        0.142_493_23,
        -0.166_680_58,
        0.200_007_14,
        -0.249_999_94,
        0.333_333_3,
    ] {
        p = p.mul_add(f, f32x16::splat(c));
    }
    let square = f * f;
    let tail = e.mul_add(f32x16::splat(-2.121_944_4e-4), square * f * p);
    let near = square.mul_add(f32x16::splat(-0.5), f) + tail;
    e.mul_add(f32x16::splat(0.693_359_4), near)
}

/// Logistic function.
#[inline(always)]
pub(crate) fn sigmoid(x: f32x16) -> f32x16 {
    let one = f32x16::ONE;
    // The bound first: of two operands the instruction gives the second one if one of them is NaN.
    let x = f32x16::splat(80.0).fast_min(f32x16::splat(-80.0).fast_max(x));
    one / (one + exp_within(-x))
}

/// Hyperbolic tangent by the logistic function.
#[inline(always)]
pub(crate) fn tanh(x: f32x16) -> f32x16 {
    let two = f32x16::splat(2.0);
    two.mul_sub(sigmoid(two * x), f32x16::ONE)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_of_many_vectors_have_the_bits_of_one_and_blocks_transpose() {
        let numbers: Vec<f32> = (0..21 * 29).map(|i| libm::sinf(i as f32 * 1.7)).collect();
        let vectors: Vec<f32x16> = numbers.chunks_exact(LANES).take(21).map(load).collect();
        let mut out = [0.0; 21];
        sums(&vectors, &mut out);
        assert_eq!(out.to_vec(), vectors.iter().map(|v| sum(*v)).collect::<Vec<f32>>());
        let mut turned = vec![-1.0; 27 * 24];
        transpose(Rows::new(&numbers, 29), 21, 27, &mut turned, 24);
        for column in 0..27 {
            for row in 0..24 {
                let expected = match row {
                    0..21 => numbers[row * 29 + column],
                    // Zeros fill up eight rows, in whole blocks of columns.
                    _ => {
                        if column < 24 {
                            0.0
                        } else {
                            -1.0
                        }
                    }
                };
                assert_eq!(turned[column * 24 + row], expected);
            }
        }
    }

    #[test]
    fn the_short_logarithm_is_close_everywhere() {
        for i in 0..60_000 {
            let x = libm::expf((i - 30_000) as f32 * 0.002_8);
            let (ours, exact) = (f64::from(ln_of_normal(f32x16::splat(x)).to_array()[5]), libm::log(f64::from(x)));
            assert!((ours - exact).abs() <= 2.0e-7 * exact.abs().max(1.0), "{x}: {ours} and {exact}");
        }
        assert_eq!(ln_of_normal(f32x16::ONE).to_array(), [0.0; LANES]);
    }

    #[test]
    fn the_short_exponential_is_close_everywhere_and_keeps_what_is_no_number() {
        for i in -8700..=8700 {
            let x = i as f32 * 0.01;
            let (ours, exact) = (f64::from(exp_within(f32x16::splat(x)).to_array()[3]), libm::exp(f64::from(x)));
            assert!((ours - exact).abs() <= 2.5e-7 * exact, "{x}: {ours} and {exact}");
        }
        assert_eq!(exp_within(f32x16::ZERO).to_array(), [1.0; LANES]);
        assert!(exp_within(f32x16::splat(f32::NAN)).to_array()[0].is_nan());
        for f in [sigmoid, tanh] {
            assert!(f(f32x16::splat(f32::NAN)).to_array()[0].is_nan());
            assert!(f(f32x16::splat(f32::INFINITY)).to_array()[0] == 1.0);
        }
    }
}
