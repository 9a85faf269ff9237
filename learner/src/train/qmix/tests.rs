use super::*;
use crate::fixtures::{train_shard, trajectory};
use crate::train::learned::Moments;
use magex_core::about::About;
use magex_core::task::{RewardTarget, Spawn, TaskConfig, TaskName};
use magex_core::trajectory::Trajectory;

fn config(algorithm: Algorithm, task: TaskConfig, episodes: u32) -> RunConfig {
    let mut config =
        RunConfig { task: TaskConfig { reward_target: RewardTarget::Team, ..task }, ..RunConfig::default() };
    config.mappo = magex_core::config::MappoConfig::default();
    config.run.algorithm = algorithm;
    (config.executor.kind, config.executor.recurrent, config.executor.hidden) =
        (magex_core::config::ExecutorKind::Flat, true, 16);
    config.collect.episodes_per_iteration = episodes;
    config.collect.shards_per_iteration = 1;
    (config.qmix.batch_episodes, config.qmix.mixer_hidden) = (4, 8);
    if algorithm == Algorithm::Maser {
        config.maser.distance_hidden = 16;
    }
    config.validated().unwrap()
}

/// Episodes in which everything differs, and a buffer that holds them.
fn buffer(config: &RunConfig) -> Replay {
    let mut stream = Key::new(3, Purpose::Bench, &[]).stream();
    let heads = config.task.action_heads();
    let mut t = random(&config.task, config.collect.episodes_per_iteration, &mut stream, 0);
    for (place, action) in t.actions.iter_mut().enumerate() {
        *action = stream.below(heads[place % heads.len()] as u32) as u8;
    }
    let mut replay = Replay::new(config);
    replay.push(0, &[t]).unwrap();
    replay
}

fn random(task: &TaskConfig, episodes: u32, stream: &mut magex_core::rng::Stream, iteration: u32) -> Trajectory {
    let mut t = trajectory(task, train_shard(iteration, 0, episodes));
    let s = t.shape;
    t.positions = vec![0.0; (s.steps + 1) * s.episodes * s.bodies * s.dims];
    t.velocities.clone_from(&t.positions);
    t.agent_state = vec![0.0; (s.steps + 1) * s.episodes * s.agents * s.agent_state];
    t.actions = vec![0; s.steps * s.episodes * s.agents * s.action_components];
    t.statics =
        magex_core::statics::Statics::landmarks(s.landmarks, s.dims, vec![0.0; s.episodes * s.landmarks * s.dims]);
    let arrays = [&mut t.positions, &mut t.velocities, &mut t.agent_state, &mut t.rewards, &mut t.statics.0[0].values];
    arrays.into_iter().flatten().for_each(|x| *x = stream.normal() as f32);
    t
}

