//! Section 5: tasks, implementation details, ablations.

use crate::support::{actor_shapes, run, scheduler, stream};
use magex_core::config::{CommanderPolicy, ExecutorKind, RunConfig};
use magex_core::ids::Mode;
use magex_core::metrics_table::SUCCESS_RATE;
use magex_core::statics::LANDMARKS;
use magex_core::task::{Spawn, TaskConfig, TaskName};
use magex_env::{env_from_state, new_env};
use magex_nets::commander::Team;
use magex_tests::{small, small_task};

// Section 5.1, tasks.

#[test]
fn section_5_1_1_simple_spread() {
    // "A map with a size of 4 / 36 / 100": areas.
    for (agents, area, horizon) in [(5, 4.0, 60), (20, 36.0, 100), (50, 100.0, 120)] {
        let task = TaskConfig::simple_spread(agents, if agents == 5 { Spawn::Uniform } else { Spawn::Lines(None) });
        assert_eq!((task.side * task.side, task.horizon), (area, horizon), "{agents} agents");
        let env = new_env(&task, (0..4).map(stream), false).unwrap();
        let at = env.positions();
        let far = at.iter().chain(env.statics().get(LANDMARKS)).fold(0.0f32, |far, x| far.max(x.abs()));
        // Deviation: with the released code's scale of 1.5 the lines of 20 agents are 6.7 across, not 6.
        let half = if agents == 20 { 5.0 / 1.5 } else { task.side / 2.0 };
        assert!(far <= half + 1e-5 && far >= 0.8 * half, "{agents} agents reach to {far} of {half}");
    }
    // Up, down, left, right. Deviation: and nothing, as in the released code; an agent that has arrived can rest.
    let task = TaskConfig::simple_spread(1, Spawn::Uniform);
    assert_eq!(task.action_heads(), [5]);
    for (action, direction) in [(0, [0.0, 0.0]), (1, [1.0, 0.0]), (2, [-1.0, 0.0]), (3, [0.0, 1.0]), (4, [0.0, -1.0])] {
        let mut env = env_from_state(&task, &[0.0; 2], &[0.0; 2], &[1.0, 1.0]).unwrap();
        env.set_goals(&[0]).unwrap();
        env.step(&[action], &mut [0.0]).unwrap();
        let moved: Vec<f32> = env.positions().iter().map(|x| if *x == 0.0 { 0.0 } else { x.signum() }).collect();
        assert_eq!(moved, direction, "action {action}");
    }
    // "They will bounce off each other."
    let task = TaskConfig::simple_spread(2, Spawn::Uniform);
    let mut env = env_from_state(&task, &[0.0, 0.0, 0.15, 0.0], &[0.0; 4], &[1.0, 1.0, -1.0, 1.0]).unwrap();
    env.set_goals(&[0, 1]).unwrap();
    env.step(&[0, 0], &mut [0.0; 2]).unwrap();
    let at = env.positions();
    assert!(at[0] < 0.0 && at[2] > 0.15, "{at:?}");
}

#[test]
fn section_5_1_2_push_ball() {
    for (agents, area, horizon) in [(5, 16.0, 100), (20, 144.0, 200)] {
        let task = TaskConfig::of(TaskName::PushBall, agents, Spawn::Uniform);
        assert_eq!((task.side * task.side, task.horizon), (area, horizon), "{agents} agents");
        assert_eq!((task.balls(), task.stages().len()), (agents, 2), "N balls; first the ball, then the landmark");
        let env = new_env(&task, (0..2).map(stream), false).unwrap();
        assert_eq!(env.statics().get(LANDMARKS).len(), 2 * agents * 2);
    }
    // "Breaks this M-stage goal assignment into M independent tasks": a decision and a cost of its own per stage.
    let (trajectories, ..) = run(&small_task(TaskName::PushBall, ExecutorKind::Local, 4, 1));
    for t in &trajectories {
        assert_eq!((t.costs.len(), t.goal_log_probs.len()), (2 * t.shape.episodes, 2 * t.shape.episodes));
    }
}

