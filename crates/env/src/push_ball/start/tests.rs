use super::*;
use crate::push_ball::layouts::Layout;
use magex_core::rng::{Key, Purpose};
use magex_core::task::{PushBallConfig, TaskName, TaskSettings};

fn stream(k: u32) -> Stream {
    Key::new(5, Purpose::Spawn, &[k]).stream()
}

fn lined_up(start_in_line_fraction: f32) -> TaskSettings {
    TaskSettings::PushBall(PushBallConfig { start_in_line_fraction, ..PushBallConfig::default() })
}

fn task(agents: usize, spawn: Spawn) -> TaskConfig {
    TaskConfig::of(TaskName::PushBall, agents, spawn)
}

/// The smallest distance between a point of `a` and another point of `b`.
fn closest(a: &[f32], b: &[f32]) -> f64 {
    let same = std::ptr::eq(a, b);
    let mut closest = f64::INFINITY;
    for (i, p) in a.chunks_exact(2).enumerate() {
        for q in b.chunks_exact(2).skip(if same { i + 1 } else { 0 }) {
            closest = closest.min(libm::hypot(f64::from(p[0] - q[0]), f64::from(p[1] - q[1])));
        }
    }
    closest
}

fn check_spacings(start: &Start, n: usize, what: &str) {
    for points in [&start.agents, &start.balls, &start.landmarks] {
        assert_eq!(points.len(), 2 * n, "{what}");
    }
    assert!(closest(&start.agents, &start.agents) >= 0.2 - 1e-5, "{what}: agents");
    assert!(closest(&start.balls, &start.balls) >= 0.3 - 1e-5, "{what}: balls");
    assert!(closest(&start.agents, &start.balls) >= 0.25 - 1e-5, "{what}: agents and balls");
}

#[test]
fn uniform_starts_keep_their_distances_and_stay_in_the_box() {
    for n in [1, 2, 3, 5, 20, 50, 200] {
        // The paper's side, and the smallest that validates.
        let mut tight = task(n, Spawn::Uniform);
        tight.side = 1.001 * (2.0 * n as f32 * std::f32::consts::PI * 0.0225 / 0.27).sqrt();
        tight.validate().unwrap();
        for task in [task(n, Spawn::Uniform), tight] {
            for k in 0..30 {
                for training in [false, true] {
                    let start = spawn(&task, training, &mut stream(k)).unwrap();
                    check_spacings(&start, n, &format!("N = {n}, side {}", task.side));
                    assert!(closest(&start.landmarks, &start.landmarks) >= 0.3 - 1e-5);
                    let all = [&start.agents[..], &start.balls, &start.landmarks].concat();
                    assert!(all.iter().all(|c| c.abs() <= task.side / 2.0));
                }
            }
        }
    }
}

