//! The yardstick of Push Ball: a controller that looks six steps ahead, given the exact assignments, solves every size of
//! the paper inside the horizon.

// Helpers of tests; the lint's exception covers test functions only.
#![allow(clippy::unwrap_used)]

#[path = "shared/assign.rs"]
mod assign;

use assign::exact;
use magex_core::rng::{Key, Purpose};
use magex_core::task::{Spawn, TaskConfig, TaskName};
use magex_env::scripted::scripted_push_ball;
use magex_env::{Env as _, PushBall, Score, View};

fn play(task: &TaskConfig, episodes: u32) -> Vec<Score> {
    let n = task.agents;
    let streams = (0..episodes).map(|episode| Key::new(9, Purpose::EvalSpawn, &[1, episode]).stream());
    let mut env = PushBall::new(task, streams, false).unwrap();
    let landmarks = env.landmarks().to_vec();
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
        let view = View {
            positions: &positions,
            velocities: &velocities,
            agent_state: &[],
            landmarks: &landmarks,
            goals: &goals,
        };
        scripted_push_ball(&view, n, &mut actions).unwrap();
        env.step(&actions, &mut rewards).unwrap();
    }
    env.scores()
}

fn mean(scores: &[Score], value: fn(&Score) -> f32) -> f32 {
    scores.iter().map(value).sum::<f32>() / scores.len() as f32
}

fn check(agents: usize, spawn: Spawn, episodes: u32, at_least: f32) {
    let task = TaskConfig::of(TaskName::PushBall, agents, spawn);
    let scores = play(&task, episodes);
    let success = mean(&scores, |score| score.success);
    assert!(success >= at_least, "{agents} {spawn}: success {success}");
    // What counts is nearly always the ball that was meant.
    assert!(mean(&scores, |score| score.matched_success) >= at_least - 0.02, "{agents} {spawn}");
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
    let mut env = PushBall::new(&task, streams, false).unwrap();
    let goals: Vec<u32> = (0..2).flat_map(|_| (0..5).flat_map(|i| [i, 4 - i])).collect();
    env.set_goals(&goals).unwrap();
    let landmarks = env.landmarks().to_vec();
    let (mut positions, mut velocities, mut one_by_one) = (Vec::new(), Vec::new(), Vec::new());
    for _ in 0..3 {
        let (p, v) = (env.positions(), env.velocities());
        let mut actions = vec![0; 10];
        for b in 0..2 {
            let view = View {
                positions: &p[20 * b..20 * b + 20],
                velocities: &v[20 * b..20 * b + 20],
                agent_state: &[],
                landmarks: &landmarks[10 * b..10 * b + 10],
                goals: &goals[10 * b..10 * b + 10],
            };
            scripted_push_ball(&view, 5, &mut actions[5 * b..5 * b + 5]).unwrap();
        }
        env.step(&actions, &mut [0.0; 10]).unwrap();
        positions.extend(p);
        velocities.extend(v);
        one_by_one.extend(actions);
    }
    let mut together = vec![9; 30];
    let view =
        View { positions: &positions, velocities: &velocities, agent_state: &[], landmarks: &landmarks, goals: &goals };
    scripted_push_ball(&view, 5, &mut together).unwrap();
    assert_eq!(together, one_by_one);

    let mut wrong = goals.clone();
    wrong[3] = 5;
    let error = scripted_push_ball(&View { goals: &wrong, ..view }, 5, &mut together).unwrap_err().to_string();
    assert!(error.contains("goals[3]") && error.contains("landmark"), "{error}");
    for (view, field) in [
        (View { positions: &positions[1..], ..view }, "positions"),
        (View { velocities: &velocities[1..], ..view }, "velocities"),
        (View { landmarks: &landmarks[1..], ..view }, "landmarks"),
        (View { goals: &goals[1..], ..view }, "goals"),
        (View { agent_state: &[0.0], ..view }, "agent_state"),
    ] {
        let error = scripted_push_ball(&view, 5, &mut together).unwrap_err().to_string();
        assert!(error.starts_with(field), "{error}");
    }
    let view = View { positions: &positions[..40], velocities: &velocities[..40], ..view };
    assert!(scripted_push_ball(&view, 5, &mut together[..15]).unwrap_err().to_string().starts_with("actions"));
    assert!(scripted_push_ball(&view, 5, &mut together[..10]).is_ok());
}
