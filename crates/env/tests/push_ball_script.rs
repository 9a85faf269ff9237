//! The yardstick of Push Ball: a controller that looks six steps ahead, given the exact assignments, solves every size of
//! the paper inside the horizon.

// Helpers of tests; the lint's exception covers test functions only.
#![allow(clippy::unwrap_used)]

#[path = "shared/assign.rs"]
mod assign;

use assign::exact;
use magex_core::joint_state::JointState;
use magex_core::metrics_table::{MATCHED_SUCCESS_RATE, SUCCESS_RATE};
use magex_core::rng::{Key, Purpose};
use magex_core::statics::{LANDMARKS, Statics};
use magex_core::task::{Spawn, TaskConfig, TaskName};
use magex_core::trajectory::EpisodeMetrics;
use magex_env::controller::PushBallScript;
use magex_env::{Controller as _, new_env};

fn play(task: &TaskConfig, episodes: u32) -> Vec<EpisodeMetrics> {
    let n = task.agents;
    let streams = (0..episodes).map(|episode| Key::new(9, Purpose::EvalSpawn, &[1, episode]).stream());
    let mut env = new_env(task, streams, false).unwrap();
    let statics = env.statics().clone();
    let landmarks = env.statics().get(LANDMARKS);
    let mut script = PushBallScript::new(n);
    let (mut positions, mut velocities) = (env.positions(), env.velocities());
    let mut goals = Vec::new();
    for (bodies, landmarks) in positions.chunks_exact(4 * n).zip(landmarks.chunks_exact(2 * n)) {
        let (agents, balls) = bodies.split_at(2 * n);
        let (ball_of, landmark_of) = (exact(agents, balls), exact(balls, landmarks));
        goals.extend(ball_of.iter().flat_map(|&ball| [ball, landmark_of[ball as usize]]));
    }
    env.set_goals(&goals).unwrap();
    let mut actions = vec![0; n * episodes as usize];
    let mut rewards = vec![0.0; actions.len()];
    for _ in 0..task.horizon {
        env.write_positions(&mut positions).unwrap();
        env.write_velocities(&mut velocities).unwrap();
        let state = JointState {
            positions: &positions,
            velocities: &velocities,
            agent_state: &[],
            world_states: &[],
            masks: &[],
            marks: &[],
            statics: statics.view(),
            goals: &goals,
        };
        script.act(&state, &mut actions).unwrap();
        env.step(&actions, &mut rewards).unwrap();
    }
    env.scores()
}

fn mean(scores: &[EpisodeMetrics], value: fn(&EpisodeMetrics) -> f32) -> f32 {
    scores.iter().map(value).sum::<f32>() / scores.len() as f32
}

fn check(agents: usize, spawn: Spawn, episodes: u32, at_least: f32) {
    let task = TaskConfig::of(TaskName::PushBall, agents, spawn);
    let scores = play(&task, episodes);
    let success = mean(&scores, |score| score[SUCCESS_RATE]);
    assert!(success >= at_least, "{agents} {spawn}: success {success}");
    // What counts is nearly always the ball that was meant.
    assert!(mean(&scores, |score| score[MATCHED_SUCCESS_RATE]) >= at_least - 0.02, "{agents} {spawn}");
}

#[test]
fn uniform_starts_are_solved() {
    check(5, Spawn::Uniform, 40, 0.98);
    check(20, Spawn::Uniform, 10, 0.98);
}

#[test]
fn the_layouts_are_solved() {
    for layout in 0..4 {
        check(20, Spawn::Lines(Some(layout)), 5, 0.96);
        check(20, Spawn::Authors(Some(layout)), 5, 0.96);
    }
}

#[test]
fn the_choice_depends_on_the_state_alone() {
    // Three states of two episodes in one call, or one by one: the same actions.
    let task = TaskConfig::of(TaskName::PushBall, 5, Spawn::Uniform);
    let streams = (0..2).map(|episode| Key::new(9, Purpose::EvalSpawn, &[2, episode]).stream());
    let mut env = new_env(&task, streams, false).unwrap();
    let goals: Vec<u32> = (0..2).flat_map(|_| (0..5).flat_map(|i| [i, 4 - i])).collect();
    env.set_goals(&goals).unwrap();
    let statics = env.statics().clone();
    let mut script = PushBallScript::new(5);
    let (mut positions, mut velocities, mut one_by_one) = (Vec::new(), Vec::new(), Vec::new());
    for _ in 0..3 {
        let (p, v) = (env.positions(), env.velocities());
        let mut actions = vec![0; 10];
        for b in 0..2 {
            let state = JointState {
                positions: &p[20 * b..20 * b + 20],
                velocities: &v[20 * b..20 * b + 20],
                agent_state: &[],
                world_states: &[],
                masks: &[],
                marks: &[],
                statics: statics.episode(b),
                goals: &goals[10 * b..10 * b + 10],
            };
            script.act(&state, &mut actions[5 * b..5 * b + 5]).unwrap();
        }
        env.step(&actions, &mut [0.0; 10]).unwrap();
        positions.extend(p);
        velocities.extend(v);
        one_by_one.extend(actions);
    }
    let mut together = vec![9; 30];
    let state = JointState {
        positions: &positions,
        velocities: &velocities,
        agent_state: &[],
        world_states: &[],
        masks: &[],
        marks: &[],
        statics: statics.view(),
        goals: &goals,
    };
    script.act(&state, &mut together).unwrap();
    assert_eq!(together, one_by_one);

    let mut wrong = goals.clone();
    wrong[3] = 5;
    let error = script.act(&JointState { goals: &wrong, ..state }, &mut together).unwrap_err().to_string();
    assert!(error.contains("goals[3]") && error.contains("landmark"), "{error}");
    let short = Statics::landmarks(5, 2, env.statics().get(LANDMARKS)[1..].to_vec());
    for (state, field) in [
        (JointState { positions: &positions[1..], ..state }, "positions"),
        (JointState { velocities: &velocities[1..], ..state }, "velocities"),
        (JointState { statics: short.view(), ..state }, "landmarks"),
        (JointState { goals: &goals[1..], ..state }, "goals"),
        (JointState { agent_state: &[0.0], ..state }, "agent_state"),
    ] {
        let error = script.act(&state, &mut together).unwrap_err().to_string();
        assert!(error.starts_with(field), "{error}");
    }
    let state = JointState { positions: &positions[..40], velocities: &velocities[..40], ..state };
    assert!(script.act(&state, &mut together[..15]).unwrap_err().to_string().starts_with("actions"));
    assert!(script.act(&state, &mut together[..10]).is_ok());
}
