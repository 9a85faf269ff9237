use super::*;
use candle_core::Device;
use magex_core::about::About;
use magex_nets::distribution::ActionHeads;

/// The gradient of a scalar against finite differences, entry by entry.
fn check(start: &[f32], shape: &[usize], f: &dyn Fn(&Tensor) -> Tensor) {
    let v = Var::from_tensor(&Tensor::from_slice(start, shape, &Device::Cpu).unwrap()).unwrap();
    let grads = f(v.as_tensor()).backward().unwrap();
    let grad = grads.get(&v).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
    for i in 0..start.len() {
        let value = |delta: f32| {
            let mut moved = start.to_vec();
            moved[i] += delta;
            let x = Tensor::from_slice(&moved, shape, &Device::Cpu).unwrap();
            f64::from(f(&x).to_scalar::<f32>().unwrap())
        };
        let numeric = (value(2e-3) - value(-2e-3)) / 4e-3;
        assert!((numeric - f64::from(grad[i])).abs() < 2e-3, "entry {i}: {numeric} against {}", grad[i]);
    }
}

fn vector(values: &[f32]) -> Tensor {
    column(values.to_vec()).unwrap()
}

#[test]
fn the_gradient_of_the_policy_loss_is_its_slope_inside_and_outside_the_clip_range() {
    let heads = ActionHeads::new(vec![3, 2]).unwrap();
    let logits = [0.3, -0.2, 0.5, 0.1, 0.9, 1.0, 0.0, -1.0, 0.4, 0.2, 0.0, 0.7, 0.1, -0.3, 0.3];
    check(&logits, &[3, 5], &|x| {
        let now = ops::action_log_probs(x, vec![0, 1, 2, 0, 1, 1], &heads).unwrap();
        let old = vector(&[-1.5, -2.9, -1.2]);
        let ratio = ops::exp(&(now.get(0).unwrap() - old).unwrap()).unwrap();
        let surrogate = clipped_surrogate(&ratio, &vector(&[1.3, -0.7, -2.0]), 0.2).unwrap();
        let entropy = (now.get(1).unwrap() * 0.05).unwrap();
        ((surrogate + entropy).unwrap().sum_all().unwrap() * -0.5).unwrap()
    });
}

#[test]
fn the_clipped_surrogate_matches_hand_computed_values_and_has_no_gradient_beyond_the_clip_range() {
    // A > 0: min(1.5·2, 1.2·2); A < 0: min(0.5·−1, 0.8·−1); inside the range and at ρ = 1 nothing is clipped.
    let ratio = Var::from_tensor(&vector(&[1.5, 0.5, 1.5, 1.1, 1.0])).unwrap();
    let surrogate = clipped_surrogate(&ratio, &vector(&[2.0, -1.0, -1.0, 3.0, 4.0]), 0.2).unwrap();
    let expected: [f32; 5] = [2.4, -0.8, -1.5, 3.3, 4.0];
    for (a, b) in surrogate.to_vec1::<f32>().unwrap().into_iter().zip(expected) {
        assert!((a - b).abs() < 1e-6, "{a} and {b}");
    }
    let grads = surrogate.sum_all().unwrap().backward().unwrap();
    assert_eq!(grads.get(&ratio).unwrap().to_vec1::<f32>().unwrap(), [0.0, 0.0, -1.0, 3.0, 4.0]);
}

#[test]
fn the_gradient_of_the_value_loss_is_its_slope_and_the_loss_is_linear_beyond_delta() {
    let (old, targets) = (vector(&[0.0, 0.0, 1.0, 0.5]), vector(&[1.0, -1.0, 1.05, 30.0]));
    check(&[0.1, 0.5, 0.9, 0.4], &[4], &|x| {
        (clipped_value_loss(x, &old, &targets, 0.2, 10.0).unwrap().sum_all().unwrap() * 0.25).unwrap()
    });
    let loss = clipped_value_loss(&vector(&[0.4]), &vector(&[0.4]), &vector(&[30.4]), 0.2, 10.0).unwrap();
    assert!((loss.to_vec1::<f32>().unwrap()[0] - 250.0).abs() < 1e-3);
}