/// The slope of the loss along every network that is trained, and of what a batch's two halves add up to.
#[test]
fn the_gradients_of_the_losses_are_their_slopes() {
    let spread = || TaskConfig { horizon: 4, ..TaskConfig::simple_spread(3, Spawn::Uniform) };
    let drones = || TaskConfig { horizon: 3, ..TaskConfig::of(TaskName::Drones, 2, Spawn::Uniform) };
    for (algorithm, task, lambda, recurrent) in [
        (Algorithm::Qmix, spread(), 0.0, true),
        (Algorithm::Qmix, drones(), 0.0, false),
        // No gradient flows through the intrinsic reward: the distance has the slope of the loss only without it.
        (Algorithm::Maser, spread(), 0.0, true),
        (Algorithm::Maser, spread(), 0.3, true),
        (Algorithm::Maser, drones(), 0.0, true),
    ] {
        let mut config = config(algorithm, task, 4);
        config.executor.recurrent = recurrent;
        (config.maser.lambda, config.maser.loss_factor) = (lambda, 1.0);
        (config.maser.individual_coef, config.maser.exploration_coef, config.maser.distance_coef) = (0.8, 3.0, 0.7);
        if algorithm == Algorithm::Qmix {
            config.maser = magex_core::config::MaserConfig::default();
        }
        let qmix = Qmix::new(&config).unwrap();
        let mut networks = qmix.init().unwrap();
        // Targets that differ from the live networks.
        let count = qmix.model.parts().len();
        networks[count..].iter_mut().flat_map(|n| &mut n.params.values).for_each(|x| *x *= 0.7);
        let replay = buffer(&config);
        let run = |networks: &[Network], episodes: &[usize]| qmix.slice(networks, &replay.gather(episodes), 4).unwrap();
        let (gradients, sums) = run(&networks, &[0, 1, 2, 3]);
        let (halves, mut both) = ([run(&networks, &[0, 1]), run(&networks, &[2, 3])], Sums::default());
        halves.iter().for_each(|(_, sums)| both.add(sums));
        assert!((both.loss(&config) - sums.loss(&config)).abs() < 1e-5, "{algorithm}");
        for k in 0..count {
            let total = sum_in_order(halves.iter().map(|(gradients, _)| &gradients[k]));
            let gap = total.iter().zip(&gradients[k]).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(gap < 1e-5, "{algorithm} network {k}: {gap}");
            if k == 2 && lambda > 0.0 {
                continue;
            }
            // Along a direction that is near the gradient's, so that the slope is not lost in rounding.
            let direction: Vec<f32> =
                gradients[k].iter().enumerate().map(|(i, g)| g * [1.0, 0.3, 1.7][i % 3]).collect();
            let length = direction.iter().map(|x| x * x).sum::<f32>().sqrt();
            let slope: f32 = direction.iter().zip(&gradients[k]).map(|(d, g)| d * g / length).sum();
            let loss = |by: f32| {
                let mut moved = networks.clone();
                let values = moved[k].params.values.iter_mut();
                values.zip(&direction).for_each(|(x, d)| *x += by * d / length);
                run(&moved, &[0, 1, 2, 3]).1.loss(&config)
            };
            let numeric = (loss(2e-3) - loss(-2e-3)) / 4e-3;
            let gap = (numeric - f64::from(slope)).abs();
            assert!(gap < 0.02 * f64::from(slope) + 1e-4, "{algorithm} network {k}: {numeric} against {slope}");
            assert!(slope > 1e-3, "{algorithm} network {k} has no gradient");
        }
    }
}

#[test]
fn the_released_code_of_maser_trains_no_distance() {
    let task = TaskConfig { horizon: 4, ..TaskConfig::simple_spread(3, Spawn::Uniform) };
    let mut config = config(Algorithm::Maser, task, 4);
    config.maser.trained_distance = false;
    let mut other = config.clone();
    (other.maser.exploration_coef, other.maser.distance_coef) = (50.0, 70.0);
    let (qmix, other) = (Qmix::new(&config).unwrap(), Qmix::new(&other).unwrap());
    let (networks, replay) = (qmix.init().unwrap(), buffer(&config));
    assert_eq!(networks[2].moments, Moments::default());
    let gradients = |qmix: &Qmix| qmix.slice(&networks, &replay.gather(&[0, 1, 2, 3]), 4).unwrap().0;
    assert!(gradients(&qmix)[2].is_empty());
    // Two losses are reported and change nothing.
    assert_eq!(gradients(&qmix), gradients(&other));
}

