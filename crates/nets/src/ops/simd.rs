//! Loads and stores for the vector type. One vector is always sixteen lanes, whatever the machine's registers are, so
//! that a result does not depend on the instruction set (fused multiply-add is required: x86-64-v3 or AArch64).

use wide::f32x16;

pub(crate) const LANES: usize = 16;

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
        None => {
            let n = slice.len();
            slice.copy_from_slice(&lanes[..n]);
        }
    }
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

/// Logistic function.
#[inline(always)]
pub(crate) fn sigmoid(x: f32x16) -> f32x16 {
    let one = f32x16::ONE;
    one / (one + (-x.max(f32x16::splat(-80.0)).min(f32x16::splat(80.0))).exp())
}

/// Hyperbolic tangent by the logistic function.
#[inline(always)]
pub(crate) fn tanh(x: f32x16) -> f32x16 {
    let two = f32x16::splat(2.0);
    two.mul_sub(sigmoid(two * x), f32x16::ONE)
}
