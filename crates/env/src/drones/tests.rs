use super::model::State;
use super::world::{Crash, Drone, World};
use super::*;
use crate::controller::{Controller as _, DroneScript};
use crate::env::Env;
use crate::tasks::starts;
use magex_core::joint_state::JointState;
use magex_core::metrics_table::{
    ARRIVAL_STEP, COLLISION_RATE, MATCHED_SUCCESS_RATE, REWARD, SPAWN_SUCCESS_RATE, SUCCESS_RATE,
};
use magex_core::rng::{Key, Purpose};
use magex_core::task::{Downwash, Spawn, TaskName, TaskSettings};
use magex_core::trajectory::EpisodeMetrics;
use proptest::prelude::*;
use rapier3d::prelude::Vector;

mod collisions;

fn task(agents: usize) -> TaskConfig {
    TaskConfig::of(TaskName::Drones, agents, Spawn::Uniform)
}

fn set(task: &mut TaskConfig, change: impl FnOnce(&mut DroneConfig)) {
    let TaskSettings::Drones(settings) = &mut task.settings else { panic!("{task:?}") };
    change(settings);
}

fn stream(k: u32) -> Stream {
    Key::new(5, Purpose::Spawn, &[k]).stream()
}

type Drones = Env<Flight>;

fn assemble(task: &TaskConfig, starts: Starts) -> Result<Drones, FieldError> {
    let flight = Flight::new(task, &starts)?;
    Ok(Env::new(task, starts, Box::new(flight)))
}

fn new_env(task: &TaskConfig, streams: impl Iterator<Item = Stream>) -> Result<Drones, FieldError> {
    assemble(task, starts(task, streams, false)?)
}

fn from_state(
    task: &TaskConfig,
    positions: &[f32],
    velocities: &[f32],
    landmarks: &[f32],
) -> Result<Drones, FieldError> {
    assemble(task, Starts::given(task, [positions, velocities, landmarks])?)
}

/// One episode from a state, goals 0, 1, ...
fn episode(task: &TaskConfig, positions: &[[f32; 3]], velocities: &[[f32; 3]]) -> Drones {
    let landmarks: Vec<f32> = (0..positions.len()).flat_map(|k| [k as f32, 3.0, 1.5]).collect();
    let mut drones = from_state(task, positions.as_flattened(), velocities.as_flattened(), &landmarks).unwrap();
    let goals: Vec<u32> = (0..positions.len() as u32).collect();
    drones.set_goals(&goals).unwrap();
    drones
}

/// Everything that is seen after a step.
#[derive(Debug, Clone, PartialEq)]
struct Seen {
    positions: Vec<f32>,
    velocities: Vec<f32>,
    agent_state: Vec<f32>,
    rewards: Vec<f32>,
}

impl Seen {
    fn bits(&self) -> Vec<u32> {
        let all = [&self.positions, &self.velocities, &self.agent_state, &self.rewards];
        all.into_iter().flatten().map(|value| value.to_bits()).collect()
    }

    fn finite(&self) -> bool {
        [&self.positions, &self.velocities, &self.agent_state, &self.rewards]
            .into_iter()
            .flatten()
            .all(|v| v.is_finite())
    }
}

fn step(drones: &mut Drones, actions: &[u8]) -> Seen {
    let numbers = drones.rows();
    let mut seen = Seen {
        positions: vec![0.0; 3 * numbers],
        velocities: vec![0.0; 3 * numbers],
        agent_state: vec![0.0; 6 * numbers],
        rewards: vec![0.0; numbers],
    };
    drones.step(actions, &mut seen.rewards).unwrap();
    drones.write_positions(&mut seen.positions).unwrap();
    drones.write_velocities(&mut seen.velocities).unwrap();
    drones.write_agent_state(&mut seen.agent_state).unwrap();
    seen
}

fn crash(drones: &Drones, drone: usize) -> Option<Crash> {
    drones.rules.episodes[0].world.drones[drone].crash
}

const STOP: [u8; 3] = [1, 1, 1];

#[test]
fn a_drone_hovers_where_it_starts() {
    let mut drones = episode(&task(1), &[[0.2, -0.3, 1.5]], &[[0.0; 3]]);
    let seen = (0..120).map(|_| step(&mut drones, &STOP)).last().unwrap();
    // The engine's damping and the ground effect are small forces that a controller without an integral leaves standing.
    for (ours, start) in seen.positions.iter().zip([0.2, -0.3, 1.5]) {
        assert!((ours - start).abs() < 0.03, "{seen:?}");
    }
    assert_eq!(crash(&drones, 0), None);
}

