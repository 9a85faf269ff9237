use super::*;
use crate::particles::batch::Batch;
use crate::particles::cells::Cells;
use crate::particles::physics::Pairs;
use crate::particles::real::Real;
use crate::rules::{Rules as _, Starts};
use magex_core::rng::{Key, Purpose, Stream};
use magex_core::task::Spawn;

fn stream(k: u32) -> Stream {
    Key::new(11, Purpose::Instances, &[k]).stream()
}

/// Crowded random states `[worlds, N, 2]`: agents everywhere within a box that makes most of them touch.
fn crowd<R: Real>(worlds: usize, agents: usize, side: f64, stream: &mut Stream) -> [Vec<R>; 3] {
    let mut draw = |side: f64| -> Vec<R> {
        (0..2 * worlds * agents).map(|_| R::from_f64(stream.range(-0.5 * side, 0.5 * side))).collect()
    };
    [draw(side), draw(3.0), draw(side)]
}

fn actions(count: usize, stream: &mut Stream) -> Vec<u8> {
    (0..count).map(|_| stream.below(5) as u8).collect()
}

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|v| v.to_bits()).collect()
}

/// Everything an episode produces, bit by bit.
fn run<const W: usize>(task: &TaskConfig, state: &[Vec<f32>; 3], steps: &[Vec<u8>], cells: bool) -> Vec<Vec<u32>> {
    let [positions, velocities, landmarks] = state;
    let starts = Starts::given(task, [positions, velocities, landmarks]).unwrap();
    let mut batch = Batch::<W, SpreadObjective<W>>::new(task, &starts, cells).unwrap();
    let goals: Vec<u32> = (0..batch.swarm.worlds()).flat_map(|_| 0..task.agents as u32).collect();
    batch.set_goals(&goals);
    let mut log = Vec::new();
    for (t, actions) in steps.iter().enumerate() {
        let mut rewards = vec![0.0; actions.len()];
        batch.step(t as u32 + 1, &goals, actions, &mut rewards);
        let mut state = vec![0.0; 2 * actions.len()];
        log.push(bits(&rewards));
        batch.swarm.write_positions(&mut state);
        log.push(bits(&state));
        batch.swarm.write_velocities(&mut state);
        log.push(bits(&state));
    }
    for world in 0..batch.swarm.worlds() {
        let (reward, hits) = (batch.reward_sum[world / W][world % W], batch.hit_sum[world / W][world % W]);
        log.push(bits(&[reward as f32, hits as f32]));
        log.push(vec![batch.arrivals.step(world).unwrap_or(0)]);
        log.push(batch.objective.near(&batch.swarm, world).concat());
    }
    log
}

#[test]
fn cells_and_lanes_give_the_same_bits() {
    for (agents, side) in [(1, 1.0), (2, 0.3), (7, 1.0), (40, 2.0), (150, 5.0), (300, 12.0), (300, 60.0)] {
        let mut task = TaskConfig::simple_spread(agents, Spawn::Uniform);
        task.side = 8.0; // bodies inside and outside the grid
        let mut stream = stream(agents as u32);
        let state = crowd(1, agents, side, &mut stream);
        let steps: Vec<_> = (0..25).map(|_| actions(agents, &mut stream)).collect();
        let all_pairs = run::<16>(&task, &state, &steps, false);
        assert_eq!(all_pairs, run::<1>(&task, &state, &steps, true), "N = {agents}: cells");
        assert_eq!(all_pairs, run::<1>(&task, &state, &steps, false), "N = {agents}: one lane");
    }
}

