//! Whole numbers of a fixed number of bits: sums of doubles without rounding.
//!
//! A double is a whole multiple of a power of two, so sums and differences of doubles are whole numbers of the smallest of
//! these powers. How many bits they need depends on the doubles; [`Scale`] finds out.

use std::cmp::Ordering;

/// A signed number of 64 · N bits, least significant word first; arithmetic wraps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Fixed<const N: usize>([u64; N]);

impl<const N: usize> Fixed<N> {
    pub(crate) const ZERO: Self = Self([0; N]);

    pub(crate) fn plus(self, other: Self) -> Self {
        let (mut sum, mut carry) = (self, false);
        for (word, other) in sum.0.iter_mut().zip(other.0) {
            let (partial, first) = word.overflowing_add(other);
            let (total, second) = partial.overflowing_add(u64::from(carry));
            (*word, carry) = (total, first | second);
        }
        sum
    }

    pub(crate) fn minus(self, other: Self) -> Self {
        let (mut difference, mut borrow) = (self, false);
        for (word, other) in difference.0.iter_mut().zip(other.0) {
            let (partial, first) = word.overflowing_sub(other);
            let (total, second) = partial.overflowing_sub(u64::from(borrow));
            (*word, borrow) = (total, first | second);
        }
        difference
    }

    /// The number times 2^`bits`.
    pub(crate) fn shifted(self, bits: u32) -> Self {
        let (words, bits) = ((bits / 64) as usize, bits % 64);
        let mut shifted = Self::ZERO;
        for place in words..N {
            let low = self.0[place - words];
            let carried = if bits > 0 && place > words { self.0[place - words - 1] >> (64 - bits) } else { 0 };
            shifted.0[place] = low << bits | carried;
        }
        shifted
    }

    /// A finite double in units of 2^`unit`, of which it must be a whole multiple.
    pub(crate) fn of(value: f64, unit: i32) -> Self {
        let (mantissa, exponent) = parts(value);
        if mantissa == 0 {
            return Self::ZERO;
        }
        let mut magnitude = Self::ZERO;
        magnitude.0[0] = mantissa;
        let magnitude = magnitude.shifted((exponent - unit) as u32);
        if value < 0.0 { Self::ZERO.minus(magnitude) } else { magnitude }
    }
}

impl<const N: usize> Ord for Fixed<N> {
    fn cmp(&self, other: &Self) -> Ordering {
        let sign = |number: &Self| number.0[N - 1] as i64;
        let top = sign(self).cmp(&sign(other));
        (0..N).rev().fold(top, |order, place| order.then_with(|| self.0[place].cmp(&other.0[place])))
    }
}

impl<const N: usize> PartialOrd for Fixed<N> {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

/// The magnitude of a finite double as an odd whole number times a power of two; 0 is (0, 0).
fn parts(value: f64) -> (u64, i32) {
    let bits = value.to_bits();
    let (fraction, exponent) = (bits & ((1 << 52) - 1), (bits >> 52 & 0x7ff) as i32);
    let (mantissa, exponent) = if exponent == 0 { (fraction, -1074) } else { (fraction | 1 << 52, exponent - 1075) };
    if mantissa == 0 {
        return (0, 0);
    }
    let zeros = mantissa.trailing_zeros();
    (mantissa >> zeros, exponent + zeros as i32)
}

/// The powers of two between which the bits of some doubles lie.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Scale {
    lowest: i32,
    /// The first power above all.
    highest: i32,
}

impl Default for Scale {
    fn default() -> Self {
        Self { lowest: i32::MAX, highest: i32::MIN }
    }
}

impl Scale {
    /// Makes room for a double.
    pub(crate) fn include(&mut self, value: f64) {
        let (mantissa, exponent) = parts(value);
        if mantissa != 0 {
            self.lowest = self.lowest.min(exponent);
            self.highest = self.highest.max(exponent + 64 - mantissa.leading_zeros() as i32);
        }
    }

    /// The power of two of the unit.
    pub(crate) fn unit(self) -> i32 {
        if self.lowest > self.highest { 0 } else { self.lowest }
    }

    /// Bits of the largest one, without sign.
    pub(crate) fn bits(self) -> u32 {
        if self.lowest > self.highest { 1 } else { (self.highest - self.lowest) as u32 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use num_bigint::BigInt;
    use proptest::prelude::*;

    fn big(value: f64, unit: i32) -> BigInt {
        let (mantissa, exponent) = parts(value);
        let magnitude = BigInt::from(mantissa) << (exponent - unit) as usize;
        if value < 0.0 { -magnitude } else { magnitude }
    }

    proptest! {
        #[test]
        fn sums_and_order_are_those_of_whole_numbers(
            values in prop::collection::vec(prop_oneof![-1e3..1e3, -1e-9..1e-9, Just(0.0), -1e25..1e25], 4), bits in 0u32..70
        ) {
            let mut scale = Scale::default();
            values.iter().for_each(|&value| scale.include(value));
            let (unit, of) = (scale.unit(), |k: usize| Fixed::<6>::of(values[k], scale.unit()));
            prop_assert!(scale.bits() < 300);
            let exact = |k: usize| big(values[k], unit);
            let (left, right) = (of(0).plus(of(1)).shifted(bits), of(2).minus(of(3)));
            let (a, b) = ((exact(0) + exact(1)) << bits, exact(2) - exact(3));
            prop_assert_eq!(left.cmp(&right), a.cmp(&b));
            prop_assert_eq!(left.minus(right) == Fixed::ZERO, a == b);
        }
    }

    #[test]
    fn the_whole_range_of_doubles_fits() {
        let mut scale = Scale::default();
        [f64::MAX, f64::from_bits(1)].iter().for_each(|&value| scale.include(value));
        assert_eq!((scale.unit(), scale.bits()), (-1074, 2098));
        assert!(Fixed::<34>::of(f64::MAX, -1074) > Fixed::of(f64::from_bits(1), -1074));
        assert!(Fixed::<34>::of(-f64::MAX, -1074) < Fixed::ZERO);
    }
}