#[test]
fn a_lattice_is_as_good_where_luck_runs_out() {
    for n in [1, 2, 3, 5, 20, 51, 200] {
        let side = 1.001 * (2.0 * n as f32 * std::f32::consts::PI * 0.0225 / 0.27).sqrt();
        let points = lattice(2 * n, side, SPACING, &mut stream(0));
        assert!(closest(&points, &points) >= 0.3 - 1e-5 && points.iter().all(|c| c.abs() <= side / 2.0), "N = {n}");
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

fn on_curves(points: &[f32], curves: &Points, scale: f64) -> bool {
    points.chunks_exact(2).all(|point| {
        let point = [f64::from(point[0]), f64::from(point[1])];
        curves.iter().any(|&(curve, _)| distance(curve.scaled(scale), point) < 1e-5)
    })
}

#[test]
fn points_on_the_lines_keep_their_distances_and_lie_on_them() {
    for n in [1, 2, 3, 5, 9, 20, 21, 50, 75, 120] {
        for index in 0..LAYOUTS {
            for mode in [Spawn::Lines(Some(index)), Spawn::Authors(Some(index))] {
                let task = task(n, mode);
                let Layout { slots, balls } = layout(index, n);
                for k in 0..40 {
                    let start = spawn(&task, false, &mut stream(k)).unwrap();
                    check_spacings(&start, n, &format!("N = {n}, {mode}"));
                    let scale = scale(&task);
                    let (points, curves) = ([&start.agents[..], &start.landmarks].concat(), &slots);
                    assert!(on_curves(&points, curves, scale) && on_curves(&start.balls, &balls, scale));
                }
            }
        }
    }
}

fn sorted(points: &[f32]) -> Vec<[u32; 2]> {
    let mut points: Vec<_> = points.chunks_exact(2).map(|p| [p[0].to_bits(), p[1].to_bits()]).collect();
    points.sort_unstable();
    points
}

#[test]
fn the_authors_points_are_even_and_split_at_random() {
    for n in [20, 50] {
        for index in 0..LAYOUTS {
            let task = task(n, Spawn::Authors(Some(index)));
            let even = |points: &Points| -> Vec<f32> {
                let points = points.iter().flat_map(|&(curve, n)| curve.scaled(2.0).even(n));
                points.flatten().map(|c| c as f32).collect()
            };
            let layout = layout(index, n);
            let start = |k| spawn(&task, false, &mut stream(k)).unwrap();
            let (one, two) = (start(1), start(2));
            for start in [&one, &two] {
                let slots = [&start.agents[..], &start.landmarks].concat();
                assert_eq!(sorted(&slots), sorted(&even(&layout.slots)));
                assert_eq!(sorted(&start.balls), sorted(&even(&layout.balls)));
            }
            assert_ne!(sorted(&one.agents), sorted(&two.agents));
            assert_ne!(one.balls, two.balls);
        }
    }
    // Agents exactly above or below balls: the starts that training prepares for.
    let start = spawn(&task(20, Spawn::Authors(Some(0))), false, &mut stream(1)).unwrap();
    let below = |agent: &[f32]| start.balls.chunks_exact(2).any(|ball| ball[0] == agent[0]);
    assert!(start.agents.chunks_exact(2).all(below));
}

#[test]
fn jittered_points_use_their_room() {
    let task = task(20, Spawn::Lines(Some(0)));
    let gap = 12.0 / 19.0;
    let most = (0.5f64 * (gap - 0.3)).min(0.3 * gap);
    let (mut furthest, mut sum) = (0.0f64, 0.0);
    for k in 0..200 {
        for x in spawn(&task, false, &mut stream(k)).unwrap().balls.iter().step_by(2) {
            let place = (f64::from(*x) + 6.0) / gap;
            let moved = gap * (place - place.round()).abs();
            furthest = furthest.max(moved);
            sum += moved / 4000.0;
        }
    }
    assert!(furthest <= most + 1e-5 && furthest > 0.98 * most, "{furthest} of {most}");
    assert!((sum - 0.5 * most).abs() < 0.02 * most, "{sum}");
}

/// Agents exactly in line with their ball, whose landmark is on the same side.
fn in_line(start: &Start) -> usize {
    let between = |axis: usize, agent: &[f32], ball: &[f32], landmark: &[f32]| {
        ball[1 - axis] == agent[1 - axis] && (agent[axis] > ball[axis]) == (landmark[axis] > ball[axis])
    };
    let points = |all: &[f32]| -> Vec<[f32; 2]> { all.chunks_exact(2).map(|c| [c[0], c[1]]).collect() };
    let triples = points(&start.agents).into_iter().zip(points(&start.balls)).zip(points(&start.landmarks));
    triples.filter(|((a, b), l)| between(0, a, b, l) || between(1, a, b, l)).count()
}

#[test]
fn training_puts_agents_in_the_way_of_their_balls_as_often_as_asked() {
    for mode in [Spawn::Uniform, Spawn::Lines(None)] {
        for aligned in [0.0, 0.3, 1.0] {
            let mut task = task(if mode == Spawn::Uniform { 5 } else { 20 }, mode);
            task.settings = lined_up(aligned);
            let (mut episodes, mut agents) = (0, 0);
            for k in 0..1000 {
                let plain = spawn(&task, false, &mut stream(k)).unwrap();
                let start = spawn(&task, true, &mut stream(k)).unwrap();
                assert_eq!(plain.balls, start.balls);
                check_spacings(&start, task.agents, "in line");
                let changed = plain != start;
                episodes += usize::from(changed);
                agents += if changed { in_line(&start) } else { 0 };
            }
            let share = episodes as f32 / 1000.0;
            assert!((share - aligned).abs() < 0.05, "{mode} {aligned}: {share}");
            assert!(agents as f32 >= 0.9 * (episodes * task.agents) as f32, "{mode}: {agents} of {episodes}");
        }
    }
}

#[test]
fn evaluation_starts_ignore_what_is_for_training() {
    for mode in [Spawn::Uniform, Spawn::Lines(None), Spawn::Authors(None)] {
        let plain = task(20, mode);
        let mut other = plain.clone();
        other.settings = lined_up(1.0);
        for k in 0..20 {
            assert_eq!(spawn(&plain, false, &mut stream(k)).unwrap(), spawn(&other, false, &mut stream(k)).unwrap());
        }
    }
}

#[test]
fn a_start_depends_on_its_stream_alone() {
    for mode in [Spawn::Uniform, Spawn::Lines(None), Spawn::Authors(None)] {
        let task = task(20, mode);
        assert_eq!(spawn(&task, true, &mut stream(3)).unwrap(), spawn(&task, true, &mut stream(3)).unwrap());
        assert!(
            (0..40)
                .filter(|&k| spawn(&task, true, &mut stream(k)).unwrap() != spawn(&task, true, &mut stream(3)).unwrap())
                .count()
                == 39
        );
    }
}
