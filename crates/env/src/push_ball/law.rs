//! The way of an agent by its ball to a landmark; [`magex_core::task::PushBallConfig`] has the law of the reward.

use super::constants::REACHED;
use crate::particles::real::Real;
use magex_core::task::PushBallConfig;

/// The two legs of an agent's way at one moment.
#[derive(Debug, Clone, Copy)]
pub(super) struct Legs {
    /// Φ, minus the way left.
    pub(super) potential: f32,
    pub(super) distance: f32,
    pub(super) last2: f32,
}

impl Legs {
    /// From the vectors agent → ball and ball → landmark and the turn length.
    #[inline(always)]
    pub(super) fn new((ax, ay): (f32, f32), (bx, by): (f32, f32), turn_length: f32) -> Self {
        const PUSH: f32 = PushBallConfig::PUSH_DISTANCE as f32;
        const PER_REACHED: f32 = (1.0 / REACHED) as f32;
        let d_ab = ax.mul_add(ax, ay * ay).sqrt();
        let last2 = bx.mul_add(bx, by * by);
        let d_bl = last2.sqrt();
        let gap = d_ab - PUSH;
        let gap = if gap > 0.0 { gap } else { 0.0 };
        let near = d_bl * PER_REACHED;
        let near = if near < 1.0 { near } else { 1.0 };
        let (dot, cross) = (ax.mul_add(bx, ay * by), ax.mul_add(by, -(ay * bx)));
        let turn = turn_length * near * angle(dot, cross, d_ab * d_bl);
        let path = gap + turn;
        Self { potential: -(2.0f32.mul_add(d_bl, path)), distance: d_ab + d_bl, last2 }
    }
}

/// The angle in \[0, π\] between two vectors of the given dot and cross products, `size` the product of their lengths; 0 if
/// one of them is.
#[inline(always)]
pub(crate) fn angle<R: Real>(dot: R, cross: R, size: R) -> R {
    let cross = if cross < R::ZERO { -cross } else { cross };
    let blunt = dot < R::ZERO;
    // tan(θ / 2) of the acute one of θ and π − θ, at most 1.
    let below = size + if blunt { -dot } else { dot };
    let half = if below > R::ZERO { cross / below } else { R::ZERO };
    // Halved once more: tan ≤ √2 − 1, where the series atan(t) = t · (1 − t²/3 + t⁴/5 − …) is short.
    let t = half / (R::ONE + half.mul_add(half, R::ONE).sqrt());
    let acute = R::from_f64(4.0) * t * R::atanh_series(-(t * t));
    if blunt { R::from_f64(std::f64::consts::PI) - acute } else { acute }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_angle_is_that_of_the_library_in_every_direction() {
        for k in 0..=2000 {
            let theta = std::f64::consts::PI * f64::from(k) / 1000.0;
            for (length, other) in [(1.0, 1.0), (0.01, 7.0), (30.0, 1e-4)] {
                let a = [length * libm::cos(0.4), length * libm::sin(0.4)];
                let b = [other * libm::cos(0.4 + theta), other * libm::sin(0.4 + theta)];
                let (dot, cross) = (a[0] * b[0] + a[1] * b[1], a[0] * b[1] - a[1] * b[0]);
                let expected = libm::fabs(libm::atan2(cross, dot));
                let single = f64::from(angle(dot as f32, cross as f32, (length * other) as f32));
                // The products' own rounding moves an angle near 0 or π by about its square root.
                assert!((single - expected).abs() < 2e-6, "{theta}: {single} {expected}");
                let double = angle(dot, cross, length * other);
                assert!((double - expected).abs() < 1e-12, "{theta}: {double} {expected}");
            }
        }
        assert_eq!(angle(0.0f32, 0.0, 0.0), 0.0);
    }
}