#[test]
fn section_5_1_3_drones() {
    for agents in [2, 4] {
        let task = TaskConfig::of(TaskName::Drones, agents, Spawn::Uniform);
        assert_eq!((task.horizon, task.drones().unwrap().physics_hz, task.dims()), (120, 120, 3));
        assert_eq!(task.action_heads(), [3, 3, 3], "forward, backward, stop along each axis");
        let mut env = new_env(&task, (0..50).map(stream), false).unwrap();
        for points in [env.positions(), env.statics().get(LANDMARKS).to_vec()] {
            for point in points.chunks(3) {
                assert!(point[0].abs() <= 1.5 && point[1].abs() <= 1.5 && (point[2] - 1.5).abs() < 1e-6, "{point:?}");
            }
        }
        // The target velocity is changed by 5 m/s² for 1/30 s per step and is at most 2 m/s: full speed takes 12 steps.
        env.set_goals(&(0..agents as u32).collect::<Vec<_>>().repeat(50)).unwrap();
        let mut fastest = 0.0f32;
        for _ in 0..60 {
            env.step(&[0u8, 1, 1].repeat(50 * agents), &mut vec![0.0; 50 * agents]).unwrap();
            let mut velocities = vec![0.0; 50 * agents * 3];
            env.write_velocities(&mut velocities).unwrap();
            fastest = velocities.chunks(3).map(|v| v[0].abs()).fold(fastest, f32::max);
        }
        assert!((1.0..=2.5).contains(&fastest), "{fastest} m/s");
    }
}

// Section 5.2, implementation details.

#[test]
fn section_5_2_success_is_the_share_of_landmarks_reached_at_the_end_over_100_episodes() {
    assert_eq!(RunConfig::default().run.final_episodes, 100);
    let task = TaskConfig { horizon: 1, ..TaskConfig::simple_spread(4, Spawn::Uniform) };
    // Landmarks 0 to 2 are covered, two of them by agents that were sent elsewhere.
    let landmarks = [0.0, 0.0, 2.0, 0.0, 4.0, 0.0, 9.0, 0.0];
    let mut env = env_from_state(&task, &[0.1, 0.0, 2.1, 0.0, 4.1, 0.0, 6.0, 0.0], &[0.0; 8], &landmarks).unwrap();
    env.set_goals(&[0, 2, 1, 3]).unwrap();
    env.step(&[0; 4], &mut [0.0; 4]).unwrap();
    assert_eq!(env.scores()[0][SUCCESS_RATE], 0.75);
}

// Section 5.5, ablations.

#[test]
fn section_5_5_the_ablations_are_there() {
    let shapes = |kind| actor_shapes(&small(kind, 5, 1));
    // w. RG: goals at random, without replacement.
    let random = scheduler(CommanderPolicy::Random, 6);
    let points: Vec<f32> = (0..12).map(|k| k as f32).collect();
    let team = Team { agents: &points, goals: &points, dims: 2 };
    let draws: Vec<Vec<u32>> =
        (0..20).map(|k| random.assign(&team, Mode::Sampled, &mut stream(k)).unwrap().goals).collect();
    assert!(draws.iter().any(|goals| *goals != draws[0]));
    for mut goals in draws {
        goals.sort_unstable();
        assert_eq!(goals, [0, 1, 2, 3, 4, 5]);
    }
    // -Atten: attention in the place of GCN and graph blocks. -MLP: one layer on all observations side by side.
    let has = |kind, part: &str| shapes(kind).keys().any(|name| name.starts_with(part));
    for part in ["gcn", "block0", "block1"] {
        assert!(has(ExecutorKind::Magex, part) && !has(ExecutorKind::Attention, part) && !has(ExecutorKind::Mlp, part));
    }
    assert!(has(ExecutorKind::Attention, "attention") && !has(ExecutorKind::Magex, "attention"));
    assert_eq!(shapes(ExecutorKind::Mlp)["concat.weight"], [5 * 32, 32]);
}
