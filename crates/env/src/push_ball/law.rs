//! What Push Ball pays for.

use super::constants::{PUSH_DISTANCE, REACHED};
use crate::particles::real::Real;
use magex_core::task::PushBallConfig;

/// The coefficients of the reward in the physics' scalar; see [`PushBallConfig`] for the law.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Law<R> {
    pub(crate) progress: R,
    arc: R,
    pub(crate) bonus: R,
    pub(crate) distance: R,
    /// The distance at which an agent touches a ball.
    push: R,
    /// REACHED².
    pub(crate) reached2: R,
    /// 1 / REACHED.
    per_reached: R,
}

/// The two legs of an agent's way at one moment.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Legs<R> {
    /// Φ, minus the way left.
    pub(crate) potential: R,
    /// d_ab + d_bl.
    pub(crate) distance: R,
    /// d_bl².
    pub(crate) last2: R,
}

impl<R: Real> Law<R> {
    pub(crate) fn new(config: &PushBallConfig) -> Self {
        let reached = R::from_f64(REACHED);
        Self {
            progress: R::from_f64(f64::from(config.progress)),
            arc: R::from_f64(f64::from(config.turn_length)),
            bonus: R::from_f64(f64::from(config.bonus)),
            distance: R::from_f64(f64::from(config.distance)),
            push: R::from_f64(PUSH_DISTANCE),
            reached2: reached * reached,
            per_reached: R::from_f64(1.0 / REACHED),
        }
    }

    /// The legs, given as vectors agent → ball and ball → landmark.
    #[inline(always)]
    pub(crate) fn legs(&self, (ax, ay): (R, R), (bx, by): (R, R)) -> Legs<R> {
        let d_ab = ax.mul_add(ax, ay * ay).sqrt();
        let last2 = bx.mul_add(bx, by * by);
        let d_bl = last2.sqrt();
        let gap = d_ab - self.push;
        let gap = if gap > R::ZERO { gap } else { R::ZERO };
        let near = d_bl * self.per_reached;
        let near = if near < R::ONE { near } else { R::ONE };
        let (dot, cross) = (ax.mul_add(bx, ay * by), ax.mul_add(by, -(ay * bx)));
        let turn = self.arc * near * angle(dot, cross, d_ab * d_bl);
        let path = gap + turn;
        Legs { potential: -R::TWO.mul_add(d_bl, path), distance: d_ab + d_bl, last2 }
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
