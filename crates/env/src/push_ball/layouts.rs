//! The four Push Ball layouts of the paper (figure 3b) as geometry, in the raw units of the authors' files.
//!
//! Agents and landmarks share 2N slots on two lines or circles; N balls stand on one between or across them. There is a
//! small set (the authors use it for N = 20) and a large one (N = 50).

use super::constants::SPACING;
use crate::particles::curves::{Curve, Points};
use magex_core::task::TaskConfig;

/// Where the agents, the landmarks and the balls of one layout are.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Layout {
    /// The paper's orange points, for agents and landmarks; 2N in all.
    pub(super) slots: Points,
    /// The paper's pink points; N in all.
    pub(super) balls: Points,
}

/// The sizes that tell the two sets apart.
struct Set {
    half: f64,
    /// Height of the slots' lines in layouts 0, 1 and 3.
    heights: [f64; 3],
    circles: [f64; 2],
    /// Share of the slots that is on the inner circle.
    inner: f64,
    circle: f64,
}

const SMALL: Set = Set { half: 3.0, heights: [2.0, 1.5, 3.0], circles: [1.0, 3.0], inner: 0.25, circle: 2.0 };
const LARGE: Set = Set { half: 6.0, heights: [4.0, 3.0, 6.0], circles: [1.0, 5.0], inner: 0.3, circle: 3.0 };

/// Largest N that uses the small set.
const SMALL_UP_TO: usize = 20;

fn set(n: usize) -> &'static Set {
    if n <= SMALL_UP_TO { &SMALL } else { &LARGE }
}

/// Layout `index` (modulo 4) for N agents, balls and landmarks, in raw units.
pub(super) fn layout(index: u8, n: usize) -> Layout {
    let set = set(n);
    let horizontal = |y: f64| Curve::Segment { from: [-set.half, y], to: [set.half, y] };
    let lines = |height: f64| vec![(horizontal(height), n), (horizontal(-height), n)];
    let column = vec![(Curve::Segment { from: [0.0, -set.half], to: [0.0, set.half] }, n)];
    let (slots, balls) = match index % 4 {
        0 => (lines(set.heights[0]), vec![(horizontal(0.0), n)]),
        1 => (lines(set.heights[1]), column),
        2 => {
            let inner = (2.0 * n as f64 * set.inner) as usize;
            let circles = set.circles.map(|radius| Curve::Circle { radius });
            let slots = circles.into_iter().zip([inner, 2 * n - inner]).collect();
            (slots, vec![(Curve::Circle { radius: set.circle }, n)])
        }
        _ => (lines(set.heights[2]), column),
    };
    Layout { slots, balls }
}

/// World units per raw unit: the task's `layout_scale` for the authors' sizes (20 and 50), else whatever makes the lines
/// as long as the map, and long enough for the balls to stand apart.
pub(super) fn scale(task: &TaskConfig) -> f64 {
    match task.agents {
        20 | 50 => 1.0 / f64::from(task.layout_scale),
        n => f64::from(task.side).max(SPACING * n as f64) / (2.0 * set(n).half),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// "x y" per line, in the order of x, then y: the authors' rows are shuffled.
    fn sorted(mut points: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
        let rounded = |c: f64| (c * 1e6).round() as i64;
        points.sort_by_key(|&[x, y]| (rounded(x), rounded(y)));
        points
    }

    #[test]
    fn the_geometry_reproduces_the_authors_files() {
        for n in [20, 50] {
            for index in 0..4 {
                let layout = layout(index, n);
                for (kind, points) in [("map", &layout.slots), ("ball", &layout.balls)] {
                    let ours = sorted(points.iter().flat_map(|&(curve, n)| curve.even(n)).collect());
                    let theirs =
                        sorted(crate::spread::layouts::tests::file(&format!("{n}agent_push_ball_{kind}_{index}.txt")));
                    assert_eq!(ours.len(), theirs.len());
                    for (a, b) in ours.iter().zip(&theirs) {
                        let error = (a[0] - b[0]).abs().max((a[1] - b[1]).abs());
                        assert!(error < 1e-7, "{n} {kind} {index}: {a:?} {b:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn every_size_gets_all_its_points() {
        for n in 1..=130 {
            for index in 0..4 {
                let layout = layout(index, n);
                let count = |points: &Points| points.iter().map(|(_, n)| n).sum::<usize>();
                assert_eq!((count(&layout.slots), count(&layout.balls)), (2 * n, n));
            }
        }
    }
}
