//! Bodies that meet, fall and are in the way: what rapier does with them, and what counts as a crash.

use super::*;
use magex_core::metrics_table::{COLLISION_RATE, REWARD};

/// No gravity, no damping, no effects: what is left is rapier.
fn vacuum(dt: f64) -> Laws {
    let craft = Craft { gravity: 0.0, linear_damping: 0.0, angular_damping: 0.0, ..Craft::CF2X };
    Laws::new(craft, Effects::default(), Downwash::Off, dt)
}

fn state(position: [f64; 3], velocity: [f64; 3]) -> State {
    State { position, attitude: [0.0, 0.0, 0.0, 1.0], velocity, spin: [0.0; 3] }
}

#[test]
fn a_head_on_collision_keeps_momentum_and_is_seen_in_its_step() {
    for (speed, hz) in [(0.5, 120.0), (1.0, 120.0), (2.0, 120.0), (2.0, 240.0), (1.37, 480.0)] {
        let laws = vacuum(1.0 / hz);
        let start = [state([-0.3, 0.01, 1.5], [speed, 0.0, 0.0]), state([0.3, -0.01, 1.5], [-speed, 0.0, 0.0])];
        let mut world = World::new(start.iter().map(Drone::at).collect());
        let mut seen = false;
        for _ in 0..(0.4 / speed * hz) as usize {
            let gap = |world: &World| {
                let d = world.drones[0].motion.pose.translation - world.drones[1].motion.pose.translation;
                libm::sqrtf(d.x * d.x + d.y * d.y) - 0.12
            };
            let before = gap(&world);
            world.step(&laws, &[[0.0; 4]; 2]);
            world.judge();
            // The step in which they would have met, had nothing held them.
            let meet = before - 2.0 * (speed / hz) as f32 <= 0.0;
            let crashed = world.drones[0].crash == Some(Crash::Contact);
            assert_eq!(world.drones[0].crash, world.drones[1].crash);
            if !seen && crashed {
                assert!(gap(&world) < 2e-3 && meet, "{speed} {hz}: {before} {}", gap(&world));
            }
            assert!(crashed || !meet || before > 1e-3, "{speed} {hz}: not seen at {before}");
            seen |= crashed;
            let momentum = world.drones[0].motion.linvel + world.drones[1].motion.linvel;
            assert!(momentum.length() < 1e-5, "{speed} {hz}: {momentum:?}");
        }
        assert!(seen);
        let after = world.drones[0].motion.linvel.x;
        assert!(after < 0.2 * speed as f32, "{speed} {hz}: goes on with {after}");
    }
}

#[test]
fn momentum_that_is_not_zero_is_kept_too() {
    let laws = vacuum(1.0 / 120.0);
    let start = [state([-0.3, 0.0, 1.5], [2.0, 0.1, 0.0]), state([0.3, 0.02, 1.5], [-0.5, 0.0, 0.0])];
    let mut world = World::new(start.iter().map(Drone::at).collect());
    for _ in 0..60 {
        world.step(&laws, &[[0.0; 4]; 2]);
        world.judge();
        let sum = world.drones[0].motion.linvel + world.drones[1].motion.linvel;
        assert!((sum - Vector::new(1.5, 0.1, 0.0)).length() < 1e-5, "{sum:?}");
    }
    assert_eq!(world.drones[0].crash, Some(Crash::Contact));
    assert!(world.drones[0].motion.linvel.x < 1.5 && world.drones[1].motion.linvel.x > 0.0, "they pushed each other");
}

