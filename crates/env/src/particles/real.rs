//! The scalar of the physics: one code for f32 and f64.
//!
//! Rollouts use f32: the wire carries f32 (a trajectory must hold the very numbers that were simulated), and a vector
//! register holds twice as many of them. Measured on a Zen 5 core with AVX-512 (`magex-bench env`): f32 does 1.7
//! times (N = 5) to 2.1 times (N = 50) the joint steps of f64. The golden check runs the same code in f64, where it
//! agrees with the authors' simulator to rounding.
//!
//! Everything here is built from +, −, ×, ÷, √ and fused multiply-add, which IEEE 754 defines to the last bit, so no
//! result depends on the machine, on a mathematics library or on how the compiler vectorised.

use std::fmt::Debug;
use std::ops::{Add, AddAssign, Div, Mul, Neg, Sub};

/// f32 or f64.
pub trait Real:
    Copy
    + Default
    + Debug
    + PartialOrd
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + AddAssign
    + From<i8>
    + Into<f64>
    + Send
    + Sync
    + 'static
{
    /// 0.
    const ZERO: Self;
    /// 1.
    const ONE: Self;
    /// 2.
    const TWO: Self;
    /// Softplus arguments below minus this are taken for minus infinity.
    ///
    /// A contact changes a velocity by dt · 100 · k · softplus(z) = 0.01 · softplus(z) and softplus(z) < e^z. At f64's
    /// 36 that is below 2.4e-18 per pair and step, a millionth of the 1e-12 the golden check allows; at f32's 20 it is
    /// below 2.1e-11, a thousandth of the spacing of f32 numbers near 1.
    const NEGLIGIBLE: Self;
    /// Nearest number.
    fn from_f64(value: f64) -> Self;
    /// self · a + b, rounded once.
    fn mul_add(self, a: Self, b: Self) -> Self;
    /// Square root, correctly rounded.
    fn sqrt(self) -> Self;
    /// e^(−self) for self ≥ 0; arguments beyond the range of normal numbers give a tiny normal one.
    fn exp_neg(self) -> Self;
    /// atanh(√s) / √s for 0 ≤ s ≤ 1/9.
    fn atanh_series(s: Self) -> Self;
}

/// ln(1 + e^z) to within a few units in the last place, without overflow.
#[inline(always)]
pub(crate) fn softplus<R: Real>(z: R) -> R {
    let positive = z > R::ZERO;
    let u = if positive { z } else { -z }.exp_neg();
    // ln(1 + u) = 2 atanh(u / (2 + u)): no cancellation however small u is.
    let s = u / (R::TWO + u);
    let tail = R::TWO * s * R::atanh_series(s * s);
    if positive { z + tail } else { tail }
}

/// `c[0] + x (c[1] + x (c[2] + ...))`.
#[inline(always)]
fn horner<R: Real, const K: usize>(x: R, c: &[R; K]) -> R {
    let mut sum = R::ZERO;
    for &term in c.iter().rev() {
        sum = sum.mul_add(x, term);
    }
    sum
}

/// 1/k! and 1/(2k + 1), as many as the type can tell apart on the arguments met here.
const fn inverse_factorials<const K: usize>() -> [f64; K] {
    let mut c = [1.0; K];
    let mut k = 1;
    let mut factorial = 1.0;
    while k < K {
        factorial *= k as f64;
        c[k] = 1.0 / factorial;
        k += 1;
    }
    c
}

const fn inverse_odds<const K: usize>() -> [f64; K] {
    let mut c = [1.0; K];
    let mut k = 0;
    while k < K {
        c[k] = 1.0 / (2 * k + 1) as f64;
        k += 1;
    }
    c
}

const fn narrow<const K: usize>(wide: [f64; K]) -> [f32; K] {
    let mut c = [0.0; K];
    let mut k = 0;
    while k < K {
        c[k] = wide[k] as f32;
        k += 1;
    }
    c
}

// |r| ≤ ln 2 / 2: the first term left out is 5e-9 (f32) and 4e-18 (f64) of the sum; s ≤ 1/9: 1.4e-9 and 1.6e-17.
const EXP_F64: [f64; 14] = inverse_factorials();
const EXP_F32: [f32; 8] = narrow(inverse_factorials());
const ATANH_F64: [f64; 16] = inverse_odds();
const ATANH_F32: [f32; 8] = narrow(inverse_odds());

/// $round is 1.5 · 2^$mantissa plus the bias of the exponent: adding it rounds to a whole number n and leaves n + bias in the
/// low bits, so that 2^n is a shift away. $ln2 is ln 2 in two parts, the first short enough for n · part to be exact.
macro_rules! real {
    ($real:ident, $negligible:literal, $most:literal, $round:expr, $mantissa:literal, $ln2:expr, $exp:ident, $atanh:ident) => {
        impl Real for $real {
            const ZERO: Self = 0.0;
            const ONE: Self = 1.0;
            const TWO: Self = 2.0;
            const NEGLIGIBLE: Self = $negligible;

            #[inline(always)]
            fn from_f64(value: f64) -> Self {
                value as Self
            }
            #[inline(always)]
            fn mul_add(self, a: Self, b: Self) -> Self {
                $real::mul_add(self, a, b)
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                $real::sqrt(self)
            }
            #[inline(always)]
            fn exp_neg(self) -> Self {
                const ROUND: $real = $round;
                const LN_2: [$real; 2] = $ln2;
                let x = if self < $most { -self } else { -$most };
                let shifted = x.mul_add(std::$real::consts::LOG2_E, ROUND);
                let n = shifted - ROUND;
                let r = n.mul_add(-LN_2[1], n.mul_add(-LN_2[0], x));
                horner(r, &$exp) * $real::from_bits(shifted.to_bits() << $mantissa)
            }
            #[inline(always)]
            fn atanh_series(s: Self) -> Self {
                horner(s, &$atanh)
            }
        }
    };
}

real!(f32, 20.0, 87.0, 12_582_912.0 + 127.0, 23, [0.693_145_75, 1.428_606_8e-6], EXP_F32, ATANH_F32);
real!(
    f64,
    36.0,
    708.0,
    6_755_399_441_055_744.0 + 1023.0,
    52,
    [6.931_471_803_691_238e-1, 1.908_214_929_270_587_7e-10],
    EXP_F64,
    ATANH_F64
);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn softplus_is_exact_to_rounding_over_the_whole_range() {
        let mut worst = (0.0f64, 0.0f64);
        for step in 0..=400_000 {
            let z = -40.0 + f64::from(step) * 6e-4; // -40 .. 200
            let exact = |z: f64| z.max(0.0) + libm::log1p(libm::exp(-z.abs()));
            worst.0 = worst.0.max((softplus(z) / exact(z) - 1.0).abs());
            let z = z as f32;
            let exact = exact(f64::from(z));
            worst.1 = worst.1.max((f64::from(softplus(z)) / exact - 1.0).abs());
        }
        assert!(worst.0 < 1e-15, "f64: {:e}", worst.0);
        assert!(worst.1 < 4e-7, "f32: {:e}", worst.1);
    }

    #[test]
    fn softplus_survives_the_extremes() {
        assert_eq!(softplus(1e30f32), 1e30);
        assert_eq!(softplus(1e300f64), 1e300);
        assert!(softplus(-1e30f32) < 1e-37);
        assert!((softplus(0.0f64) - std::f64::consts::LN_2).abs() < 3e-16);
    }
}
