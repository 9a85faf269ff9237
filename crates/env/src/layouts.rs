//! The four layouts of the paper (figure 3b) as geometry, in the raw units of the authors' files.
//!
//! Agents stand on two lines or circles, landmarks on one or more; every curve carries its share of the points.
//! There is a small set (the authors use it for N = 20) and a large one (N = 50).

use magex_core::rng::Stream;
use magex_core::task::TaskConfig;
use std::f64::consts::PI;

/// Number of layouts in a set.
pub const LAYOUTS: u8 = 4;

/// A line that points are laid out on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Curve {
    /// A straight line with its two ends.
    Segment {
        /// First end.
        from: [f64; 2],
        /// Last end.
        to: [f64; 2],
    },
    /// A circle around the origin.
    Circle {
        /// Its radius.
        radius: f64,
    },
}

/// Curves and the number of points on each.
pub type Points = Vec<(Curve, usize)>;

/// Where the agents and the landmarks of one layout are.
#[derive(Debug, Clone, PartialEq)]
pub struct Layout {
    /// The paper's orange points; N in all.
    pub agents: Points,
    /// The paper's blue points; N in all.
    pub landmarks: Points,
}

/// The sizes that tell the two sets apart.
struct Set {
    /// Half the length of the agents' lines.
    half: f64,
    /// Height of the agents' lines in layouts 0 and 1.
    heights: [f64; 2],
    /// Radii of the agents' circles.
    circles: [f64; 2],
    /// Half the distance between the two landmark lines of layout 1, and half their length.
    columns: f64,
    /// Half the side of the landmarks' square; its corners are left free.
    square: f64,
    /// Radius of the landmarks' circle.
    circle: f64,
}

const SMALL: Set = Set { half: 4.0, heights: [4.0, 4.0], circles: [1.0, 5.0], columns: 2.0, square: 3.0, circle: 3.0 };
const LARGE: Set =
    Set { half: 10.0, heights: [6.0, 10.0], circles: [3.0, 10.0], columns: 6.0, square: 5.0, circle: 7.0 };
/// Free length at either end of a side of the square.
const CORNER: f64 = 0.3;

/// Largest N that uses the small set.
const SMALL_UP_TO: usize = 20;

/// Layout `index` (modulo 4) for N agents and landmarks, in raw units. Curves share N as evenly as they can, the
/// first ones taking the remainder.
pub fn layout(index: u8, n: usize) -> Layout {
    let set = if n <= SMALL_UP_TO { &SMALL } else { &LARGE };
    let index = index % LAYOUTS;
    let horizontal = |y: f64, half: f64| Curve::Segment { from: [-half, y], to: [half, y] };
    let vertical = |x: f64, half: f64| Curve::Segment { from: [x, -half], to: [x, half] };
    let agents = match index {
        0 | 1 => {
            let height = set.heights[usize::from(index)];
            vec![horizontal(height, set.half), horizontal(-height, set.half)]
        }
        _ => set.circles.map(|radius| Curve::Circle { radius }).to_vec(),
    };
    let landmarks = match index {
        0 => vec![horizontal(0.0, set.half)],
        1 => vec![vertical(-set.columns, set.columns), vertical(set.columns, set.columns)],
        2 => {
            let (side, half) = (set.square, set.square - CORNER);
            vec![horizontal(side, half), horizontal(-side, half), vertical(side, half), vertical(-side, half)]
        }
        _ => vec![Curve::Circle { radius: set.circle }],
    };
    Layout { agents: share(agents, n), landmarks: share(landmarks, n) }
}

fn share(curves: Vec<Curve>, n: usize) -> Points {
    let (each, more) = (n / curves.len(), n % curves.len());
    curves.into_iter().enumerate().map(|(k, curve)| (curve, each + usize::from(k < more))).collect()
}

/// World units per raw unit: the task's `layout_scale` for the authors' sizes (20 and 50), else whatever makes the
/// widest layout of the set as wide as the map.
pub fn scale(task: &TaskConfig) -> f64 {
    match task.agents {
        20 | 50 => 1.0 / f64::from(task.layout_scale),
        n => {
            let set = if n <= SMALL_UP_TO { &SMALL } else { &LARGE };
            f64::from(task.side) / (2.0 * set.half.max(set.circles[1]))
        }
    }
}

impl Curve {
    /// The same curve, `factor` times as large.
    pub fn scaled(self, factor: f64) -> Self {
        match self {
            Self::Segment { from, to } => Self::Segment { from: from.map(|c| c * factor), to: to.map(|c| c * factor) },
            Self::Circle { radius } => Self::Circle { radius: radius * factor },
        }
    }

    /// Arc length.
    pub fn length(self) -> f64 {
        match self {
            Self::Segment { from, to } => libm::hypot(to[0] - from[0], to[1] - from[1]),
            Self::Circle { radius } => 2.0 * PI * radius,
        }
    }

    /// The point at an arc length from the first end (from angle −π, counter-clockwise).
    pub fn at(self, arc: f64) -> [f64; 2] {
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
    pub fn even(self, n: usize) -> impl Iterator<Item = [f64; 2]> {
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
    pub fn jittered(self, (k, n): (usize, usize), share: f64, spacing: f64, stream: &mut Stream) -> [f64; 2] {
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
    pub fn stratified(self, n: usize, spacing: f64, stream: &mut Stream) -> Vec<[f64; 2]> {
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

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// "x y" per line.
    pub(crate) fn file(name: &str) -> Vec<[f64; 2]> {
        let path = format!("{}/testdata/maps/{name}", env!("CARGO_MANIFEST_DIR"));
        let text = std::fs::read_to_string(&path).unwrap();
        let number = |word: &str| word.parse::<f64>().unwrap();
        text.lines()
            .filter(|line| !line.trim().is_empty())
            .map(|line| {
                let words: Vec<f64> = line.split_whitespace().map(number).collect();
                [words[0], words[1]]
            })
            .collect()
    }

    #[test]
    fn the_geometry_reproduces_the_authors_files_in_order() {
        for n in [20, 50] {
            for index in 0..LAYOUTS {
                let layout = layout(index, n);
                for (kind, points) in [("map", &layout.agents), ("land", &layout.landmarks)] {
                    let ours: Vec<_> = points.iter().flat_map(|&(curve, n)| curve.even(n)).collect();
                    let theirs = file(&format!("{n}agent_simple_spread_{kind}_{index}.txt"));
                    assert_eq!(ours.len(), theirs.len());
                    for (a, b) in ours.iter().zip(&theirs) {
                        let error = (a[0] - b[0]).abs().max((a[1] - b[1]).abs());
                        assert!(error < 1e-8, "{n} {kind} {index}: {a:?} {b:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn every_size_gets_all_its_points() {
        for n in 1..=130 {
            for index in 0..LAYOUTS {
                let layout = layout(index, n);
                for points in [&layout.agents, &layout.landmarks] {
                    assert_eq!(points.iter().map(|(_, n)| n).sum::<usize>(), n);
                }
            }
        }
    }
}
