use super::*;
use crate::env::Env;
use crate::tasks::{env_from_state, new_env};
use magex_core::metrics_table::{ARRIVAL_STEP, COLLISIONS_PER_AGENT_STEP, MATCHED_SUCCESS_RATE, REWARD, SUCCESS_RATE};
use magex_core::rng::{Key, Purpose};
use magex_core::task::{Integration, RewardConfig, Spawn, TaskSettings};

fn streams(count: u32) -> impl Iterator<Item = Stream> {
    (0..count).map(|episode| Key::new(3, Purpose::Spawn, &[0, 0, episode]).stream())
}

fn task(agents: usize) -> TaskConfig {
    TaskConfig::simple_spread(agents, Spawn::Uniform)
}

/// Three agents at rest: two overlapping ones and one on its landmark.
fn hand_made() -> (TaskConfig, Env) {
    let mut task = task(3);
    task.side = 4.0;
    task.settings =
        TaskSettings::SimpleSpread(RewardConfig { bonus: 3.0, distance: 0.5, collision: 0.25, distance_unit: 2.0 });
    let positions = [0.0, 0.0, 0.125, 0.0, 1.5, 1.5];
    let landmarks = [1.0, 0.0, -1.0, 0.0, 1.5, 1.5];
    let spread = env_from_state(&task, &positions, &[0.0; 6], &landmarks).unwrap();
    (task, spread)
}

#[test]
fn with_positions_first_an_agent_moves_with_the_velocity_of_the_step_before() {
    let (mut task, _) = hand_made();
    task.integration = Integration::PositionFirst;
    let start = [0.0, 0.0, 0.125, 0.0, 1.5, 1.5];
    let mut spread = env_from_state(&task, &start, &[0.0; 6], &[1.0, 0.0, -1.0, 0.0, 1.5, 1.5]).unwrap();
    spread.set_goals(&[0, 1, 2]).unwrap();
    // From rest nothing moves yet; the overlap of 0.075 pushes with 7.5, the thrust is 5.
    spread.step(&[0, 0, 3], &mut [0.0; 3]).unwrap();
    let near = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5);
    let (positions, velocities) = (spread.positions(), spread.velocities());
    assert!(near(&positions, &start) && near(&velocities, &[-0.75, 0.0, 0.75, 0.0, 0.0, 0.5]), "{velocities:?}");
    // x += 0.1 v, then v = 0.75 v + 0.1 a with the contact of the places before the step: mpe2 1.1.1.
    spread.step(&[0, 0, 3], &mut [0.0; 3]).unwrap();
    let (positions, velocities) = (spread.positions(), spread.velocities());
    assert!(near(&positions, &[-0.075, 0.0, 0.2, 0.0, 1.5, 1.55]), "{positions:?}");
    assert!(near(&velocities, &[-1.3125, 0.0, 1.3125, 0.0, 0.0, 0.875]), "{velocities:?}");
}

#[test]
fn the_reward_is_the_documented_one_of_the_state_after_the_step() {
    let (_, mut spread) = hand_made();
    spread.set_goals(&[0, 1, 2]).unwrap();
    let mut rewards = [f32::NAN; 3];
    spread.step(&[0, 0, 3], &mut rewards).unwrap();
    // The overlap of 0.075 pushes with 7.5: v = 0.75, x = 0.075 apart from where they were, 0.275 from each other.
    // Agent 2 thrusts with 5: v = 0.5, moves by 0.05 and is still within 0.15 of its landmark.
    let expected = [-0.5 * 1.075 / 2.0, -0.5 * 1.2 / 2.0, 3.0 - 0.5 * 0.05 / 2.0];
    for (reward, expected) in rewards.iter().zip(expected) {
        assert!((reward - expected).abs() < 1e-6, "{rewards:?}");
    }
    let positions = spread.positions();
    for (position, expected) in positions.iter().zip([-0.075, 0.0, 0.2, 0.0, 1.5, 1.55]) {
        assert!((position - expected).abs() < 1e-6, "{positions:?}");
    }
}

