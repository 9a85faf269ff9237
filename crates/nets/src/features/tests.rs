use super::*;
use magex_core::config::{ExecutorConfig, ExecutorKind, Observes};
use magex_core::rng::{Key, Purpose, Stream};
use magex_core::statics::Statics;
use magex_core::task::{ActionCode, Spawn, TaskName};

fn spec(neighbours: usize, agents: usize) -> FeatureSpec {
    FeatureSpec::new(&TaskConfig::simple_spread(agents, Spawn::Uniform), true, neighbours, neighbours == 0)
}

/// Features of particle states whose episodes have these landmarks.
fn see(spec: &FeatureSpec, positions: &[f32], velocities: &[f32], landmarks: &[f32], goals: &[u32]) -> Features {
    let statics = Statics::landmarks(spec.shape.landmarks, 2, landmarks.to_vec());
    spec.compute(&JointState {
        positions,
        velocities,
        agent_state: &[],
        world_states: &[],
        masks: &[],
        marks: &[],
        statics: statics.view(),
        goals,
    })
}

#[test]
fn goal_features_are_translation_free_and_fade_at_the_goal() {
    let at = |x: f32, y: f32, gx: f32, gy: f32| see(&spec(0, 1), &[x, y], &[1.0, 0.0], &[gx, gy], &[0]).goals;
    assert_eq!(at(0.0, 0.0, 3.0, 4.0), at(1.0, 2.0, 4.0, 6.0));
    assert_eq!(at(0.0, 0.0, 3.0, 4.0), vec![0.5, 0.0, 0.6, 0.8, 0.5, 4.0 / 6.0, 0.0]);
    assert_eq!(at(0.0, 0.0, 0.0, 0.0), vec![0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]);
}

#[test]
fn neighbours_are_the_nearest_within_reach() {
    let positions = [0.0, 0.0, 0.5, 0.0, 0.0, 0.1, 3.0, 0.0, -0.9, 0.0];
    let features = see(&spec(2, 5), &positions, &[0.0; 10], &[0.0; 10], &[0; 5]);
    assert_eq!(features.counts, [2, 2, 2, 0, 2]);
    assert_eq!(features.neighbours[..10], [0.0, 0.1, 0.0, 0.0, 2.0, 0.5, 0.0, 0.0, 0.0, 0.4]);
}

#[test]
fn states_of_an_episode_share_its_landmarks_and_goals() {
    let landmarks = [1.0, 0.0, 0.0, 1.0, 5.0, 0.0, 0.0, 5.0];
    let zero = [0.0; 8];
    // Two states of one episode each, then the same two as one batch of two episodes.
    let spec = spec(0, 2);
    let first = see(&spec, &zero[..4], &zero[..4], &landmarks[..4], &[1, 0]);
    let second = see(&spec, &zero[..4], &zero[..4], &landmarks[4..], &[0, 1]);
    let both = see(&spec, &zero, &zero, &landmarks, &[1, 0, 0, 1]);
    assert_eq!(both.goals, [first.goals.clone(), second.goals].concat());
    let twice = see(&spec, &zero, &zero, &landmarks[..4], &[1, 0]);
    assert_eq!(twice.goals, [first.goals.clone(), first.goals].concat());
}

fn numbers(stream: &mut Stream, count: usize) -> Vec<f32> {
    (0..count).map(|_| 2.0 * stream.uniform32() - 1.0).collect()
}

#[test]
fn push_ball_looks_the_same_from_every_side() {
    let task = TaskConfig::of(TaskName::PushBall, 3, Spawn::Uniform);
    let spec = FeatureSpec::new(&task, true, 4, false);
    let mut stream = Key::new(1, Purpose::Bench, &[7]).stream();
    let goals = [2, 0, 0, 1, 1, 2];
    for _ in 0..50 {
        let (p, v, l) = (numbers(&mut stream, 12), numbers(&mut stream, 12), numbers(&mut stream, 6));
        let seen = see(&spec, &p, &v, &l, &goals);
        assert_eq!(seen.goals.len(), 3 * spec.goal_width());
        for turn in 0..8 {
            let map = |points: &[f32]| -> Vec<f32> {
                let turned = points.chunks_exact(2).flat_map(|c| {
                    let (x, y) = (if turn & 1 > 0 { -c[0] } else { c[0] }, if turn & 2 > 0 { -c[1] } else { c[1] });
                    if turn & 4 > 0 { [y, x] } else { [x, y] }
                });
                turned.collect()
            };
            let other = see(&spec, &map(&p), &map(&v), &map(&l), &goals);
            assert_eq!(other.counts, seen.counts);
            for (a, b) in other.goals.iter().zip(&seen.goals).chain(other.neighbours.iter().zip(&seen.neighbours)) {
                assert!((a - b).abs() < 1e-5, "turn {turn}: {a} is not {b}");
            }
            // The thrust that a policy chooses means the mirrored thrust in the mirrored world.
            for agent in 0..3 {
                let act = |features: &Features| {
                    let mut action = [1u8];
                    features.symmetries[agent].act(ActionCode::Thrust, &mut action);
                    let directions = [[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0f32]];
                    directions[usize::from(action[0])]
                };
                assert_eq!(map(&act(&seen)), act(&other).to_vec());
            }
        }
    }
}

