//! The four layouts of the paper (figure 3b) as geometry, in the raw units of the authors' files.
//!
//! Agents stand on two lines or circles, landmarks on one or more; every curve carries its share of the points.
//! There is a small set (the authors use it for N = 20) and a large one (N = 50).

use crate::particles::curves::{Curve, LAYOUTS, Points};
use magex_core::task::TaskConfig;

/// Where the agents and the landmarks of one layout are.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Layout {
    /// The paper's orange points; N in all.
    pub(super) agents: Points,
    /// The paper's blue points; N in all.
    pub(super) landmarks: Points,
}

/// The sizes that tell the two sets apart.
struct Set {
    half: f64,
    /// Height of the agents' lines in layouts 0 and 1.
    heights: [f64; 2],
    circles: [f64; 2],
    /// Half the distance between the two landmark lines of layout 1, and half their length.
    columns: f64,
    /// Half the side of the landmarks' square; its corners are left free.
    square: f64,
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
pub(super) fn layout(index: u8, n: usize) -> Layout {
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
pub(super) fn scale(task: &TaskConfig) -> f64 {
    match task.agents {
        20 | 50 => 1.0 / f64::from(task.layout_scale),
        n => {
            let set = if n <= SMALL_UP_TO { &SMALL } else { &LARGE };
            f64::from(task.side) / (2.0 * set.half.max(set.circles[1]))
        }
    }
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
