use super::*;
use crate::env::Env;
use crate::tasks::{env_from_state, new_env};
use magex_core::metrics_table::{
    ARRIVAL_STEP, COLLISION_RATE, COLLISIONS_PER_AGENT_STEP, MATCHED_SUCCESS_RATE, REWARD, SPAWN_SUCCESS_RATE,
    SUCCESS_RATE,
};
use magex_core::rng::{Key, Purpose};
use magex_core::task::{PushBallConfig, Spawn, TaskName, TaskSettings};

fn streams(count: u32) -> impl Iterator<Item = Stream> {
    (0..count).map(|episode| Key::new(3, Purpose::Spawn, &[0, 0, episode]).stream())
}

fn task(agents: usize, spawn: Spawn) -> TaskConfig {
    TaskConfig::of(TaskName::PushBall, agents, spawn)
}

/// Every agent's goals have its own number.
fn own(episodes: u32, agents: usize) -> Vec<u32> {
    (0..episodes).flat_map(|_| (0..agents as u32).flat_map(|i| [i, i])).collect()
}

/// Worlds of one agent and one ball each, at the given places, and their landmark.
fn lone(worlds: &[[f32; 6]]) -> (TaskConfig, Env) {
    let task = task(1, Spawn::Uniform);
    let positions: Vec<f32> = worlds.iter().flat_map(|world| world[..4].to_vec()).collect();
    let landmarks: Vec<f32> = worlds.iter().flat_map(|world| world[4..].to_vec()).collect();
    let mut env = env_from_state(&task, &positions, &vec![0.0; positions.len()], &landmarks).unwrap();
    env.set_goals(&own(worlds.len() as u32, 1)).unwrap();
    (task, env)
}

/// Φ as it is documented, for agent, ball and landmark at the given places.
fn potential(at: &[f32]) -> f64 {
    let at: Vec<f64> = at.iter().map(|&c| f64::from(c)).collect();
    let (a, b) = ([at[2] - at[0], at[3] - at[1]], [at[4] - at[2], at[5] - at[3]]);
    let (d_ab, d_bl) = (libm::hypot(a[0], a[1]), libm::hypot(b[0], b[1]));
    let theta = libm::fabs(libm::atan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1]));
    let path = (d_ab - 0.25).max(0.0) + 0.25 * theta * (d_bl / 0.3).min(1.0);
    -(path + 2.0 * d_bl)
}

#[test]
fn the_reward_is_the_documented_one_of_the_step() {
    // Behind the ball, beside it, in front of it, touching it, and with the ball home and nearly home.
    let worlds = [
        [0.0, 0.0, 1.0, 0.0, 3.0, 0.0],
        [0.0, 0.0, 0.0, 1.0, 2.0, 1.0],
        [2.0, 0.5, 0.0, 0.0, 3.0, 0.75],
        [0.0, 0.0, 0.2, 0.0, 1.0, -1.0],
        [0.0, 0.0, 1.0, 0.0, 1.1, 0.1],
        [0.0, 0.0, 1.0, 0.0, 1.35, 0.0],
        [0.0, 0.0, 1.0, 1.0, 1.0, 1.0],
    ];
    for action in 0..5 {
        let (task, mut env) = lone(&worlds);
        let mut rewards = [f32::NAN; 7];
        env.step(&[action; 7], &mut rewards).unwrap();
        let after = env.positions();
        for (b, before) in worlds.iter().enumerate() {
            let now = [&after[4 * b..4 * b + 4], &before[4..]].concat();
            let d_bl = libm::hypotf(now[2] - now[4], now[3] - now[5]);
            let bonus = if d_bl <= 0.3 { 0.1 } else { 0.0 };
            let expected = 2.0 * (potential(&now) - potential(before)) + bonus;
            assert!((f64::from(rewards[b]) - expected).abs() < 2e-5, "{action} {b}: {} {expected}", rewards[b]);
        }
        assert!((env.scores()[0][REWARD] - rewards[0]).abs() < 1e-6 && env.steps == 1 && task.horizon > 1);
    }
}