#[test]
fn overlapping_agents_pay_for_each_other_and_not_for_themselves() {
    let mut task = task(3);
    task.side = 4.0;
    let positions = [0.0, 0.0, 0.1, 0.0, 0.2, 0.0];
    let mut spread = env_from_state(&task, &positions, &[0.0; 6], &positions).unwrap();
    spread.set_goals(&[0, 1, 2]).unwrap();
    let mut rewards = [0.0; 3];
    // The outer two are pushed out by 0.1, the middle one stays: no two overlap any more after the step.
    spread.step(&[0; 3], &mut rewards).unwrap();
    let after = spread.positions();
    assert!(after[0] < -0.09 && (after[2] - 0.1).abs() < 1e-6 && after[4] > 0.29, "{after:?}");
    assert!(rewards.iter().all(|r| (0.9..=1.0).contains(r)), "{rewards:?}");
    // Driving the left one into the middle one: both pay.
    let positions = [0.0, 0.0, 0.21, 0.0, 3.0, 0.0];
    let mut spread = env_from_state(&task, &positions, &[1.0, 0.0, 0.0, 0.0, 0.0, 0.0], &positions).unwrap();
    spread.set_goals(&[0, 1, 2]).unwrap();
    spread.step(&[1, 0, 0], &mut rewards).unwrap();
    let metrics = spread.scores()[0];
    assert!(rewards[0] < 0.1 && rewards[1] < 0.1 && rewards[2] == 1.0, "{rewards:?}");
    assert_eq!(metrics[COLLISIONS_PER_AGENT_STEP], 2.0 / 3.0);
    assert!((metrics[REWARD] - rewards.iter().sum::<f32>() / 3.0).abs() < 1e-6);
}

#[test]
fn success_counts_any_agent_and_matched_success_only_its_own() {
    // Two landmarks 0.2 apart with one agent between them, a third landmark alone.
    let mut task = task(3);
    task.side = 8.0;
    let positions = [0.0, 0.0, 2.0, 2.0, 3.0, 3.0];
    let landmarks = [-0.1, 0.0, 0.1, 0.0, -3.0, -3.0];
    let mut spread = env_from_state(&task, &positions, &[0.0; 6], &landmarks).unwrap();
    spread.set_goals(&[0, 1, 2]).unwrap();
    spread.step(&[0; 3], &mut [0.0; 3]).unwrap();
    let metrics = spread.scores()[0];
    assert_eq!((metrics[SUCCESS_RATE], metrics[MATCHED_SUCCESS_RATE]), (2.0 / 3.0, 1.0 / 3.0));
    assert_eq!(metrics[ARRIVAL_STEP], (task.horizon + 1) as f32);
}

#[test]
fn arrival_is_the_first_step_after_which_enough_landmarks_are_covered() {
    for (agents, missing, arrives) in [(99, 1, false), (100, 1, true), (100, 2, false), (300, 3, true), (300, 4, false)]
    {
        let mut task = task(agents);
        task.side = 2.0 * agents as f32;
        let landmarks: Vec<f32> = (0..agents).flat_map(|k| [k as f32 - 0.5 * agents as f32, 0.0]).collect();
        // All stand on their landmarks, but for some that are far off, and one that needs a few steps.
        let mut positions = landmarks.clone();
        for k in 0..missing {
            positions[2 * (7 * k + 3) + 1] = 50.0 + k as f32;
        }
        positions[1] = -0.6;
        let mut spread = env_from_state(&task, &positions, &vec![0.0; 2 * agents], &landmarks).unwrap();
        spread.set_goals(&(0..agents as u32).collect::<Vec<_>>()).unwrap();
        let mut actions = vec![0; agents];
        actions[0] = 3;
        let mut rewards = vec![0.0; agents];
        let mut expected = task.horizon + 1;
        for step in 1..=10 {
            spread.step(&actions, &mut rewards).unwrap();
            if arrives && expected > step && spread.positions()[1].abs() <= 0.15 {
                expected = step;
            }
        }
        assert_eq!(arrives, expected < 11);
        let metrics = spread.scores()[0];
        assert_eq!(metrics[ARRIVAL_STEP], expected as f32, "N = {agents}, {missing} missing");
    }
}

#[test]
fn an_episode_is_the_same_alone_and_in_any_batch() {
    for (agents, episodes) in [(5, 37), (20, 17), (50, 5), (200, 14)] {
        let task = task(agents);
        let mut together = new_env(&task, streams(episodes), false).unwrap();
        let goals: Vec<u32> = (0..episodes).flat_map(|_| (0..agents as u32).rev()).collect();
        together.set_goals(&goals).unwrap();
        let mut alone: Vec<Env> =
            streams(episodes).map(|s| new_env(&task, std::iter::once(s), false).unwrap()).collect();
        alone.iter_mut().for_each(|spread| spread.set_goals(&goals[..agents]).unwrap());
        let mut stream = Key::new(3, Purpose::Action, &[agents as u32]).stream();
        let mut rewards = vec![0.0; agents * episodes as usize];
        for _ in 0..task.horizon {
            let actions: Vec<u8> = rewards.iter().map(|_| stream.below(5) as u8).collect();
            together.step(&actions, &mut rewards).unwrap();
            let positions = together.positions();
            for (b, spread) in alone.iter_mut().enumerate() {
                let own = b * agents..(b + 1) * agents;
                let mut reward = vec![0.0; agents];
                spread.step(&actions[own.clone()], &mut reward).unwrap();
                assert_eq!(reward, rewards[own.clone()]);
                assert_eq!(spread.positions(), positions[2 * own.start..2 * own.end]);
            }
        }
        let metrics = together.scores();
        for (spread, metrics) in alone.iter().zip(metrics) {
            assert_eq!(spread.scores(), [metrics]);
        }
    }
}

