use super::*;
use crate::fixtures::{train_shard, trajectory};
use magex_core::config::QmixConfig;
use magex_core::rng::{Key, Purpose};
use magex_core::task::{Spawn, TaskConfig, TaskName};

fn config(task: TaskConfig, capacity: usize) -> RunConfig {
    let mut config = RunConfig { task, ..RunConfig::default() };
    config.qmix = QmixConfig { buffer_episodes: capacity, ..QmixConfig::default() };
    (config.collect.episodes_per_iteration, config.collect.shards_per_iteration) = (4, 2);
    config
}

fn spread() -> TaskConfig {
    TaskConfig { horizon: 3, ..TaskConfig::simple_spread(2, Spawn::Uniform) }
}

/// Two shards whose numbers say where they are: iteration, episode, step.
fn shards(iteration: u32) -> Vec<Trajectory> {
    let of = |index: u32| {
        let mut t = trajectory(&spread(), train_shard(iteration, index, 2));
        let name = |step: usize, b: usize| (iteration * 100 + (index * 2 + b as u32) * 10 + step as u32) as f32;
        let (s, joint) = (t.shape, t.shape.bodies * t.shape.dims);
        for (place, x) in t.positions.iter_mut().enumerate() {
            *x = name(place / (s.episodes * joint), place / joint % s.episodes);
        }
        for (place, x) in t.rewards.iter_mut().enumerate() {
            *x = name(place / (s.episodes * 2), place / 2 % s.episodes) + [-1.0, 1.0][place % 2];
        }
        t.statics.0[0].values.iter_mut().enumerate().for_each(|(place, x)| *x = name(0, place / 4));
        t
    };
    vec![of(0), of(1)]
}

fn filled(capacity: usize, iterations: u32) -> Replay {
    let mut replay = Replay::new(&config(spread(), capacity));
    (0..iterations).for_each(|iteration| replay.push(iteration, &shards(iteration)).unwrap());
    replay
}

#[test]
fn it_keeps_the_newest_episodes_and_gathers_them_side_by_side() {
    let replay = filled(6, 3);
    assert_eq!((replay.len(), replay.index().keys().copied().collect::<Vec<_>>()), (6, vec![1, 2]));
    // The oldest that is left is the third of iteration 1.
    let episodes = replay.gather(&[0, 5]);
    assert_eq!(episodes.rewards, [120.0, 230.0, 121.0, 231.0, 122.0, 232.0]);
    let firsts: Vec<f32> = episodes.positions.chunks_exact(4).map(|joint| joint[0]).collect();
    assert_eq!(firsts, [120.0, 230.0, 121.0, 231.0, 122.0, 232.0, 123.0, 233.0]);
    assert_eq!(episodes.statics.get("landmarks"), [[120.0; 4], [230.0; 4]].concat());
    assert_eq!((episodes.goals.len(), episodes.actions.len()), (4, 12));
}

#[test]
fn a_draw_has_no_episode_twice_and_finds_all() {
    let replay = filled(6, 3);
    let mut seen = [0; 6];
    for k in 0..600 {
        let mut drawn = replay.draw(&mut Key::new(1, Purpose::Replay, &[k, 0]).stream(), 2);
        drawn.iter().for_each(|&episode| seen[episode] += 1);
        drawn.dedup();
        assert_eq!(drawn.len(), 2);
    }
    assert!(seen.iter().all(|n| (150..250).contains(n)), "{seen:?}");
    assert_eq!(replay.draw(&mut Key::new(1, Purpose::Replay, &[]).stream(), 9).len(), 6);
}

#[test]
fn files_bring_the_same_buffer_back_and_damage_is_named() {
    let replay = filled(6, 3);
    let mut again = filled(6, 0);
    for block in replay.blocks() {
        again.restore(block.iteration, &block.sha256, &block.encode().unwrap()).unwrap();
    }
    assert_eq!(again, replay);
    let block = replay.blocks().next().unwrap();
    let mut bytes = block.encode().unwrap();
    assert_eq!(filled(6, 0).restore(1, "other", &bytes).unwrap_err(), "its checksum differs from state.json");
    // One of another team.
    let mut other = Replay::new(&config(TaskConfig { horizon: 3, ..TaskConfig::simple_spread(3, Spawn::Uniform) }, 6));
    let error = other.restore(1, &block.sha256, &bytes).unwrap_err();
    assert!(error.contains("positions is F32 [4, 4, 2, 2], expected F32 [4, 4, 3, 2]"), "{error}");
    bytes.truncate(50);
    assert!(other.restore(1, &sha256::hex(&bytes), &bytes).is_err());
}

#[test]
fn a_full_buffer_takes_what_it_says() {
    for task in [spread(), TaskConfig { horizon: 3, ..TaskConfig::of(TaskName::Drones, 2, Spawn::Uniform) }] {
        let config = config(task, 8);
        let s = config.task.shape(4);
        let mut t = trajectory(&spread(), train_shard(0, 0, 4));
        t.shape = s;
        t.positions = vec![0.0; 4 * 4 * s.bodies * s.dims];
        t.velocities.clone_from(&t.positions);
        t.agent_state = vec![0.0; 4 * 4 * s.agents * s.agent_state];
        t.actions = vec![0; 3 * 4 * s.agents * s.action_components];
        t.statics = Statics::landmarks(s.landmarks, s.dims, vec![0.0; 4 * s.landmarks * s.dims]);
        let block = Block::of(0, s, &[t]);
        let numbers = [&block.positions, &block.velocities, &block.agent_state, &block.rewards].map(Vec::len);
        let words = numbers.iter().sum::<usize>() + block.goals.len() + block.statics.get("landmarks").len();
        assert_eq!(Replay::episode_bytes(&config), ((4 * words + block.actions.len()) / 4) as u64);
        assert_eq!(Replay::bytes(&config), 8 * Replay::episode_bytes(&config));
    }
    // The promise: 5000 episodes of 50 agents and 120 steps within 2 GiB.
    let large = RunConfig { task: TaskConfig::simple_spread(50, Spawn::Uniform), ..RunConfig::default() };
    assert!(Replay::bytes(&large) < 2 << 30, "{}", Replay::bytes(&large));
}