#[test]
fn the_authors_reward_is_a_choice_of_coefficients() {
    let mut task = task(2, Spawn::Uniform);
    let authors = PushBallConfig { progress: 0.0, bonus: 1.0, distance: 1.0, ..PushBallConfig::default() };
    task.settings = TaskSettings::PushBall(authors);
    let positions = [0.0, 0.0, 3.0, 3.0, 0.0, 1.0, 3.0, 1.0];
    let landmarks = [3.0, 1.2, -1.0, 1.0];
    let mut env = env_from_state(&task, &positions, &[0.0; 8], &landmarks).unwrap();
    env.set_goals(&[0, 1, 1, 0]).unwrap();
    let mut rewards = [0.0; 2];
    env.step(&[0, 0], &mut rewards).unwrap();
    for (reward, expected) in rewards.iter().zip([-(1.0 + 1.0), -(2.0 + 0.2) + 1.0]) {
        assert!((reward - expected).abs() < 1e-6, "{rewards:?}");
    }
}

#[test]
fn every_step_pays_for_its_own_way_whenever_the_goals_are_set() {
    let (_, mut env) = lone(&[[0.0, 0.0, 1.0, 0.0, 9.0, 0.0]]);
    let mut before = potential(&[0.0, 0.0, 1.0, 0.0, 9.0, 0.0]);
    for step in 0..30 {
        if step == 20 {
            env.set_goals(&[0, 0]).unwrap();
        }
        let mut rewards = [0.0];
        env.step(&[1], &mut rewards).unwrap();
        let now = potential(&[env.positions(), vec![9.0, 0.0]].concat());
        assert!((f64::from(rewards[0]) - 2.0 * (now - before)).abs() < 2e-5, "{step}: {rewards:?}");
        before = now;
    }
}

#[test]
fn a_ball_is_pushed_by_contact_only_and_momentum_is_conserved() {
    // The agent flies into the ball without thrust; damping takes a quarter of the whole in every step.
    let task = task(1, Spawn::Uniform);
    let positions = [0.0, 0.0, 0.5, 0.03];
    let velocities = [2.0, 0.1, 0.0, 0.0];
    let mut env = env_from_state(&task, &positions, &velocities, &[5.0, 5.0]).unwrap();
    env.set_goals(&[0, 0]).unwrap();
    let mut whole = [2.0, 0.1];
    for step in 0..30 {
        env.step(&[0], &mut [0.0]).unwrap();
        let v = env.velocities();
        whole = whole.map(|p| 0.75 * p);
        assert!((v[0] + v[2] - whole[0]).abs() < 1e-6 && (v[1] + v[3] - whole[1]).abs() < 1e-6, "{step}: {v:?}");
        assert_eq!(v[2] == 0.0, step < 2, "{step}: {v:?}");
    }
    let after = env.positions();
    assert!(after[2] > 0.6 && after[3] > 0.03, "{after:?}");
    assert!(libm::hypotf(after[0] - after[2], after[1] - after[3]) > 0.24);
}

#[test]
fn the_speeds_are_those_of_the_formulas() {
    // Alone 2 units per second; with a ball before it, half of that and a steady overlap of 0.025.
    let (_, mut env) = lone(&[[0.0, 0.0, 0.0, 9.0, 0.0, 0.0], [0.0, 0.0, 0.3, 0.0, 9.0, 0.0]]);
    (0..60).for_each(|_| env.step(&[1, 1], &mut [0.0; 2]).unwrap());
    let (v, p) = (env.velocities(), env.positions());
    assert!((v[0] - 2.0).abs() < 1e-5 && (v[4] - 1.0).abs() < 1e-3 && (v[6] - 1.0).abs() < 1e-3, "{v:?}");
    assert!((p[6] - p[4] - 0.225).abs() < 1e-3, "{p:?}");
    assert_eq!(p[3], 9.0);
}