#[test]
fn the_numbers_of_an_episode_are_pinned() {
    // Any change here changes every run: raise magex_core::task::TASK_SEMANTICS with it.
    let digest = |agents: usize, spawn: Spawn| {
        let task = TaskConfig::simple_spread(agents, spawn);
        let mut spread = new_env(&task, streams(3), false).unwrap();
        spread.set_goals(&(0..3).flat_map(|_| 0..agents as u32).collect::<Vec<_>>()).unwrap();
        let mut stream = Key::new(3, Purpose::Action, &[]).stream();
        let mut rewards = vec![0.0; 3 * agents];
        let mut hash = 0xcbf2_9ce4_8422_2325u64;
        for _ in 0..task.horizon {
            let actions: Vec<u8> = rewards.iter().map(|_| stream.below(5) as u8).collect();
            spread.step(&actions, &mut rewards).unwrap();
            for value in spread.positions().iter().chain(&rewards) {
                hash = (hash ^ u64::from(value.to_bits())).wrapping_mul(0x0000_0100_0000_01b3);
            }
        }
        hash
    };
    let digests = [
        digest(5, Spawn::Uniform),
        digest(20, Spawn::Lines(None)),
        digest(50, Spawn::Authors(Some(2))),
        digest(256, Spawn::Uniform),
    ];
    assert_eq!(
        digests,
        [0x3860_8c49_4b11_e6c0, 0xf665_d42f_77b5_db8d, 0x069d_3ee1_3da6_0709, 0x2dff_ca6e_9adf_594b],
        "{digests:#x?}"
    );
}

#[test]
fn wrong_calls_are_named_and_change_nothing() {
    let task = task(5);
    let mut spread = new_env(&task, streams(2), false).unwrap();
    let before = spread.positions();
    let mut rewards = [0.0; 10];
    assert_eq!(
        spread.step(&[0; 10], &mut rewards),
        Err(FieldError::new("goals", "not set; call set_goals before the first step"))
    );
    assert_eq!(spread.set_goals(&[0; 9]), Err(FieldError::new("goals", "9 entries, the shape asks for 10")));
    let mut goals = [4; 10];
    goals[7] = 5;
    assert_eq!(spread.set_goals(&goals), Err(FieldError::new("goals[7]", "5 is not a landmark; use an index below 5")));
    spread.set_goals(&[0; 10]).unwrap();
    let mut actions = [1; 10];
    actions[3] = 5;
    assert_eq!(
        spread.step(&actions, &mut rewards),
        Err(FieldError::new("actions[3]", "5 is not an action; use 0 none, 1 +x, 2 -x, 3 +y, 4 -y"))
    );
    assert!(spread.step(&[0; 9], &mut rewards).is_err());
    assert!(spread.step(&[0; 10], &mut rewards[..9]).is_err());
    assert!(spread.write_positions(&mut [0.0; 19]).is_err());
    assert_eq!((spread.positions(), spread.steps), (before, 0));
    for _ in 0..task.horizon {
        spread.step(&[0; 10], &mut rewards).unwrap();
    }
    assert_eq!(
        spread.step(&[0; 10], &mut rewards),
        Err(FieldError::new("step", "the episode is over after 60 steps; start a new batch"))
    );
    let bad = env_from_state(&task, &[f32::NAN; 10], &[0.0; 10], &[0.0; 10]);
    assert_eq!(bad.err(), Some(FieldError::new("positions[0]", "NaN is not finite")));
    let mut task = task;
    task.side = -1.0;
    assert!(new_env(&task, streams(1), false).err().unwrap().to_string().contains("task.side"));
}

#[test]
fn a_batch_of_nothing_is_fine() {
    let mut spread = new_env(&task(5), streams(0), false).unwrap();
    spread.set_goals(&[]).unwrap();
    spread.step(&[], &mut []).unwrap();
    assert_eq!((spread.shape.episodes, spread.positions().len()), (0, 0));
}
