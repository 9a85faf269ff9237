//! Where the agents and landmarks of an episode start.

use super::layouts::{layout, scale};
use crate::particles::constants::CONTACT_DISTANCE;
use crate::particles::curves::{Curve, LAYOUTS, Points};
use crate::particles::placement::{flatten, uniform};
use magex_core::rng::Stream;
use magex_core::task::{Spawn, TaskConfig};

/// Agents start at least this far from each other, and so do landmarks, wherever they fit.
pub const SPACING: f64 = CONTACT_DISTANCE;

/// The start of an episode.
#[derive(Debug, Clone, PartialEq)]
pub struct Start {
    /// `[N, 2]`
    pub agents: Vec<f32>,
    /// `[N, 2]`
    pub landmarks: Vec<f32>,
}

/// Draws the start of an episode from its own stream.
pub fn spawn(task: &TaskConfig, stream: &mut Stream) -> Start {
    let pick = |fixed: Option<u8>, stream: &mut Stream| {
        layout(fixed.unwrap_or_else(|| stream.below(u32::from(LAYOUTS)) as u8), task.agents)
    };
    match task.spawn {
        Spawn::Uniform => {
            let agents = uniform(task.agents, task.side, SPACING, stream);
            Start { agents, landmarks: uniform(task.agents, task.side, SPACING, stream) }
        }
        Spawn::Lines(fixed) => {
            let layout = pick(fixed, stream);
            let scale = scale(task);
            let agents = on_lines(&layout.agents, scale, stream);
            Start { agents, landmarks: on_lines(&layout.landmarks, scale, stream) }
        }
        Spawn::Authors(fixed) => {
            let layout = pick(fixed, stream);
            let fixed =
                |points: &Points| flatten(points.iter().flat_map(|&(curve, n)| curve.scaled(scale(task)).even(n)));
            Start { agents: fixed(&layout.agents), landmarks: fixed(&layout.landmarks) }
        }
    }
}