/// Samples from the logits and keeps what it chose, with its log-probability.
struct Sampler {
    heads: magex_nets::distribution::ActionHeads,
    stream: magex_core::rng::Stream,
    actions: Vec<u8>,
    log_probs: Vec<f32>,
}

impl magex_nets::executor::Chooser for Sampler {
    fn choose(&mut self, row: usize, logits: &[f32]) -> &[u8] {
        let action = &mut self.actions[row..=row];
        self.log_probs[row] = self.heads.choose(logits, Some(&mut self.stream), action);
        &self.actions[row..=row]
    }
}

/// The share of copies after training. The first agent is paid nothing and its entropy keeps it random; the second one is paid
/// for doing the same. Nothing that it sees tells what the first one does.
fn copies(kind: magex_core::config::ExecutorKind) -> f64 {
    use magex_core::task::{RewardTarget, Spawn, TaskConfig};
    let (episodes, rounds) = (256, 40);
    let mut config = RunConfig {
        task: TaskConfig {
            horizon: 1,
            reward_target: RewardTarget::Team,
            ..TaskConfig::simple_spread(2, Spawn::Uniform)
        },
        ..RunConfig::default()
    };
    config.executor.kind = kind;
    config.executor.hidden = 16;
    (config.mappo.minibatch_size, config.mappo.entropy_coef, config.mappo.chunk_length) = (128, 0.05, 1);
    (config.mappo.actor_learning_rate, config.mappo.critic_learning_rate) = (3e-3, 3e-3);
    (config.collect.episodes_per_iteration, config.collect.shards_per_iteration) = (episodes, 1);
    let mappo = Mappo::new(&config.validated().unwrap()).unwrap();
    let about = About::of(&mappo.config);
    let mut learned = Learned { networks: mappo.init().unwrap(), value_norm: mappo.value_norm(), replay: None, about };
    let mut share = 0.0;
    for iteration in 0..rounds {
        let shard = crate::fixtures::train_shard(iteration, 0, episodes);
        let mut t = crate::fixtures::trajectory(&mappo.config.task, shard);
        // A joint state in which everything is where the origin is, again and again.
        let s = t.shape;
        t.positions = vec![0.0; (s.steps + 1) * s.episodes * s.bodies * s.dims];
        t.velocities.clone_from(&t.positions);
        t.actions = vec![0; s.steps * s.episodes * s.agents];
        t.statics =
            magex_core::statics::Statics::landmarks(s.landmarks, s.dims, vec![0.0; s.episodes * s.landmarks * s.dims]);
        let seen = Batch::new(1, mappo.spec(), std::slice::from_ref(&t));
        let units: Vec<(usize, usize)> = (0..s.episodes).map(|episode| (episode, 0)).collect();
        let slice = Slice { batch: &seen, units: &units, chunk: 1, samples: 1.0 };
        let constants = |network: &Network| ParamBuilder::with(network.params.tensors().unwrap());
        let policy = mappo.model.policy(&mut learned.networks.iter().map(constants).collect::<Vec<_>>()).unwrap();
        let rows = s.episodes * s.agents;
        let stream = Key::new(5, Purpose::Bench, &[iteration]).stream();
        let heads = mappo.model.heads().clone();
        let mut sampler = Sampler { heads, stream, actions: vec![0; rows], log_probs: vec![0.0; rows] };
        policy.act(&slice.input(&slice.features(), Vec::new(), GraphNoise::Off), &mut sampler).unwrap();
        (t.actions, t.log_probs) = (sampler.actions, sampler.log_probs);
        t.rewards = t.actions.chunks_exact(2).flat_map(|pair| [0.0, f32::from(u8::from(pair[0] == pair[1]))]).collect();
        share = f64::from(t.rewards.iter().sum::<f32>()) / s.episodes as f64;
        let batch = Batch::new(1, mappo.spec(), &[t]);
        mappo.update(&mut learned, &batch, iteration, 0.0).unwrap();
    }
    share
}