#[test]
fn an_own_ball_is_no_neighbour_and_balls_are_marked() {
    let task = TaskConfig::of(TaskName::PushBall, 2, Spawn::Uniform);
    let spec = FeatureSpec::new(&task, true, 3, false);
    let positions = [0.0, 0.0, 1.0, 0.0, 0.3, 0.0, 0.0, 0.4];
    let landmarks = [3.0, 0.0, 0.0, 9.0];
    let features = see(&spec, &positions, &[0.0; 8], &landmarks, &[0, 0, 1, 1]);
    // Agent 0 owns the ball at (0.3, 0): it sees the other ball and the other agent.
    assert_eq!(features.counts, [2, 2]);
    let width = spec.neighbour_width();
    let kinds: Vec<f32> = (0..2).map(|slot| features.neighbours[slot * width + width - 1]).collect();
    assert_eq!(kinds, [1.0, 0.0]);
}

#[test]
fn a_drone_sees_its_closest_approach_and_no_drone_that_is_out() {
    let task = TaskConfig::of(TaskName::Drones, 3, Spawn::Uniform);
    let spec = FeatureSpec::new(&task, true, 4, true);
    let positions = [0.0, 0.0, 1.5, 1.0, 0.2, 1.5, 0.5, 0.0, 1.5];
    let velocities = [1.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    let mut agent_state = [0.0; 18];
    agent_state[17] = 1.0;
    let landmarks = Statics::landmarks(3, 3, vec![0.0; 9]);
    let states = JointState {
        positions: &positions,
        velocities: &velocities,
        agent_state: &agent_state,
        world_states: &[],
        masks: &[],
        marks: &[],
        statics: landmarks.view(),
        goals: &[0, 1, 2],
    };
    let features = spec.compute(&states);
    assert_eq!(features.counts, [1, 1, 0]);
    // Head on with an offset of 0.2: half a second ahead, they pass at 0.2.
    let seen = &features.neighbours[7..12];
    let expected = [0.0, 0.4, 0.0, 0.25, 0.6];
    assert!(seen.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-5), "{seen:?}");
    assert_eq!(features.nodes.len(), 3 * spec.node_width());
}

fn flat(task: &TaskConfig, nearest_first: bool, observes: Observes) -> FeatureSpec {
    let config = ExecutorConfig { kind: ExecutorKind::Flat, nearest_first, observes, ..ExecutorConfig::default() };
    crate::executor::feature_spec(&config, task)
}

#[test]
fn the_flat_vector_lists_what_it_says_by_index_or_nearest_first() {
    // Half side 2: lengths are halved.
    let task = TaskConfig { side: 4.0, ..TaskConfig::simple_spread(3, Spawn::Uniform) };
    let positions = [0.0, 0.0, 2.0, 0.0, 0.0, 1.0];
    let (velocities, landmarks) = ([1.0, -2.0, 0.0, 0.0, 0.0, 0.0], [2.0, 2.0, -1.0, 0.0, 0.0, 0.5]);
    let see = |nearest_first, observes| {
        let spec = flat(&task, nearest_first, observes);
        let features = see(&spec, &positions, &velocities, &landmarks, &[2, 0, 1]);
        assert_eq!(features.vectors.len(), 3 * spec.vector_width());
        assert_eq!((features.states.len(), features.goals.len()), (spec.state_width(), 0));
        features
    };
    let own = [0.5, -1.0, 0.0, 0.0];
    let (others, index) = ([1.0, 0.0, 0.0, 0.5], [1.0, 0.0, 0.0]);
    let by_index = see(false, Observes::Landmarks);
    let expected = [&own[..], &[1.0, 1.0, -0.5, 0.0, 0.0, 0.25], &others, &index].concat();
    assert_eq!(by_index.vectors[..17], expected);
    let nearest = see(true, Observes::Landmarks);
    let expected = [&own[..], &[0.0, 0.25, -0.5, 0.0, 1.0, 1.0], &[0.0, 0.5, 1.0, 0.0], &index].concat();
    assert_eq!(nearest.vectors[..17], expected);
    assert_eq!(nearest.states, by_index.states);
    let goal = see(false, Observes::Goals);
    assert_eq!(goal.vectors[..13], [&own[..], &[0.0, 0.25], &others, &index].concat());
    let state = [&[0.0, 0.0, 1.0, 0.0, 0.0, 0.5, 0.5, -1.0][..], &[0.0; 4], &[1.0, 1.0, -0.5, 0.0, 0.0, 0.25]].concat();
    assert_eq!(goal.states, state);
}

#[test]
fn chunks_of_flat_features_keep_their_states() {
    let task = TaskConfig::of(TaskName::PushBall, 2, Spawn::Uniform);
    let spec = flat(&task, true, Observes::Landmarks);
    let mut stream = Key::new(1, Purpose::Bench, &[8]).stream();
    let (positions, velocities) = (numbers(&mut stream, 3 * 8), numbers(&mut stream, 3 * 8));
    let landmarks = numbers(&mut stream, 4);
    let all = see(&spec, &positions, &velocities, &landmarks, &[0, 1, 1, 0]);
    let last = see(&spec, &positions[16..], &velocities[16..], &landmarks, &[0, 1, 1, 0]);
    let mut chunk = Features::default();
    chunk.append(&all, (4, 2), 6, 2);
    assert_eq!((chunk.vectors, chunk.states), (last.vectors, last.states));
}