#[test]
fn success_takes_any_ball_and_matched_success_the_own_one() {
    let mut task = task(3, Spawn::Uniform);
    task.side = 8.0;
    // Ball 0 covers landmark 1, ball 1 landmark 0, ball 2 only just landmark 2; agents 0 and 1 overlap.
    let positions = [3.0, 3.0, 3.1, 3.0, -3.0, -3.0, 1.0, 0.0, 0.0, 0.0, -1.0, 0.0];
    let landmarks = [0.0, 0.2, 1.0, 0.2, -1.0, -0.3];
    let start = || env_from_state(&task, &positions, &[0.0; 12], &landmarks).unwrap();
    let play = |goals: &[u32]| {
        let mut env = start();
        env.set_goals(goals).unwrap();
        env.step(&[0; 3], &mut [0.0; 3]).unwrap();
        env.scores()[0]
    };
    for (goals, own) in [([0, 0, 1, 1, 2, 2], 1.0 / 3.0), ([0, 1, 1, 0, 2, 2], 1.0), ([2, 2, 2, 2, 2, 2], 1.0 / 3.0)] {
        let score = play(&goals);
        assert_eq!(
            (score[SUCCESS_RATE], score[MATCHED_SUCCESS_RATE], score[SPAWN_SUCCESS_RATE]),
            (1.0, own, 1.0),
            "{goals:?}"
        );
        assert_eq!((score[ARRIVAL_STEP], score[COLLISION_RATE]), (1.0, 0.0));
    }
    assert_eq!(start().scores()[0][MATCHED_SUCCESS_RATE], 0.0);
    let apart = [0.0, 0.2, 1.0, 0.2, -1.0, -0.31];
    let env = env_from_state(&task, &positions, &[0.0; 12], &apart).unwrap();
    assert_eq!((env.scores()[0][SUCCESS_RATE], env.scores()[0][ARRIVAL_STEP]), (2.0 / 3.0, (task.horizon + 1) as f32));
}

#[test]
fn collisions_are_those_of_agents_among_themselves() {
    // Both agents are driven against each other and against a ball; balls overlap, too.
    let mut task = task(3, Spawn::Uniform);
    task.side = 8.0;
    let positions = [0.0, 0.0, 0.21, 0.0, 3.0, 3.0, 3.0, 3.2, 3.0, 3.45, -3.0, 0.0];
    let velocities = [1.0, 0.0, -1.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0];
    let mut env = env_from_state(&task, &positions, &velocities, &[0.0; 6]).unwrap();
    env.set_goals(&own(1, 3)).unwrap();
    env.step(&[0; 3], &mut [0.0; 3]).unwrap();
    let p = env.positions();
    assert!(libm::hypotf(p[4] - p[6], p[5] - p[7]) < 0.25 && p[9] - p[7] < 0.3, "{p:?}");
    assert_eq!(env.scores()[0][COLLISIONS_PER_AGENT_STEP], 2.0 / 3.0);
}

/// Everything an episode produces with random actions.
fn run(env: &mut Env, goals: &[u32], seed: u32, steps: u32, table: impl Fn(u32, usize) -> u8) -> Vec<Vec<u32>> {
    let bits = |values: &[f32]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
    env.set_goals(goals).unwrap();
    let mut rewards = vec![0.0; goals.len() / 2];
    let mut log = vec![bits(env.statics().get(LANDMARKS))];
    for step in 0..steps {
        let actions: Vec<u8> = (0..rewards.len()).map(|k| table(seed + step, k)).collect();
        env.step(&actions, &mut rewards).unwrap();
        log.extend([bits(&env.positions()), bits(&env.velocities()), bits(&rewards)]);
    }
    for score in env.scores() {
        log.push(bits(&[score[SUCCESS_RATE], score[MATCHED_SUCCESS_RATE], score[SPAWN_SUCCESS_RATE], score[REWARD]]));
        log.push(vec![score[ARRIVAL_STEP] as u32, score[COLLISIONS_PER_AGENT_STEP].to_bits()]);
    }
    log
}

/// An action for agent i of episode b that depends on nothing else.
fn action(step: u32, episode: u32, agent: usize) -> u8 {
    (magex_core::rng::mix(u64::from(episode), step / 3 * 1000 + agent as u32) % 5) as u8
}