/// Random points on the curves, in random order.
fn on_lines(points: &Points, scale: f64, stream: &mut Stream) -> Vec<f32> {
    let place = |&(curve, n): &(Curve, usize)| curve.scaled(scale).stratified(n, SPACING, stream);
    let mut all: Vec<[f64; 2]> = points.iter().flat_map(place).collect();
    stream.shuffle(&mut all);
    flatten(all.into_iter())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::particles::placement::lattice;
    use magex_core::rng::{Key, Purpose};

    fn stream(k: u32) -> Stream {
        Key::new(5, Purpose::Spawn, &[k]).stream()
    }

    fn closest(points: &[f32]) -> f64 {
        let point = |i: usize| [f64::from(points[2 * i]), f64::from(points[2 * i + 1])];
        let n = points.len() / 2;
        let pairs = (0..n).flat_map(|i| (i + 1..n).map(move |j| (point(i), point(j))));
        pairs.map(|(a, b)| libm::hypot(a[0] - b[0], a[1] - b[1])).fold(f64::INFINITY, f64::min)
    }

    #[test]
    fn uniform_points_keep_their_distance_and_stay_in_the_box() {
        for n in [1, 2, 5, 20, 50, 200, 1000] {
            let task = TaskConfig::simple_spread(n, Spawn::Uniform);
            for k in 0..20 {
                let start = spawn(&task, &mut stream(k));
                for points in [&start.agents, &start.landmarks] {
                    assert_eq!(points.len(), 2 * n);
                    assert!(closest(points) >= SPACING - 1e-6);
                    assert!(points.iter().all(|c| c.abs() <= task.side / 2.0));
                }
            }
        }
    }

    #[test]
    fn the_tightest_box_that_validates_is_still_filled() {
        for n in [1, 2, 3, 5, 17, 50, 300] {
            let mut task = TaskConfig::simple_spread(n, Spawn::Uniform);
            task.side = 1.001 * (n as f32 * std::f32::consts::PI * 0.01 / 0.27).sqrt();
            task.validate().unwrap();
            for k in 0..20 {
                assert!(closest(&spawn(&task, &mut stream(k)).agents) >= SPACING - 1e-6, "N = {n}");
            }
            let points = lattice(n, task.side, SPACING, &mut stream(0));
            assert_eq!(points.len(), 2 * n);
            assert!(closest(&points) >= SPACING - 1e-5, "N = {n}: {}", closest(&points));
            assert!(points.iter().all(|c| c.abs() <= task.side / 2.0));
        }
    }

    #[test]
    fn random_points_on_the_lines_keep_their_distance_and_lie_on_them() {
        for n in [20, 50] {
            for index in 0..LAYOUTS {
                let task = TaskConfig::simple_spread(n, Spawn::Lines(Some(index)));
                for k in 0..50 {
                    let start = spawn(&task, &mut stream(k));
                    let layout = layout(index, n);
                    for (points, curves) in [(&start.agents, &layout.agents), (&start.landmarks, &layout.landmarks)] {
                        assert!(closest(points) >= SPACING - 1e-5, "{n} {index}: {}", closest(points));
                        for point in points.chunks_exact(2) {
                            let point = [f64::from(point[0]), f64::from(point[1])];
                            let on = |curve: Curve| distance(curve.scaled(scale(&task)), point) < 1e-5;
                            assert!(curves.iter().any(|&(curve, _)| on(curve)), "{n} {index}: {point:?}");
                        }
                    }
                }
            }
        }
    }

    fn distance(curve: Curve, [x, y]: [f64; 2]) -> f64 {
        match curve {
            Curve::Circle { radius } => (libm::hypot(x, y) - radius).abs(),
            Curve::Segment { from, to } => {
                let clamp = |value: f64, a: f64, b: f64| value.clamp(a.min(b), a.max(b));
                libm::hypot(x - clamp(x, from[0], to[0]), y - clamp(y, from[1], to[1]))
            }
        }
    }

    #[test]
    fn random_points_are_spread_over_every_cell_of_a_roomy_line() {
        let line = Curve::Segment { from: [-5.0, 0.0], to: [5.0, 0.0] };
        let mut sum = [0.0; 10];
        for k in 0..2000 {
            let points = line.stratified(10, 0.2, &mut stream(k));
            for (i, point) in points.iter().enumerate() {
                let cell = (10.0 + 0.2) / 10.0;
                let inside = point[0] + 5.0 - cell * i as f64;
                assert!((0.0..=cell - 0.2).contains(&inside));
                sum[i] += inside / 2000.0;
            }
        }
        assert!(sum.iter().all(|mean| (mean - 0.41).abs() < 0.03), "{sum:?}");
    }

    #[test]
    fn the_authors_points_ignore_the_stream_and_scale_with_the_map() {
        let task = TaskConfig::simple_spread(50, Spawn::Authors(Some(1)));
        assert_eq!(spawn(&task, &mut stream(1)), spawn(&task, &mut stream(2)));
        assert_eq!(spawn(&task, &mut stream(1)).agents[..2], [-5.0, 5.0]);
        for n in [3, 5, 30, 100] {
            for index in 0..LAYOUTS {
                let task = TaskConfig::simple_spread(n, Spawn::Authors(Some(index)));
                let start = spawn(&task, &mut stream(1));
                assert!(start.agents.iter().chain(&start.landmarks).all(|c| c.abs() <= task.side / 2.0 + 1e-5));
            }
        }
    }

    #[test]
    fn a_start_depends_on_its_stream_alone() {
        for spawn_mode in [Spawn::Uniform, Spawn::Lines(None), Spawn::Authors(None)] {
            let task = TaskConfig::simple_spread(20, spawn_mode);
            assert_eq!(spawn(&task, &mut stream(3)), spawn(&task, &mut stream(3)));
            let distinct = (0..40).filter(|&k| spawn(&task, &mut stream(k)) != spawn(&task, &mut stream(3))).count();
            assert!(distinct >= 20, "{spawn_mode}");
        }
    }
}