#[test]
fn a_collision_is_the_same_in_the_mirror_and_under_other_names() {
    let laws = vacuum(1.0 / 120.0);
    let run = |states: [State; 2]| {
        let mut world = World::new(states.iter().map(Drone::at).collect());
        for _ in 0..40 {
            world.step(&laws, &[[0.0; 4]; 2]);
            world.judge();
        }
        assert_eq!(world.drones[0].crash, Some(Crash::Contact));
        [0, 1].map(|i| world.drones[i].motion.linvel)
    };
    let (a, b) = (([-0.3, 0.01, 1.5], [2.0, 0.0, 0.0]), ([0.3, 0.0, 1.503], [-1.0, 0.0, 0.0]));
    let flip = |(p, v): ([f64; 3], [f64; 3])| state([p[0], -p[1], p[2]], [v[0], -v[1], v[2]]);
    let plain = run([state(a.0, a.1), state(b.0, b.1)]);
    let mirrored = run([flip(a), flip(b)]);
    let renamed = run([state(b.0, b.1), state(a.0, a.1)]);
    for i in 0..2 {
        let mirror = Vector::new(mirrored[i].x, -mirrored[i].y, mirrored[i].z);
        // The engine's contact points are found iteratively: alike, not equal.
        assert!((plain[i] - mirror).length() < 0.05, "{plain:?} {mirrored:?}");
        assert!((plain[i] - renamed[1 - i]).length() < 0.05, "{plain:?} {renamed:?}");
    }
}

#[test]
fn drones_that_pass_through_each_other_within_a_step_have_met() {
    let laws = vacuum(1.0 / 120.0);
    // 58.3 mm per step: 4 mm apart before it, 4 mm apart after it.
    let start = [state([0.0, 0.0, 1.0292], [0.0, 0.0, -5.0]), state([0.03, 0.0, 1.0], [0.0, 0.0, 2.0])];
    let mut world = World::new(start.iter().map(Drone::at).collect());
    world.judge();
    assert_eq!(world.drones[0].crash, None);
    world.step(&laws, &[[0.0; 4]; 2]);
    world.judge();
    assert_eq!((world.drones[0].crash, world.drones[1].crash), (Some(Crash::Contact), Some(Crash::Contact)));
}

#[test]
fn rapier_does_not_put_a_hovering_drone_to_sleep() {
    // Beyond rapier's half a second of rest.
    let start = [[0.2, -0.3, 1.5], [0.2, 0.5, 1.5]];
    let mut task = task(2);
    set(&mut task, |d| d.downwash = Downwash::Off);
    let (mut lazy, mut always) = (episode(&task, &start, &[[0.0; 3]; 2]), episode(&task, &start, &[[0.0; 3]; 2]));
    always.rules.laws.always = true;
    for _ in 0..90 {
        assert_eq!(step(&mut lazy, &[1; 6]).bits(), step(&mut always, &[1; 6]).bits());
    }
    assert_eq!(step(&mut lazy, &[0; 6]).bits(), step(&mut always, &[0; 6]).bits());
}

#[test]
fn washes_add_up_in_an_order_that_does_not_depend_on_names() {
    let above = [[0.1, 0.0, 2.6], [-0.1, 0.11, 3.1], [0.0, -0.17, 3.7]];
    let fall = |order: [usize; 3]| {
        let positions: Vec<[f32; 3]> = std::iter::once([0.0, 0.0, 0.5]).chain(order.map(|k| above[k])).collect();
        let mut drones = episode(&task(4), &positions, &[[0.0; 3]; 4]);
        step(&mut drones, &[1; 12]).velocities[..3].to_vec()
    };
    let orders = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
    assert!(fall(orders[0])[2] < -1e-3);
    for order in orders {
        assert_eq!(fall(order), fall(orders[0]), "{order:?}");
    }
}