#[test]
fn an_episode_is_the_same_alone_and_in_any_batch() {
    for (agents, episodes) in [(1, 3), (5, 37), (20, 17), (60, 9), (130, 2)] {
        let mut task = task(agents, Spawn::Uniform);
        task.side = task.side.min(0.7 * (agents as f32).sqrt() + 1.0); // crowded
        let goals: Vec<u32> =
            (0..agents as u32).flat_map(|i| [(i + 1) % agents as u32, agents as u32 - 1 - i]).collect();
        let all: Vec<u32> = (0..episodes).flat_map(|_| goals.clone()).collect();
        let mut together = new_env(&task, streams(episodes), false).unwrap();
        let together = run(&mut together, &all, 0, 40, |step, k| action(step, (k / agents) as u32, k % agents));
        for (b, stream) in streams(episodes).enumerate() {
            let mut alone = new_env(&task, std::iter::once(stream), false).unwrap();
            let alone = run(&mut alone, &goals, 0, 40, |step, k| action(step, b as u32, k));
            for (all, one) in together[..121].iter().zip(&alone[..121]) {
                assert_eq!(all[b * one.len()..(b + 1) * one.len()], one[..], "N = {agents}, episode {b}");
            }
            assert_eq!(together[121 + 2 * b..123 + 2 * b], alone[121..], "N = {agents}, episode {b}");
        }
    }
}

#[test]
fn cells_and_lanes_give_the_same_bits() {
    for (agents, side) in [(1, 2.0), (7, 2.5), (60, 6.0), (150, 9.0)] {
        let mut task = task(agents, Spawn::Uniform);
        task.side = side;
        let mut lanes = new_env(&task, streams(1), false).unwrap();
        let (positions, landmarks) = (lanes.positions(), lanes.statics().get(LANDMARKS).to_vec());
        let rest = vec![0.0; positions.len()];
        let mut cells = new_env(&task, streams(1), false).unwrap();
        let starts = Starts::given(&task, [&positions, &rest, &landmarks]).unwrap();
        lanes.rules = Box::new(Batch::<LANES, PushBallObjective<LANES>>::new(&task, &starts, false).unwrap());
        cells.rules = Box::new(Batch::<1, PushBallObjective<1>>::new(&task, &starts, true).unwrap());
        let table = |step, k| action(step, 0, k);
        let goals = own(1, agents);
        assert_eq!(run(&mut lanes, &goals, 0, 60, table), run(&mut cells, &goals, 0, 60, table), "N = {agents}");
    }
}

#[test]
fn arrival_is_the_first_step_after_which_enough_landmarks_are_covered() {
    for (agents, missing, arrives) in [(99, 1, false), (100, 1, true), (100, 2, false), (300, 3, true)] {
        let mut task = task(agents, Spawn::Uniform);
        task.side = agents as f32;
        let balls: Vec<f32> = (0..agents).flat_map(|k| [k as f32 - 0.5 * agents as f32, 0.0]).collect();
        let mut landmarks = balls.clone();
        for k in 0..missing {
            landmarks[2 * (7 * k + 3) + 1] = 50.0 + k as f32;
        }
        landmarks[1] = 0.5;
        // All agents stand on landmarks, which does not count; the first one is behind its ball.
        let agents_at: Vec<f32> = (0..agents).flat_map(|k| [balls[2 * k], if k == 0 { -0.3 } else { 60.0 }]).collect();
        let positions = [agents_at, balls].concat();
        let mut env = env_from_state(&task, &positions, &vec![0.0; 4 * agents], &landmarks).unwrap();
        env.set_goals(&own(1, agents)).unwrap();
        let mut actions = vec![0; agents];
        actions[0] = 3;
        let mut expected = task.horizon + 1;
        for step in 1..=12 {
            env.step(&actions, &mut vec![0.0; agents]).unwrap();
            if arrives && expected > step && env.positions()[2 * agents + 1] >= 0.2 {
                expected = step;
            }
        }
        assert_eq!(arrives, expected < 12);
        assert_eq!(env.scores()[0][ARRIVAL_STEP], expected as f32, "N = {agents}, {missing} missing");
    }
}

