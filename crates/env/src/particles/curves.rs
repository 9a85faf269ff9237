//! Lines and circles that points are laid out on.

use magex_core::rng::Stream;
use std::f64::consts::PI;

/// Number of layouts in a set.
pub(crate) const LAYOUTS: u8 = 4;

/// A straight line with its two ends, or a circle around the origin, that points are laid out on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Curve {
    Segment { from: [f64; 2], to: [f64; 2] },
    Circle { radius: f64 },
}

/// Curves and the number of points on each.
pub(crate) type Points = Vec<(Curve, usize)>;

impl Curve {
    /// The same curve, `factor` times as large.
    pub(crate) fn scaled(self, factor: f64) -> Self {
        match self {
            Self::Segment { from, to } => Self::Segment { from: from.map(|c| c * factor), to: to.map(|c| c * factor) },
            Self::Circle { radius } => Self::Circle { radius: radius * factor },
        }
    }

    /// Arc length.
    pub(crate) fn length(self) -> f64 {
        match self {
            Self::Segment { from, to } => libm::hypot(to[0] - from[0], to[1] - from[1]),
            Self::Circle { radius } => 2.0 * PI * radius,
        }
    }

    /// The point at an arc length from the first end (from angle −π, counter-clockwise).
    pub(crate) fn at(self, arc: f64) -> [f64; 2] {
        match self {
            Self::Segment { from, to } => {
                let t = arc / self.length();
                [0, 1].map(|k| from[k] + t * (to[k] - from[k]))
            }
            Self::Circle { radius } => {
                let angle = arc / radius - PI;
                [radius * libm::cos(angle), radius * libm::sin(angle)]
            }
        }
    }

    /// n equally spaced points in the authors' order: both ends of a segment, a circle ending at angle π.
    pub(crate) fn even(self, n: usize) -> impl Iterator<Item = [f64; 2]> {
        (0..n).map(move |k| self.at(self.even_arc(k, n)))
    }

    /// Arc length at which the k-th of n equally spaced points is.
    fn even_arc(self, k: usize, n: usize) -> f64 {
        let length = self.length();
        match self {
            Self::Segment { .. } if n == 1 => 0.5 * length,
            Self::Segment { .. } => length * k as f64 / (n - 1) as f64,
            Self::Circle { .. } => length * (k + 1) as f64 / n as f64,
        }
    }

    /// The k-th of n equally spaced points, moved along the curve by up to `share` of the way to its neighbours, and by no
    /// more than leaves moved neighbours `spacing` apart; the ends of a segment move inwards.
    pub(crate) fn jittered(self, (k, n): (usize, usize), share: f64, spacing: f64, stream: &mut Stream) -> [f64; 2] {
        let (length, even) = (self.length(), self.even_arc(k, n));
        let (gaps, spacing) = match self {
            Self::Segment { .. } => (n.saturating_sub(1).max(1), spacing),
            Self::Circle { radius } => (n, arc_of(spacing, radius)),
        };
        let gap = length / gaps as f64;
        let most = (share * gap).min(0.5 * (gap - spacing)).max(0.0);
        let arc = even + stream.range(-most, most);
        self.at(match self {
            Self::Circle { .. } => arc,
            Self::Segment { .. } if arc < 0.0 => -arc,
            Self::Segment { .. } if arc > length => 2.0 * length - arc,
            Self::Segment { .. } => arc,
        })
    }

    /// n random points in order along the curve, neighbours at least `spacing` apart where n such points fit.
    ///
    /// Stratified: what is left of the length when the spacings are taken out is cut into n equal cells, one point is
    /// uniform in each, and the spacings are put back in. Wherever there is room, this is one uniform point per equal
    /// cell of the curve; where the points fill the curve (50 landmarks on a line of length 10), they can barely move;
    /// where they do not fit, they are equally spaced.
    pub(crate) fn stratified(self, n: usize, spacing: f64, stream: &mut Stream) -> Vec<[f64; 2]> {
        let length = self.length();
        let (gaps, spacing, start) = match self {
            Self::Segment { .. } => (n.saturating_sub(1), spacing, 0.0),
            // The chord of two neighbours, not their arc, is to be `spacing`; a circle has no first point.
            Self::Circle { radius } => (n, arc_of(spacing, radius), stream.range(0.0, length)),
        };
        let spacing = if gaps == 0 { 0.0 } else { spacing.min(length / gaps as f64) };
        let cell = (length - spacing * gaps as f64) / n.max(1) as f64;
        (0..n).map(|k| self.at(start + spacing * k as f64 + cell * (k as f64 + stream.uniform()))).collect()
    }
}

/// The arc of a circle over a chord.
fn arc_of(chord: f64, radius: f64) -> f64 {
    2.0 * radius * libm::asin((0.5 * chord / radius).min(1.0))
}
