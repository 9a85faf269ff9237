//! The controllers without weights over whole episodes: what they reach, and that batches do not change a bit.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use magex_core::joint_state::JointState;
use magex_core::metrics_table::{COLLISION_RATE, SUCCESS_RATE};
use magex_core::rng::{Key, Purpose};
use magex_core::task::{Spawn, TaskConfig, TaskName};
use magex_core::trajectory::EpisodeMetrics;
use magex_env::{Classical, classical, new_env};

/// What happens in one or several episodes, by number, with goals in order (of the starts, which are random).
fn play(kind: Classical, task: &TaskConfig, episodes: &[u32]) -> (Vec<Vec<u8>>, Vec<EpisodeMetrics>) {
    let key = |purpose: Purpose, k: u32| Key::new(7, purpose, &[100, k, 1]);
    let mut env = new_env(task, episodes.iter().map(|&k| key(Purpose::EvalSpawn, k).stream()), false).unwrap();
    let (n, stages) = (task.agents, task.stages().len());
    let goals: Vec<u32> = (0..episodes.len() * n * stages).map(|k| (k / stages % n) as u32).collect();
    env.set_goals(&goals).unwrap();
    let keys: Vec<Key> = episodes.iter().map(|&k| key(Purpose::Controller, k)).collect();
    let mut controller = classical(kind, task, &keys).unwrap();
    let per_episode = n * task.action_heads().len();
    let mut actions = vec![0; episodes.len() * per_episode];
    let mut agent_state = vec![0.0; episodes.len() * n * task.agent_state()];
    let mut rewards = vec![0.0; episodes.len() * n];
    let mut taken = vec![Vec::new(); episodes.len()];
    for step in 0..task.horizon {
        let (positions, velocities) = (env.positions(), env.velocities());
        env.write_agent_state(&mut agent_state).unwrap();
        let state = JointState {
            positions: &positions,
            velocities: &velocities,
            agent_state: &agent_state,
            world_states: &[],
            masks: &[],
            marks: &[],
            statics: env.statics().view(),
            goals: &goals,
        };
        if step == 0 {
            controller.begin(&state).unwrap();
        }
        controller.act(&state, &mut actions).unwrap();
        for (taken, actions) in taken.iter_mut().zip(actions.chunks_exact(per_episode)) {
            taken.extend_from_slice(actions);
        }
        env.step(&actions, &mut rewards).unwrap();
    }
    (taken, env.scores())
}

#[test]
fn a_batch_changes_no_action_and_episodes_differ() {
    for task in [
        TaskConfig::simple_spread(5, Spawn::Uniform),
        TaskConfig::simple_spread(20, Spawn::Lines(None)),
        TaskConfig::of(TaskName::PushBall, 3, Spawn::Uniform),
        TaskConfig::of(TaskName::Drones, 2, Spawn::Uniform),
    ] {
        for kind in Classical::ALL.into_iter().filter(|kind| kind.check(&task).is_ok()) {
            let (together, scores) = play(kind, &task, &[3, 4, 5]);
            for (k, episode) in [3, 4, 5].into_iter().enumerate() {
                let (alone, score) = play(kind, &task, &[episode]);
                assert_eq!((&together[k], &scores[k]), (&alone[0], &score[0]), "{kind}, {}", task.name);
            }
            assert_ne!(together[0], together[1], "{kind}, {}", task.name);
        }
    }
}

fn mean(scores: &[EpisodeMetrics], metric: usize) -> f32 {
    scores.iter().map(|score| score[metric]).sum::<f32>() / scores.len() as f32
}

#[test]
fn planners_bring_teams_to_goals_that_were_not_chosen_for_them() {
    let episodes: Vec<u32> = (0..20).collect();
    for (agents, spawn) in [(5, Spawn::Uniform), (20, Spawn::Lines(None)), (50, Spawn::Lines(None))] {
        let task = TaskConfig::simple_spread(agents, spawn);
        let success = |kind: Classical| mean(&play(kind, &task, &episodes).1, SUCCESS_RATE);
        let [astar, orca, nearest, random] =
            [Classical::Astar, Classical::Orca, Classical::Nearest, Classical::Random].map(success);
        assert!(astar > 0.99 && orca > 0.97, "N = {agents}: A* {astar}, ORCA {orca}");
        assert!((0.45..0.85).contains(&nearest) && random < 0.1, "N = {agents}: {nearest} {random}");
    }
    let task = TaskConfig::of(TaskName::Drones, 4, Spawn::Uniform);
    for kind in [Classical::Astar, Classical::Orca] {
        let scores = play(kind, &task, &episodes).1;
        let [success, crashed] = [SUCCESS_RATE, COLLISION_RATE].map(|metric| mean(&scores, metric));
        assert!(success > 0.9 && crashed < 0.1, "{kind}: {success} {crashed}");
    }
}

#[test]
fn what_does_not_fit_is_refused_by_name() {
    let push_ball = TaskConfig::of(TaskName::PushBall, 5, Spawn::Uniform);
    for kind in [Classical::Astar, Classical::Orca] {
        let error = classical(kind, &push_ball, &[]).err().unwrap().to_string();
        assert!(error.contains("controller") && error.contains("push-ball") && error.contains("scripted"), "{error}");
    }
    // A controller that did not see these episodes begin.
    let task = TaskConfig::simple_spread(2, Spawn::Uniform);
    let env = new_env(&task, [Key::new(1, Purpose::EvalSpawn, &[]).stream()].into_iter(), false).unwrap();
    let (positions, velocities) = (env.positions(), env.velocities());
    let (statics, goals) = (env.statics().view(), &[0, 1][..]);
    let state = JointState {
        positions: &positions,
        velocities: &velocities,
        agent_state: &[],
        world_states: &[],
        masks: &[],
        marks: &[],
        statics,
        goals,
    };
    for kind in Classical::ALL.into_iter().filter(|kind| *kind != Classical::Scripted) {
        let error = classical(kind, &task, &[]).unwrap().act(&state, &mut [0; 2]).unwrap_err().to_string();
        assert!(error.contains("began 0 episodes"), "{kind}: {error}");
    }
}
