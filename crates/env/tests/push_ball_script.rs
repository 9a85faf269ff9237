//! The yardstick of Push Ball: a controller that looks six steps ahead, given the exact assignments, solves every size of
//! the paper inside the horizon.

// Helpers of tests; the lint's exception covers test functions only.
#![allow(clippy::unwrap_used)]

mod assign;

use assign::exact;
use magex_core::rng::{Key, Purpose};
use magex_core::task::{Spawn, TaskConfig, TaskName};
use magex_env::scripted::scripted_push_ball;
use magex_env::{Env as _, PushBall, Score, View};

fn play(task: &TaskConfig, episodes: u32) -> (Vec<Score>, Option<u32>) {
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
    let mut solved = None;
    for step in 1..=task.horizon {
        env.write_positions(&mut positions).unwrap();
        env.write_velocities(&mut velocities).unwrap();
        let view =
            View { positions: &positions, velocities: &velocities, extras: &[], landmarks: &landmarks, goals: &goals };
        scripted_push_ball(&view, n, &mut actions).unwrap();
        env.step(&actions, &mut rewards).unwrap();
        if solved.is_none() && mean(&env.scores(), |score| score.success) >= 0.97 {
            solved = Some(step);
        }
    }
    (env.scores(), solved)
}

fn mean(scores: &[Score], value: fn(&Score) -> f32) -> f32 {
    scores.iter().map(value).sum::<f32>() / scores.len() as f32
}

/// Every setting of the paper; prints what the script reaches.
#[test]
#[ignore = "a measurement of minutes"]
fn measure() {
    use Spawn::{Authors, Lines, Uniform};
    let mut settings = vec![(5, Uniform), (20, Uniform)];
    settings.extend((0..4).map(|layout| (20, Lines(Some(layout)))));
    settings.extend((0..4).map(|layout| (20, Authors(Some(layout)))));
    settings.push((50, Uniform));
    for (agents, spawn) in settings {
        let task = TaskConfig::of(TaskName::PushBall, agents, spawn);
        let (scores, solved) = play(&task, 100);
        let full = scores.iter().filter(|score| score.success == 1.0).count();
        let [success, own, start, hits] = [
            |score: &Score| score.success,
            |score: &Score| score.matched_success,
            |score: &Score| score.spawn_success,
            |score: &Score| score.collisions_per_agent_step,
        ]
        .map(|value| mean(&scores, value));
        eprintln!(
            "{agents:3} {spawn:10} success {success:.4} own {own:.4} full {full} spawn {start:.3} hits {hits:.4} 97 % at {solved:?}"
        );
    }
}