#[test]
fn actions_move_the_target_velocity_and_the_drone_follows() {
    let mut drones = episode(&task(1), &[[0.0, 0.0, 1.5]], &[[0.0; 3]]);
    let seen = step(&mut drones, &[0, 1, 2]);
    let change = 5.0 / 30.0;
    for (target, expected) in seen.agent_state.iter().zip([change, 0.0, -change]) {
        assert!((target - expected).abs() < 1e-6, "{seen:?}");
    }
    // Twelve commands to full speed, and never beyond 2 m/s in all.
    let seen = (0..30).map(|_| step(&mut drones, &[0, 0, 1])).last().unwrap();
    let speed = |v: &[f32]| libm::sqrtf(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
    assert!((speed(&seen.agent_state[..3]) - 2.0).abs() < 1e-5, "{seen:?}");
    // The drag leaves a standing error.
    assert!((speed(&seen.velocities) - 2.0).abs() < 0.15, "{seen:?}");
    assert!(seen.velocities[0] > 1.0 && seen.velocities[1] > 1.0, "{seen:?}");
}

/// Flies `episodes` random episodes by the scripted pilot; mean success and collision rate.
fn scripted(task: &TaskConfig, episodes: u32) -> (Drones, [f32; 2]) {
    let mut drones = new_env(task, (0..episodes).map(stream)).unwrap();
    let n = task.agents;
    let goals: Vec<u32> = (0..episodes).flat_map(|_| 0..n as u32).collect();
    drones.set_goals(&goals).unwrap();
    let numbers = drones.rows();
    let statics = drones.statics().clone();
    let mut script = DroneScript::new(n);
    let (mut positions, mut velocities) = (vec![0.0; 3 * numbers], vec![0.0; 3 * numbers]);
    let (mut agent_state, mut actions) = (vec![0.0; 6 * numbers], vec![1; 3 * numbers]);
    for _ in 0..task.horizon {
        drones.write_positions(&mut positions).unwrap();
        drones.write_velocities(&mut velocities).unwrap();
        drones.write_agent_state(&mut agent_state).unwrap();
        let state = JointState {
            positions: &positions,
            velocities: &velocities,
            agent_state: &agent_state,
            world_states: &[],
            masks: &[],
            marks: &[],
            statics: statics.view(),
            goals: &goals,
        };
        script.act(&state, &mut actions).unwrap();
        drones.step(&actions, &mut vec![0.0; numbers]).unwrap();
    }
    let scores = drones.scores();
    let mean = |of: fn(&EpisodeMetrics) -> f32| scores.iter().map(of).sum::<f32>() / scores.len() as f32;
    let means = [mean(|score| score[SUCCESS_RATE]), mean(|score| score[COLLISION_RATE])];
    (drones, means)
}

#[test]
fn the_scripted_pilot_arrives_and_alone_never_crashes() {
    assert_eq!(scripted(&task(1), 200).1, [1.0, 0.0]);
    for n in [2, 4] {
        let (_, [success, collisions]) = scripted(&task(n), 200);
        println!("N = {n}: success {success}, collisions {collisions}");
        // It ignores other drones: a drone that does not arrive has crashed, or lost its landmark to a crash.
        assert!(success > 0.5 && success + collisions >= 0.95, "{n}: {success} {collisions}");
    }
}

#[test]
fn the_reference_downwash_shoots_down_a_drone_beside() {
    let weights = |above: f64, aside: f64| -Craft::CF2X.downwash(above, aside) / Craft::CF2X.weight();
    println!("weights: {:.1} {:.1} {:.1}", weights(5e-3, 0.3), weights(5e-3, 0.5), weights(1e-3, 0.5));
    assert!(weights(5e-3, 0.3) > 200.0 && weights(1e-3, 0.5) > 5.0);
    // Side by side at the spawn's least distance, one 5 mm higher.
    let fly = |downwash| {
        let mut task = task(2);
        set(&mut task, |d| d.downwash = downwash);
        let mut drones = episode(&task, &[[-0.15, 0.0, 1.5], [0.15, 0.0, 1.505]], &[[0.0; 3]; 2]);
        let fastest = (0..30).map(|_| step(&mut drones, &[1; 6]).velocities[2]).fold(0.0, f32::min);
        println!("{downwash:?}: fastest fall {fastest}, crash {:?}", crash(&drones, 0));
        (fastest, crash(&drones, 0))
    };
    let (fall, crash) = fly(Downwash::Reference);
    assert!(fall < -5.0 && crash == Some(Crash::Ground), "{fall} {crash:?}");
    for downwash in [Downwash::Limited, Downwash::Off] {
        let (fall, crash) = fly(downwash);
        assert!(fall > -1.0 && crash.is_none(), "{downwash:?}: {fall} {crash:?}");
    }
}

#[test]
fn crashes_are_counted_by_cause() {
    for downwash in [Downwash::Reference, Downwash::Limited, Downwash::Off] {
        let mut task = task(4);
        set(&mut task, |d| d.downwash = downwash);
        let (drones, [success, collisions]) = scripted(&task, 200);
        println!("{downwash:?}: success {success}, collisions {collisions}, {:?}", causes(&drones));
        assert!(success > 0.75 && collisions < 0.25, "{downwash:?}");
        let crashes: u32 = causes(&drones).values().sum();
        assert_eq!((collisions * 800.0).round() as u32, crashes);
    }
}

fn causes(drones: &Drones) -> std::collections::BTreeMap<String, u32> {
    let mut causes = std::collections::BTreeMap::new();
    for cause in drones.rules.episodes.iter().flat_map(|episode| &episode.world.drones).filter_map(|drone| drone.crash)
    {
        *causes.entry(format!("{cause:?}")).or_default() += 1;
    }
    causes
}

fn random_actions(n: usize) -> impl Strategy<Value = Vec<Vec<u8>>> {
    prop::collection::vec(prop::collection::vec(0..3u8, 3 * n), 1..40)
}

type Points = Vec<[f32; 3]>;

/// Positions in a small box (many meetings), velocities up to 2 m/s, and actions.
fn cases() -> impl Strategy<Value = (Points, Points, Vec<Vec<u8>>)> {
    (1..5usize).prop_flat_map(|n| {
        let position = [-0.4..0.4f32, -0.4..0.4f32, 0.1..0.5f32];
        let velocity = [-1.2..1.2f32, -1.2..1.2f32, -1.2..1.2f32];
        (prop::collection::vec(position, n), prop::collection::vec(velocity, n), random_actions(n))
    })
}

fn apart(positions: &[[f32; 3]], least: f32) -> bool {
    let near = |a: &[f32; 3], b: &[f32; 3]| (0..3).map(|d| (a[d] - b[d]).powi(2)).sum::<f32>() < least * least;
    positions.iter().enumerate().all(|(k, a)| positions[..k].iter().all(|b| !near(a, b)))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn rapier_and_the_free_step_give_the_same_bits((positions, velocities, actions) in cases()) {
        prop_assume!(apart(&positions, 0.14));
        let task = task(positions.len());
        let mut lazy = episode(&task, &positions, &velocities);
        let mut always = episode(&task, &positions, &velocities);
        always.rules.laws.always = true;
        for (k, actions) in actions.iter().enumerate() {
            let (a, b) = (step(&mut lazy, actions), step(&mut always, actions));
            prop_assert!(a.finite() && b.finite());
            // From a contact on, and be it one that rapier foresees and that then is none, its answer depends on what it
            // remembers of the pair.
            if lazy.scores()[0][COLLISION_RATE] > 0.0 || always.scores()[0][COLLISION_RATE] > 0.0 {
                break;
            }
            prop_assert_eq!(a.bits(), b.bits(), "command {}: {:?} {:?}", k, a, b);
        }
    }
}

#[test]
fn only_steep_tilts_cost() {
    let degrees = |angle: f64| libm::cos(angle.to_radians());
    assert_eq!((episode::steepness(1.0), episode::steepness(degrees(44.9))), (0.0, 0.0));
    assert!((episode::steepness(degrees(60.0)) - (1.0 - 0.5f64.sqrt())).abs() < 1e-12);
    assert!((episode::steepness(degrees(90.0)) - 1.0).abs() < 1e-12);
}

#[test]
fn the_reward_is_the_documented_sum() {
    let mut task = task(2);
    set(&mut task, |d| (d.downwash, d.proximity, d.proximity_radius) = (Downwash::Off, 1.0, 0.4));
    let positions = [[0.0, 0.0, 1.5], [0.3, 0.0, 1.5]];
    let landmarks = [0.0, 0.1, 1.5, 2.0, 0.0, 1.5];
    let mut drones = from_state(&task, positions.as_flattened(), &[0.0; 6], &landmarks).unwrap();
    drones.set_goals(&[0, 1]).unwrap();
    let (mut before, mut sum) = ([0.1, 1.7], 0.0);
    for _ in 0..5 {
        let seen = step(&mut drones, &[1, 1, 1, 0, 1, 1]);
        let place = |i: usize| -> [f64; 3] { std::array::from_fn(|d| f64::from(seen.positions[3 * i + d])) };
        let distance = |a: [f64; 3], b: [f64; 3]| linalg::norm(linalg::sub(a, b));
        let closeness = (1.0 - distance(place(0), place(1)) / 0.4).max(0.0);
        for (i, bonus) in [(0, 0.1), (1, 0.0)] {
            let goal: [f64; 3] = std::array::from_fn(|d| f64::from(landmarks[3 * i + d]));
            let now = distance(place(i), goal);
            let expected = 2.0 * (before[i] - now) + bonus - closeness;
            assert!((f64::from(seen.rewards[i]) - expected).abs() < 1e-6, "{i}: {seen:?} {expected}");
            (before[i], sum) = (now, sum + expected);
        }
    }
    let score = drones.scores()[0];
    assert!((f64::from(score[REWARD]) - sum / 10.0).abs() < 1e-6);
    assert_eq!((score[SUCCESS_RATE], score[MATCHED_SUCCESS_RATE], score[SPAWN_SUCCESS_RATE]), (0.5, 0.5, 0.5));
    assert_eq!((score[ARRIVAL_STEP], score[COLLISION_RATE]), (121.0, 0.0));
}

#[test]
fn two_landmarks_beside_one_drone_match_once() {
    let landmarks = [0.0, 0.1, 1.5, 0.0, -0.1, 1.5];
    let drones = from_state(&task(2), &[0.0, 0.0, 1.5, 2.0, 0.0, 1.5], &[0.0; 6], &landmarks).unwrap();
    let score = drones.scores()[0];
    assert_eq!((score[SUCCESS_RATE], score[MATCHED_SUCCESS_RATE], score[SPAWN_SUCCESS_RATE]), (1.0, 0.5, 1.0));
}

#[test]
fn mistakes_are_named() {
    let task = task(2);
    let text = |result: Result<(), FieldError>| result.unwrap_err().to_string();
    let mut drones = new_env(&task, std::iter::once(stream(1))).unwrap();
    assert!(text(drones.step(&[1; 6], &mut [0.0; 2])).contains("set_goals"));
    assert!(text(drones.set_goals(&[0, 2])).contains("goals[1]: 2"));
    assert!(text(drones.set_goals(&[0])).contains("goals: 1 entries"));
    drones.set_goals(&[0, 1]).unwrap();
    assert!(text(drones.step(&[1, 1, 1, 1, 3, 1], &mut [0.0; 2])).contains("actions[4]: 3"));
    assert!(text(drones.step(&[1; 5], &mut [0.0; 2])).contains("actions: 5"));
    assert!(text(drones.step(&[1; 6], &mut [0.0; 3])).contains("rewards: 3"));
    assert!(text(drones.write_agent_state(&mut [0.0; 11])).contains("agent_state"));
    assert_eq!(drones.steps, 0);
    let refused = |positions: &[f32]| from_state(&task, positions, &[0.0; 6], &[0.0; 6]).err().unwrap().to_string();
    assert!(refused(&[0.0; 5]).contains("positions"));
    assert!(refused(&[0.0, 0.0, f32::NAN, 0.0, 0.0, 0.0]).contains("positions[2]"));
    for (hz, word) in [(100, "multiple"), (90, "chatters"), (30, "chatters"), (1950, "1920")] {
        let mut task = task.clone();
        set(&mut task, |d| d.physics_hz = hz);
        let error = new_env(&task, std::iter::once(stream(1))).err().unwrap().to_string();
        assert!(error.contains("task.drones.physics_hz") && error.contains(word), "{error}");
    }
    let mut crowded = task.clone();
    set(&mut crowded, |d| d.spacing = 2.5);
    assert!(new_env(&crowded, std::iter::once(stream(1))).err().unwrap().to_string().contains("task.side"));
    let spread = TaskConfig::simple_spread(2, Spawn::Uniform);
    assert!(new_env(&spread, std::iter::once(stream(1))).err().unwrap().to_string().contains("task.name"));
}

#[test]
fn every_physics_rate_that_validates_flies() {
    for hz in [120, 150, 240, 480] {
        let mut task = task(1);
        set(&mut task, |d| d.physics_hz = hz);
        assert_eq!(scripted(&task, 20).1, [1.0, 0.0], "{hz}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn starts_keep_their_distance_and_stay_in_the_box(n in 1..9usize, k in 0..1000u32) {
        let task = task(n);
        let drones = new_env(&task, std::iter::once(stream(k))).unwrap();
        let mut positions = vec![0.0; 3 * n];
        drones.write_positions(&mut positions).unwrap();
        for points in [&positions[..], drones.statics().get(LANDMARKS)] {
            let points: Vec<[f32; 3]> = points.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect();
            prop_assert!(apart(&points, 0.3 - 1e-5));
            prop_assert!(points.iter().all(|p| p[0].abs() <= 1.5 && p[1].abs() <= 1.5 && p[2] == 1.5));
        }
    }

    #[test]
    fn an_episode_does_not_see_its_neighbours(k in 0..1000u32, actions in random_actions(6)) {
        let task = task(2);
        let mut together = new_env(&task, (k..k + 3).map(stream)).unwrap();
        together.set_goals(&[0, 1, 1, 0, 0, 0]).unwrap();
        let mut alone: Vec<_> = (k..k + 3).map(|k| new_env(&task, std::iter::once(stream(k))).unwrap()).collect();
        for (drones, goals) in alone.iter_mut().zip([[0, 1], [1, 0], [0, 0]]) {
            drones.set_goals(&goals).unwrap();
        }
        for actions in &actions {
            let all = step(&mut together, actions);
            for (b, drones) in alone.iter_mut().enumerate() {
                let own = step(drones, &actions[6 * b..6 * (b + 1)]);
                prop_assert_eq!(&all.positions[6 * b..6 * (b + 1)], &own.positions[..]);
                prop_assert_eq!(&all.agent_state[12 * b..12 * (b + 1)], &own.agent_state[..]);
                prop_assert_eq!(&all.rewards[2 * b..2 * (b + 1)], &own.rewards[..]);
            }
        }
        for (b, drones) in alone.iter().enumerate() {
            prop_assert_eq!(together.scores()[b], drones.scores()[0]);
        }
    }

    #[test]
    fn names_of_drones_do_not_matter_in_flight(shift in 1..4usize, actions in random_actions(4)) {
        let task = task(4);
        let positions = [[-1.0, 0.0, 1.5], [0.0, 0.1, 1.9], [0.2, 0.9, 1.6], [0.9, -0.9, 1.2]];
        let turn = |i: usize| (i + shift) % 4;
        let turned: Vec<[f32; 3]> = (0..4).map(|i| positions[turn(i)]).collect();
        let (mut a, mut b) = (episode(&task, &positions, &[[0.0; 3]; 4]), episode(&task, &turned, &[[0.0; 3]; 4]));
        for actions in actions.iter().take(8) {
            let permuted: Vec<u8> = (0..4).flat_map(|i| actions[3 * turn(i)..3 * turn(i) + 3].to_vec()).collect();
            let (a, b) = (step(&mut a, actions), step(&mut b, &permuted));
            for i in 0..4 {
                prop_assert_eq!(&b.positions[3 * i..3 * i + 3], &a.positions[3 * turn(i)..3 * turn(i) + 3]);
                prop_assert_eq!(&b.agent_state[6 * i..6 * i + 6], &a.agent_state[6 * turn(i)..6 * turn(i) + 6]);
            }
        }
    }

    #[test]
    fn a_mirrored_episode_is_the_mirror_image(actions in random_actions(2)) {
        let task = task(2);
        let mirror = |p: [f32; 3]| [p[0], -p[1], p[2]];
        let positions = [[-0.4, 0.2, 1.5], [0.3, 0.5, 1.7]];
        let (mut a, mut b) =
            (episode(&task, &positions, &[[0.0; 3]; 2]), episode(&task, &positions.map(mirror), &[[0.0; 3]; 2]));
        for actions in actions.iter().take(12) {
            let mut mirrored = actions.clone();
            for y in mirrored.iter_mut().skip(1).step_by(3) {
                *y = 2 - *y;
            }
            let (a, b) = (step(&mut a, actions), step(&mut b, &mirrored));
            for (a, b) in a.positions.chunks_exact(3).zip(b.positions.chunks_exact(3)) {
                for d in 0..3 {
                    let expected = if d == 1 { -a[d] } else { a[d] };
                    prop_assert!((b[d] - expected).abs() < 2e-5, "{a:?} {b:?}");
                }
            }
        }
    }
}