#[test]
fn the_numbers_of_an_episode_are_pinned() {
    // Any change here changes every run: raise magex_core::task::TASK_SEMANTICS with it.
    let digest = |agents: usize, spawn: Spawn, training: bool| {
        let mut env = new_env(&task(agents, spawn), streams(3), training).unwrap();
        let log = run(&mut env, &own(3, agents), 0, 80, |step, k| action(step, 0, k));
        log.iter()
            .flatten()
            .fold(0xcbf2_9ce4_8422_2325u64, |hash, &bits| (hash ^ u64::from(bits)).wrapping_mul(0x0000_0100_0000_01b3))
    };
    let digests = [
        digest(5, Spawn::Uniform, true),
        digest(20, Spawn::Lines(None), false),
        digest(50, Spawn::Authors(Some(2)), false),
        digest(128, Spawn::Uniform, false),
    ];
    assert_eq!(
        digests,
        [0xd8c7_84d6_c36c_c84a, 0x27d8_e528_94e3_e98a, 0x3ffa_eca5_f628_f6e3, 0xaa96_07d1_c8b3_eda2],
        "{digests:#x?}"
    );
}

#[test]
fn wrong_calls_are_named_and_change_nothing() {
    let task = task(5, Spawn::Uniform);
    let mut env = new_env(&task, streams(2), false).unwrap();
    let before = env.positions();
    let mut rewards = [0.0; 10];
    assert_eq!(
        env.step(&[0; 10], &mut rewards),
        Err(FieldError::new("goals", "not set; call set_goals before the first step"))
    );
    assert_eq!(env.set_goals(&[0; 10]), Err(FieldError::new("goals", "10 entries, the shape asks for 20")));
    let mut goals = own(2, 5);
    goals[6] = 5;
    assert_eq!(env.set_goals(&goals), Err(FieldError::new("goals[6]", "5 is not a ball; use an index below 5")));
    goals[6] = 4;
    goals[13] = 7;
    assert_eq!(env.set_goals(&goals), Err(FieldError::new("goals[13]", "7 is not a landmark; use an index below 5")));
    goals[13] = 0;
    env.set_goals(&goals).unwrap();
    let mut actions = [1; 10];
    actions[3] = 5;
    assert_eq!(
        env.step(&actions, &mut rewards),
        Err(FieldError::new("actions[3]", "5 is not an action; use 0 none, 1 +x, 2 -x, 3 +y, 4 -y"))
    );
    assert!(env.step(&[0; 9], &mut rewards).is_err());
    assert!(env.step(&[0; 10], &mut rewards[..9]).is_err());
    assert!(env.write_positions(&mut [0.0; 20]).is_err() && env.write_velocities(&mut [0.0; 41]).is_err());
    assert!(env.write_agent_state(&mut [0.0]).is_err() && env.write_agent_state(&mut []).is_ok());
    assert_eq!((env.positions(), env.steps), (before, 0));
    for _ in 0..task.horizon {
        env.step(&[0; 10], &mut rewards).unwrap();
    }
    assert_eq!(
        env.step(&[0; 10], &mut rewards),
        Err(FieldError::new("step", "the episode is over after 100 steps; start a new batch"))
    );
    let mut positions = [0.0; 20];
    positions[19] = f32::NAN;
    let bad = env_from_state(&task, &positions, &[0.0; 20], &[0.0; 10]);
    assert_eq!(bad.err(), Some(FieldError::new("positions[19]", "NaN is not finite")));
    assert!(env_from_state(&task, &[0.0; 10], &[0.0; 20], &[0.0; 10]).is_err());
    let mut task = task;
    task.settings = TaskSettings::PushBall(PushBallConfig { start_in_line_fraction: 1.5, ..PushBallConfig::default() });
    assert!(
        new_env(&task, streams(1), true).err().unwrap().to_string().contains("task.push_ball.start_in_line_fraction")
    );
}

#[test]
fn a_batch_of_nothing_is_fine() {
    let mut env = new_env(&task(5, Spawn::Uniform), streams(0), false).unwrap();
    env.set_goals(&[]).unwrap();
    env.step(&[], &mut []).unwrap();
    assert_eq!((env.shape.episodes, env.positions().len(), env.scores().len()), (0, 0, 0));
}