#[test]
fn a_drone_that_falls_crashes_on_the_ground_and_stays_there() {
    let mut drones = episode(&task(2), &[[0.0, 0.0, 0.3], [1.0, 0.0, 1.5]], &[[0.0, 0.0, -1.9], [0.0; 3]]);
    let mut down = [1; 6];
    down[2] = 2;
    let mut seen = step(&mut drones, &down);
    let mut commands = 1;
    while crash(&drones, 0).is_none() {
        assert!(seen.positions[2] > 0.0125 && commands < 20);
        seen = step(&mut drones, &down);
        commands += 1;
    }
    assert_eq!(crash(&drones, 0), Some(Crash::Ground));
    assert!(seen.rewards[0] < -9.0 && seen.agent_state[5] == 1.0, "{seen:?}");
    assert_eq!((seen.agent_state[0], seen.agent_state[1], seen.agent_state[2]), (0.0, 0.0, 0.0));
    for _ in 0..60 {
        seen = step(&mut drones, &down);
        assert_eq!(seen.rewards[0], 0.0);
        assert!(seen.positions[2] > 0.005, "{seen:?}");
    }
    assert!(drones.rules.episodes[0].world.drones[0].fixed, "{:?}", drones.rules.episodes[0].world.drones[0]);
    assert!((seen.positions[2] - 0.0125).abs() < 2e-3 && seen.velocities[2] == 0.0, "{seen:?}");
    assert_eq!(crash(&drones, 1), None);
    let score = drones.scores()[0];
    assert_eq!(score[COLLISION_RATE], 0.5);
}

#[test]
fn a_crashed_drone_is_still_in_the_way() {
    // The first one lies on the ground; the second one flies down onto it.
    let mut drones = episode(&task(2), &[[0.0, 0.0, 0.1], [0.02, 0.0, 1.0]], &[[0.0, 0.0, -1.9], [0.0; 3]]);
    for _ in 0..40 {
        step(&mut drones, &[1, 1, 2, 1, 1, 1]);
    }
    assert_eq!((crash(&drones, 0), crash(&drones, 1)), (Some(Crash::Ground), None));
    assert!(drones.rules.episodes[0].world.drones[0].fixed);
    for _ in 0..60 {
        step(&mut drones, &[1, 1, 1, 1, 1, 2]);
    }
    assert_eq!(crash(&drones, 1), Some(Crash::Contact));
}

#[test]
fn a_tilt_beyond_the_horizon_is_a_crash_in_its_step() {
    let laws = Laws::new(Craft::CF2X, Effects::default(), Downwash::Off, 1.0 / 120.0);
    let (sin, cos) = (libm::sin(0.75), libm::cos(0.75));
    let start = State { attitude: [sin, 0.0, 0.0, cos], spin: [2.0, 0.0, 0.0], ..state([0.0, 0.0, 5.0], [0.0; 3]) };
    let mut world = World::new(vec![Drone::at(&start)]);
    let mut steps = 0;
    while world.drones[0].crash.is_none() {
        assert!(linalg::Mat3::of(world.drones[0].state().attitude).0[2][2] >= 0.0 && steps < 20);
        world.step(&laws, &[[9440.3; 4]]);
        world.judge();
        steps += 1;
    }
    assert_eq!(world.drones[0].crash, Some(Crash::Tilt));
    // From 1.5 rad at 2 rad/s: the horizon is 0.0708 rad away, 4.2 steps.
    assert_eq!(steps, 5);
}

#[test]
fn a_state_that_is_not_finite_is_frozen_and_hurts_no_other_drone() {
    // The second one is within rapier's reach of the first.
    let positions = [[0.0, 0.0, 1.5], [0.126, 0.0, 1.5], [0.0, 0.6, 1.3]];
    let mut task = task(3);
    set(&mut task, |d| d.downwash = Downwash::Off);
    let mut drones = episode(&task, &positions, &[[0.0; 3]; 3]);
    step(&mut drones, &[1; 9]);
    let before = drones.rules.episodes[0].world.drones[0].motion.pose;
    drones.rules.episodes[0].spoil(0);
    for _ in 0..30 {
        let seen = step(&mut drones, &[1; 9]);
        assert!(seen.finite(), "{seen:?}");
        assert_eq!(drones.rules.episodes[0].world.drones[0].motion.pose, before);
    }
    assert_eq!(crash(&drones, 0), Some(Crash::NotFinite));
    assert_eq!((crash(&drones, 1), crash(&drones, 2)), (None, None));
    assert!(drones.scores()[0][REWARD].is_finite());
}