/// Two agents, one step: the payoff grows with what each of them does, but not as a sum.
#[test]
fn it_solves_a_monotone_matrix_game() {
    let task = TaskConfig { horizon: 1, ..TaskConfig::simple_spread(2, Spawn::Uniform) };
    let mut config = config(Algorithm::Qmix, task, 32);
    (config.qmix.gamma, config.qmix.learning_rate, config.qmix.batch_episodes) = (0.0, 3e-3, 32);
    config.executor.recurrent = false;
    let config = config.validated().unwrap();
    let (first, second) = ([0.0, 1.0, 3.0, 2.0, 0.5], [1.0, 0.2, 0.0, 0.4, 2.0]);
    let payoff = |a: u8, b: u8| first[usize::from(a)] * second[usize::from(b)] + second[usize::from(b)];
    let qmix = Qmix::new(&config).unwrap();
    let mut learned = Learned {
        networks: qmix.init().unwrap(),
        value_norm: crate::train::gae::ValueNorm::new(false),
        replay: Some(qmix.replay()),
        about: About::of(&config),
    };
    let mut stream = Key::new(3, Purpose::Bench, &[]).stream();
    let mut loss = f64::NAN;
    for iteration in 0..30 {
        let mut t = random(&config.task, 32, &mut stream, iteration);
        [&mut t.positions, &mut t.velocities, &mut t.statics.0[0].values].into_iter().flatten().for_each(|x| *x = 0.0);
        t.actions.iter_mut().for_each(|action| *action = stream.below(5) as u8);
        t.rewards = t.actions.chunks_exact(2).flat_map(|a| [payoff(a[0], a[1]); 2]).collect();
        loss = qmix.update(&mut learned, &[t], iteration).unwrap().get("td_loss").unwrap();
    }
    assert!(loss < 0.1, "{loss}");
    let mut params = ParamBuilder::with(learned.networks[0].params.tensors().unwrap());
    let agent = qmix.model.q_network(&mut params).unwrap();
    let episodes = learned.replay.unwrap().gather(&[0]);
    let features = qmix.model.spec().compute(&JointState {
        positions: &episodes.positions,
        velocities: &episodes.velocities,
        agent_state: &[],
        world_states: &[],
        masks: &[],
        marks: &[],
        statics: episodes.statics.view(),
        goals: &episodes.goals,
    });
    let vectors = &features.vectors[..features.vectors.len() / 2];
    let values = plain(&agent.values(vectors, &[], 1).unwrap()).unwrap();
    let mut best = [0u8; 2];
    qmix.model.heads().best(&values[..5], &mut best[..1]);
    qmix.model.heads().best(&values[5..], &mut best[1..]);
    assert_eq!(best, [2, 4], "{values:?}");
}

#[test]
fn a_batch_that_is_not_finite_changes_nothing_and_is_counted() {
    let task = TaskConfig { horizon: 4, ..TaskConfig::simple_spread(3, Spawn::Uniform) };
    let mut config = config(Algorithm::Qmix, task, 4);
    config.qmix.target_update_every = 1000;
    let qmix = Qmix::new(&config).unwrap();
    let mut networks = qmix.init().unwrap();
    networks[3].params.values[0] = f32::INFINITY;
    let value_norm = crate::train::gae::ValueNorm::new(false);
    let mut learned = Learned { networks, value_norm, replay: Some(qmix.replay()), about: About::of(&config) };
    let before = learned.networks.clone();
    let t = random(&config.task, 4, &mut Key::new(3, Purpose::Bench, &[]).stream(), 0);
    let stats = qmix.update(&mut learned, &[t], 0).unwrap();
    assert_eq!((stats.get("skipped_gradient_steps"), stats.get("gradient_steps")), (Some(4.0), Some(0.0)));
    assert_eq!(learned.networks, before);
}

#[test]
fn targets_are_copied_as_often_as_the_configuration_says() {
    let task = TaskConfig { horizon: 2, ..TaskConfig::simple_spread(2, Spawn::Uniform) };
    let mut config = config(Algorithm::Qmix, task, 4);
    config.qmix.target_update_every = 6;
    let qmix = Qmix::new(&config).unwrap();
    let value_norm = crate::train::gae::ValueNorm::new(false);
    let mut learned =
        Learned { networks: qmix.init().unwrap(), value_norm, replay: Some(qmix.replay()), about: About::of(&config) };
    let start = learned.networks.clone();
    let mut stream = Key::new(3, Purpose::Bench, &[]).stream();
    let mut update = |learned: &mut Learned, iteration| {
        let t = random(&config.task, 4, &mut stream, iteration);
        qmix.update(learned, &[t], iteration).unwrap();
    };
    update(&mut learned, 0);
    assert!(learned.networks[0] != start[0] && learned.networks[2..] == start[2..]);
    update(&mut learned, 1);
    // After episode 6 of 8: neither the first networks nor the present ones.
    assert!(learned.networks[2].params != start[2].params);
    assert!(learned.networks[2].params.values != learned.networks[0].params.values);
    update(&mut learned, 2);
    // After episode 12, the last.
    assert_eq!(learned.networks[2].params.values, learned.networks[0].params.values);
    assert_eq!(learned.networks[3].params.values, learned.networks[1].params.values);
}