#[test]
fn cells_find_every_pair_once_even_far_outside_the_grid() {
    let mut stream = stream(3);
    for _ in 0..200 {
        let n = 2 + stream.below(60) as usize;
        let side = stream.range(0.1, 30.0);
        let mut draw = || (0..n).map(|_| stream.range(-side, side)).collect::<Vec<f64>>();
        let (x, y) = (draw(), draw());
        let mut cells = Cells::new(n, 10.0, 0.236);
        cells.sort(&x, &y);
        let mut found = Pairs::new();
        cells.pairs(0.236 * 0.236, &mut found);
        let near = |&(i, j): &(usize, usize)| {
            (x[i] - x[j]).mul_add(x[i] - x[j], (y[i] - y[j]) * (y[i] - y[j])) < 0.236 * 0.236
        };
        let all = (0..n).flat_map(|i| (i + 1..n).map(move |j| (i, j)));
        let expected: Vec<u32> = all.filter(near).map(|(i, j)| crate::particles::physics::pack(i, j)).collect();
        assert_eq!(found, expected);
    }
}

/// One step of one world in f64 without control: the change of the velocities beyond damping.
fn kicks(positions: &[f64]) -> Vec<f64> {
    let agents = positions.len() / 2;
    let kinds = Alike(Pair::equal(&Physics::standard(), CONTACT_DISTANCE));
    let rest = vec![0.0; positions.len()];
    let mut swarm =
        Swarm::<f64, 4, _>::new(Physics::standard(), kinds, (agents, agents), [positions, &rest, positions], None);
    swarm.step(0, &vec![0; agents]);
    let mut velocities = vec![0.0; positions.len()];
    swarm.write_velocities(&mut velocities);
    velocities
}

#[test]
fn contacts_conserve_momentum() {
    let mut stream = stream(5);
    for _ in 0..50 {
        let [positions, ..] = crowd::<f64>(1, 12, 0.8, &mut stream);
        let kicks = kicks(&positions);
        for axis in 0..2 {
            let sum: f64 = kicks.iter().skip(axis).step_by(2).sum();
            let size: f64 = kicks.iter().map(|v| v.abs()).sum();
            assert!(size > 0.1 && sum.abs() < 1e-14 * size, "{sum:e} of {size}");
        }
    }
}

#[test]
fn a_pair_repels_along_its_line_of_centres_by_the_formula() {
    for d in [1e-9, 0.01, 0.1, 0.199, 0.2, 0.201, 0.21, 0.23, 0.24, 1.0] {
        let (c, s) = (0.6, 0.8);
        let kicks = kicks(&[d * c, d * s, 0.0, 0.0]);
        let z: f64 = -(d - 0.2) / 1e-3;
        let kick = 0.1 * 100.0 * 1e-3 * (z.max(0.0) + libm::log1p(libm::exp(-z.abs())));
        for (got, expected) in kicks.iter().zip([kick * c, kick * s, -kick * c, -kick * s]) {
            assert!((got - expected).abs() < 1e-14, "d = {d}: {got} {expected}");
        }
    }
}

#[test]
fn coincident_agents_part_along_x() {
    let kicks = kicks(&[0.3, 0.3, 0.3, 0.3, 5.0, 5.0]);
    assert!(kicks[0] > 0.0 && kicks[2] == -kicks[0], "{kicks:?}");
    assert_eq!([kicks[1], kicks[3], kicks[4], kicks[5]], [0.0; 4]);
}

#[test]
fn shifting_or_renaming_the_agents_changes_nothing_but_rounding() {
    let mut stream = stream(7);
    for _ in 0..50 {
        let n = 10;
        let [positions, ..] = crowd::<f64>(1, n, 0.8, &mut stream);
        let base = kicks(&positions);
        let close = |a: &[f64], b: &[f64], what: &str| {
            assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12), "{what}: {a:?} {b:?}");
        };
        let shifted: Vec<f64> = positions.iter().enumerate().map(|(k, p)| p + [3.25, -1.5][k % 2]).collect();
        close(&kicks(&shifted), &base, "shifted");
        let order = stream.permutation(n);
        let permuted = |values: &[f64]| -> Vec<f64> {
            order.iter().flat_map(|&i| [values[2 * i as usize], values[2 * i as usize + 1]]).collect()
        };
        close(&kicks(&permuted(&positions)), &permuted(&base), "renamed");
    }
}
