//! The yardstick: a controller of one line, given the exact assignment, solves every size of the paper well inside the
//! horizon.

// Helpers of tests; the lint's exception covers test functions only.
#![allow(clippy::unwrap_used)]

#[path = "shared/assign.rs"]
mod assign;

use assign::exact;
use magex_core::joint_state::JointState;
use magex_core::metrics_table::{ARRIVAL_STEP, SUCCESS_RATE};
use magex_core::rng::{Key, Purpose};
use magex_core::statics::LANDMARKS;
use magex_core::task::{Spawn, TaskConfig};
use magex_core::trajectory::EpisodeMetrics;
use magex_env::controller::SpreadScript;
use magex_env::{Controller as _, new_env};

fn exact_goals(positions: &[f32], landmarks: &[f32], agents: usize) -> Vec<u32> {
    let worlds = positions.chunks_exact(2 * agents).zip(landmarks.chunks_exact(2 * agents));
    worlds.flat_map(|(agents, landmarks)| exact(agents, landmarks)).collect()
}

fn play(agents: usize, spawn: Spawn, episodes: u32) -> Vec<EpisodeMetrics> {
    let task = TaskConfig::simple_spread(agents, spawn);
    let streams = (0..episodes).map(|episode| Key::new(9, Purpose::EvalSpawn, &[1, episode]).stream());
    let mut spread = new_env(&task, streams, false).unwrap();
    let statics = spread.statics().clone();
    let goals = exact_goals(&spread.positions(), spread.statics().get(LANDMARKS), agents);
    spread.set_goals(&goals).unwrap();
    let (mut positions, mut velocities) = (spread.positions(), spread.velocities());
    let mut actions = vec![0; goals.len()];
    let mut rewards = vec![0.0; goals.len()];
    let mut script = SpreadScript::new(agents);
    for _ in 0..task.horizon {
        spread.write_positions(&mut positions).unwrap();
        spread.write_velocities(&mut velocities).unwrap();
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
        spread.step(&actions, &mut rewards).unwrap();
    }
    spread.scores()
}

fn check(agents: usize, spawn: Spawn, at_least: f32, arrival_below: f32) {
    let metrics = play(agents, spawn, 400);
    let mean = |value: fn(&EpisodeMetrics) -> f32| metrics.iter().map(value).sum::<f32>() / metrics.len() as f32;
    let (success, arrival) = (mean(|m| m[SUCCESS_RATE]), mean(|m| m[ARRIVAL_STEP]));
    assert!(success >= at_least, "{agents} {spawn}: success {success}");
    assert!(arrival < arrival_below, "{agents} {spawn}: arrival {arrival}");
}

#[test]
fn uniform_spawns_are_solved() {
    check(5, Spawn::Uniform, 0.999, 20.0);
    check(20, Spawn::Uniform, 0.999, 35.0);
    check(50, Spawn::Uniform, 0.999, 45.0);
}

#[test]
fn the_lines_are_solved_layout_by_layout() {
    for agents in [20, 50] {
        for layout in 0..4 {
            check(agents, Spawn::Lines(Some(layout)), 0.99, 75.0);
            check(agents, Spawn::Authors(Some(layout)), 0.99, 75.0);
        }
    }
    check(5, Spawn::Lines(None), 0.99, 40.0);
}

#[test]
fn larger_sizes_are_solved() {
    check(100, Spawn::Uniform, 0.999, 60.0);
    let metrics = play(300, Spawn::Uniform, 4);
    assert!(metrics.iter().all(|m| m[SUCCESS_RATE] >= 0.999), "{metrics:?}");
}