#[test]
fn only_an_agent_that_is_told_what_the_one_before_it_does_can_copy_it() {
    use magex_core::config::ExecutorKind::{Mat, MatDec};
    let (mat, mat_dec) = (copies(Mat), copies(MatDec));
    assert!(mat > 0.9, "MAT copies {mat}");
    assert!(mat_dec < 0.4, "MAT-Dec copies {mat_dec}, chance is 0.2");
}

/// A trajectory of agents anywhere, with the log-probabilities that the networks give.
fn anywhere(mappo: &Mappo, learned: &Learned, episodes: u32) -> Batch {
    let mut t = crate::fixtures::trajectory(&mappo.config.task, crate::fixtures::train_shard(0, 0, episodes));
    let s = t.shape;
    let mut stream = Key::new(6, Purpose::Bench, &[]).stream();
    let mut numbers = |count: usize| (0..count).map(|_| stream.normal() as f32).collect::<Vec<f32>>();
    t.positions = numbers((s.steps + 1) * s.episodes * s.bodies * s.dims);
    t.velocities = numbers(t.positions.len());
    t.rewards = numbers(s.steps * s.episodes * s.agents);
    t.statics =
        magex_core::statics::Statics::landmarks(s.landmarks, s.dims, numbers(s.episodes * s.landmarks * s.dims));
    t.actions = numbers(s.steps * s.episodes * s.agents).iter().map(|x| (x.abs() * 10.0) as u8 % 5).collect();
    let mut batch = Batch::new(1, mappo.spec(), &[t]);
    batch.log_probs = mappo.log_probs(learned, &batch).unwrap();
    batch
}

#[test]
fn threads_do_not_reach_a_number_and_the_first_ratio_is_exactly_one() {
    use magex_core::config::ExecutorKind::{Flat, Local, Magex};
    use magex_core::task::{RewardTarget, Spawn, TaskConfig};
    for (kind, recurrent) in [(Local, false), (Magex, false), (Flat, false), (Flat, true)] {
        let reward_target = if kind == Flat { RewardTarget::Team } else { RewardTarget::Goals };
        let task = TaskConfig { horizon: 20, reward_target, ..TaskConfig::simple_spread(7, Spawn::Uniform) };
        let mut config = RunConfig { task, ..RunConfig::default() };
        (config.executor.kind, config.executor.recurrent) = (kind, recurrent);
        (config.mappo.minibatch_size, config.mappo.chunk_length) = (280, 5);
        config.collect.shards_per_iteration = 1;
        config.collect.episodes_per_iteration = 6;
        let mappo = Mappo::new(&config.validated().unwrap()).unwrap();
        let about = About::of(&mappo.config);
        let fresh = || Learned {
            networks: mappo.init().unwrap(),
            value_norm: mappo.value_norm(),
            replay: None,
            about: about.clone(),
        };
        let batch = anywhere(&mappo, &fresh(), 6);
        let run = |threads: usize| {
            let mut learned = fresh();
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).stack_size(64 << 20).build().unwrap();
            let stats = pool.install(|| mappo.update(&mut learned, &batch, 0, 0.0)).unwrap();
            (learned, format!("{stats:?}"))
        };
        let (one, stats) = run(1);
        assert!(one != fresh(), "{kind}: nothing was learned");
        assert!((one, stats.clone()) == run(2), "{kind}, recurrent {recurrent}: two threads give other bits");
        assert!(stats.contains("(\"first_ratio_error\", 0.0)"), "{kind}, recurrent {recurrent}: {stats}");
    }
}
