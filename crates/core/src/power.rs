//! Powers of costs: a larger exponent makes long ways dearer, so that the last agent arrives sooner.

use std::ops::RangeInclusive;

/// Exponents of the cost of a pair.
pub const POWERS: RangeInclusive<f64> = 1.0..=16.0;

/// `time ^ power` of a number that is not negative unless the power is 1; 1, 1.5 and 2 by products and a square root, any other by
/// libm.
pub fn raised(time: f64, power: f64) -> f64 {
    if power == 1.0 {
        time
    } else if power == 1.5 {
        time * time.sqrt()
    } else if power == 2.0 {
        time * time
    } else {
        libm::pow(time, power)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_short_ways_agree_with_the_long_one() {
        for time in [0.0, 1e-3, 0.7, 1.0, 12.5, 1e6] {
            for power in [1.0, 1.5, 2.0] {
                let (short, long) = (raised(time, power), libm::pow(time, power));
                assert!((short - long).abs() <= 1e-15 * long, "{time} ^ {power}: {short}, {long}");
            }
        }
        assert_eq!((raised(-3.0, 1.0), raised(3.0, 4.0), raised(0.5, 16.0)), (-3.0, 81.0, 1.0 / 65536.0));
    }
}
