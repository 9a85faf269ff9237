//! Hand-written gradients against finite differences and against candle's own automatic differentiation.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]
#![allow(clippy::disallowed_methods, reason = "candle's own functions are what ours are compared with")]

mod chain;
mod support;

use candle_core::{DType, Device, Tensor, Var};
use magex_core::config::{ExecutorConfig, ExecutorKind};
use magex_core::joint_state::JointState;
use magex_core::rng::{Key, Purpose};
use magex_core::statics::Statics;
use magex_core::task::{Spawn, TaskConfig, TaskName};
use magex_nets::distribution::ActionHeads;
use magex_nets::executor::{Input, build, feature_spec};
use magex_nets::ops::{self, Activation, GraphBlock, GraphNoise};
use magex_nets::params::{Init, ParamBuilder, Params};
use std::sync::Arc;
use support::{check, normal, probe, var};

#[test]
fn attention_and_gelu() {
    for (heads, causal) in [(1, false), (2, true), (4, true)] {
        let [q, k, v] = [1, 2, 3].map(|tag| var(&[15, 8], tag));
        let shape = ops::Attention { agents: 5, heads, causal, scale: 0.5 };
        check(&[&q, &k, &v], &|| ops::attention(&q, &k, &v, shape).unwrap());
        // The same by candle's own operations.
        let split =
            |x: &Var| x.reshape((3, 5, heads, 8 / heads)).unwrap().transpose(1, 2).unwrap().contiguous().unwrap();
        let scores = (split(&q).matmul(&split(&k).t().unwrap().contiguous().unwrap()).unwrap() * 0.5).unwrap();
        let hidden: Vec<f32> =
            (0..25).map(|at| if causal && at % 5 > at / 5 { f32::NEG_INFINITY } else { 0.0 }).collect();
        let mask = Tensor::from_vec(hidden, (1, 1, 5, 5), &Device::Cpu).unwrap();
        let weights = candle_nn::ops::softmax_last_dim(&scores.broadcast_add(&mask).unwrap()).unwrap();
        let mixed = weights.matmul(&split(&v)).unwrap().transpose(1, 2).unwrap().reshape((15, 8)).unwrap();
        let gap = (mixed - ops::attention(&q, &k, &v, shape).unwrap()).unwrap().abs().unwrap();
        assert!(gap.max_all().unwrap().to_scalar::<f32>().unwrap() < 1e-5);
    }
    let x = var(&[3, 21], 4);
    check(&[&x], &|| ops::gelu(&x).unwrap());
    let gap = (ops::gelu(&x).unwrap() - x.gelu().unwrap()).unwrap().abs().unwrap();
    assert!(gap.max_all().unwrap().to_scalar::<f32>().unwrap() < 1e-5);
}

#[test]
fn linear_and_norm() {
    let (x, w, b) = (var(&[6, 5], 1), var(&[5, 7], 2), var(&[7], 3));
    for act in [Activation::Identity, Activation::Relu, Activation::Tanh] {
        check(&[&x, &w, &b], &|| ops::linear(&x, &w, &b, act, false).unwrap());
    }
    let (scale, shift) = (var(&[5], 4), var(&[5], 5));
    check(&[&x, &scale, &shift], &|| ops::layer_norm(&x, &scale, &shift).unwrap());
    check(&[&x], &|| ops::with_mean_of_others(&x, 3).unwrap());
}

#[test]
fn mixing_distances_and_elu() {
    for (rows, inputs, units) in [(3, 5, 32), (4, 2, 1), (2, 3, 21)] {
        let (x, w, b) = (var(&[rows, inputs], 1), var(&[rows, inputs * units], 2), var(&[rows, units], 3));
        let y = || ops::mix(&x, &w, &b).unwrap();
        check(&[&x, &w, &b], &y);
        // The same by candle's own operations.
        let product = x.reshape((rows, 1, inputs)).unwrap().matmul(&w.reshape((rows, inputs, units)).unwrap()).unwrap();
        let gap = (product.reshape((rows, units)).unwrap() + b.as_tensor() - y()).unwrap().abs().unwrap();
        assert!(gap.max_all().unwrap().to_scalar::<f32>().unwrap() < 1e-5);
        assert!(ops::mix(&x, &b, &b).is_err() || inputs == 1);
    }
    let x = var(&[6, 5], 4);
    // Row 2 is its own other: its distance is zero, and so is its gradient.
    check(&[&x], &|| ops::row_distances(&x, vec![1, 0, 2, 1, 1, 4]).unwrap());
    let to_itself = ops::row_distances(&x, (0..6).collect()).unwrap();
    assert_eq!(to_itself.to_vec1::<f32>().unwrap(), [0.0; 6]);
    let gradient = to_itself.sum_all().unwrap().backward().unwrap().get(&x).unwrap().flatten_all().unwrap();
    assert_eq!(gradient.to_vec1::<f32>().unwrap(), [0.0; 30]);
    assert!(ops::row_distances(&x, vec![0, 1, 2, 3, 4, 6]).is_err());
    let x = var(&[3, 21], 5);
    check(&[&x], &|| ops::clamp(&x, -0.713, 0.317).unwrap());
    let gap = (ops::clamp(&x, -0.7, 0.3).unwrap() - x.clamp(-0.7, 0.3).unwrap()).unwrap().abs().unwrap();
    assert!(gap.max_all().unwrap().to_scalar::<f32>().unwrap() == 0.0);
    check(&[&x], &|| ops::elu(&x).unwrap());
    let gap = (ops::elu(&x).unwrap() - x.elu(1.0).unwrap()).unwrap().abs().unwrap();
    assert!(gap.max_all().unwrap().to_scalar::<f32>().unwrap() < 1e-6);
}

/// A unit of 16 on 5 inputs whose parameters stand one after the other in `parameters`.
fn unit(parameters: &Var) -> ops::Gru {
    let mut builder = ParamBuilder::with(vec![parameters.as_tensor().clone()]);
    ops::Gru::build("gru", (5, 16), [Init::Constant(0.0); 4], &mut builder).unwrap()
}

#[test]
fn recurrent_unit() {
    let (x, h0) = (var(&[4 * 3, 5], 1), normal(3 * 16, 4));
    let p = var(&[5 * 48 + 48 + 16 * 48 + 48], 2);
    let p = Var::from_tensor(&(p.as_tensor() * 0.3).unwrap()).unwrap();
    check(&[&x, &p], &|| unit(&p).forward(&x, h0.clone(), Vec::new()).unwrap());
    // Sequences that begin anew: at the first step, in the middle, at the last one.
    let mut firsts = vec![0; 4 * 3];
    [2, 3, 7, 9].into_iter().for_each(|place| firsts[place] = 1);
    check(&[&x, &p], &|| unit(&p).forward(&x, h0.clone(), firsts.clone()).unwrap());
    // They are those of a sequence of their own.
    let whole = unit(&p).forward(&x, h0.clone(), firsts).unwrap();
    let rows = Tensor::cat(&[x.narrow(0, 3, 1).unwrap(), x.narrow(0, 6, 1).unwrap()], 0).unwrap();
    let own = unit(&p).forward(&rows, vec![0.0; 16], Vec::new()).unwrap();
    let numbers = |x: &Tensor| x.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    assert_eq!(
        numbers(&whole.reshape((4, 3, 16)).unwrap().narrow(0, 1, 2).unwrap().narrow(1, 0, 1).unwrap()),
        numbers(&own)
    );
    assert!(unit(&p).forward(&x, vec![0.0; 17], Vec::new()).is_err());
    assert!(unit(&p).forward(&x, vec![0.0; 5 * 16], Vec::new()).is_err());
}

/// More rows than pass through the steps at once, and more steps than the gradient of the weights takes in at once.
#[test]
fn recurrent_unit_as_candle_computes_it() {
    let (steps, rows, inputs, hidden) = (7, 101, 5, 16);
    let (x, h0) = (var(&[steps * rows, inputs], 1), normal(rows * hidden, 4));
    let p = var(&[5 * 48 + 48 + 16 * 48 + 48], 2);
    let p = Var::from_tensor(&(p.as_tensor() * 0.3).unwrap()).unwrap();
    let weight = var(&[steps * rows, hidden], 3);
    let ours = unit(&p).forward(&x, h0.clone(), Vec::new()).unwrap();
    let part =
        |from: usize, shape: (usize, usize)| p.narrow(0, from, shape.0 * shape.1).unwrap().reshape(shape).unwrap();
    let (w_x, b_x, w_h, b_h) = (part(0, (5, 48)), part(240, (1, 48)), part(288, (16, 48)), part(1056, (1, 48)));
    let mut h = Tensor::from_vec(h0, (rows, hidden), &Device::Cpu).unwrap();
    let mut states = Vec::new();
    for t in 0..steps {
        let x = x.narrow(0, t * rows, rows).unwrap();
        let of_input = x.matmul(&w_x).unwrap().broadcast_add(&b_x).unwrap().chunk(3, 1).unwrap();
        let of_state = h.matmul(&w_h).unwrap().broadcast_add(&b_h).unwrap().chunk(3, 1).unwrap();
        let gate = |at: usize| candle_nn::ops::sigmoid(&(&of_input[at] + &of_state[at]).unwrap()).unwrap();
        let (reset, update) = (gate(0), gate(1));
        let new = (&of_input[2] + (reset * &of_state[2]).unwrap()).unwrap().tanh().unwrap();
        h = (&new + (update * (h - &new).unwrap()).unwrap()).unwrap();
        states.push(h.clone());
    }
    let theirs = Tensor::cat(&states, 0).unwrap();
    let gap = |a: &Tensor, b: &Tensor| (a - b).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
    assert!(gap(&ours, &theirs) < 2e-6, "{}", gap(&ours, &theirs));
    let gradients = |y: &Tensor| {
        let store = (y * weight.as_tensor()).unwrap().sum_all().unwrap().backward().unwrap();
        [&x, &p].map(|of| store.get(of.as_tensor()).unwrap().clone())
    };
    for (ours, theirs) in gradients(&ours).iter().zip(&gradients(&theirs)) {
        let size = theirs.abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
        assert!(gap(ours, theirs) < 2e-6 * size, "{} of {size}", gap(ours, theirs));
    }
}

#[test]
fn log_densities_of_actions_have_the_bits_of_the_draw() {
    let (rows, outputs) = (5, var(&[5, 6], 1));
    let heads = ActionHeads::gaussian(3);
    let mut stream = Key::new(1, Purpose::Action, &[]).stream();
    let values = outputs.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let (mut moves, mut drawn) = (vec![0.0; rows * 3], Vec::new());
    for (row, moves) in values.chunks_exact(6).zip(moves.chunks_exact_mut(3)) {
        drawn.push(heads.draw(row, Some(&mut stream), moves));
    }
    let both = ops::action_log_densities(&outputs, moves.clone()).unwrap();
    assert_eq!(both.get(0).unwrap().to_vec1::<f32>().unwrap(), drawn);
    check(&[&outputs], &|| ops::action_log_densities(&outputs, moves.clone()).unwrap());
    // A standard normal: -ln 2π / 2 - u² / 2, and its entropy (1 + ln 2π) / 2.
    let standard = Tensor::zeros((1, 2), DType::F32, &Device::Cpu).unwrap();
    let values =
        ops::action_log_densities(&standard, vec![1.0]).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
    assert!((values[0] + 1.418_938_5).abs() < 1e-6 && (values[1] - 1.418_938_5).abs() < 1e-6);
}

/// Unlike candle's, constants get no gradient.
#[test]
fn pairs_and_huber_match_candle() {
    let (x, y) = (var(&[3, 21], 1), var(&[3, 21], 2));
    // Some are equal: each gets half of the gradient.
    let shared = Tensor::cat(&[x.narrow(0, 0, 1).unwrap(), y.narrow(0, 1, 2).unwrap()], 0).unwrap();
    let shared = Var::from_tensor(&shared).unwrap();
    type Pair = fn(&Tensor, &Tensor) -> Tensor;
    let pairs: [(Pair, Pair, bool); 5] = [
        (|a, b| ops::minimum(a, b).unwrap(), |a, b| a.minimum(b).unwrap(), true),
        (|a, b| ops::maximum(a, b).unwrap(), |a, b| a.maximum(b).unwrap(), true),
        (|a, b| ops::plus(a, b).unwrap(), |a, b| (a + b).unwrap(), false),
        (|a, b| ops::minus(a, b).unwrap(), |a, b| (a - b).unwrap(), false),
        (|a, b| ops::times(a, b).unwrap(), |a, b| (a * b).unwrap(), false),
    ];
    let numbers = |x: &Tensor| x.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    for (ours, theirs, both) in pairs {
        check(&[&x], &|| ours(&x, &y.detach()));
        let found = [ours, theirs].map(|f| {
            let z = f(&x, &shared);
            let store = (&z * y.as_tensor()).unwrap().sum_all().unwrap().backward().unwrap();
            (numbers(&z), numbers(store.get(&x).unwrap()), store.get(&shared).map(&numbers))
        });
        assert_eq!((&found[0].0, &found[0].1), (&found[1].0, &found[1].1));
        assert!(if both { found[0].2 == found[1].2 } else { found[0].2.is_none() });
    }
    assert!(ops::minimum(&x, &y.narrow(0, 0, 2).unwrap()).is_err());
    let nan = Tensor::full(f32::NAN, (3, 21), &Device::Cpu).unwrap();
    for z in [ops::minimum(&x, &nan), ops::maximum(&nan, &x), ops::huber(&nan, 0.3)] {
        assert!(numbers(&z.unwrap()).iter().all(|z| z.is_nan()));
    }
    check(&[&x], &|| ops::row(&x, 1).unwrap());
    assert_eq!(numbers(&ops::row(&x, 2).unwrap()), numbers(&x.get(2).unwrap()));
    assert!(ops::row(&x, 3).is_err());
    let size = x.abs().unwrap();
    let inner = size.clamp(0.0, 0.3).unwrap();
    let plain = (&inner * (&size - (&inner * 0.5).unwrap()).unwrap()).unwrap();
    assert_eq!(numbers(&ops::huber(&x, 0.3).unwrap()), numbers(&plain));
    check(&[&x], &|| ops::huber(&x, 0.3).unwrap());
}

#[test]
fn log_probabilities_of_actions_match_autodiff_and_have_the_bits_of_the_choice() {
    let heads = ActionHeads::new(vec![5, 3, 1]).unwrap();
    let (rows, logits) = (7, var(&[7, 9], 1));
    let mut stream = Key::new(1, Purpose::Action, &[]).stream();
    let (mut actions, mut chosen) = (vec![0; rows * 3], Vec::new());
    let values = logits.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    for (logits, action) in values.chunks_exact(9).zip(actions.chunks_exact_mut(3)) {
        chosen.push(heads.choose(logits, Some(&mut stream), action));
    }
    let ours = || ops::action_log_probs(&logits, actions.clone(), &heads).unwrap();
    assert_eq!(ours().get(0).unwrap().to_vec1::<f32>().unwrap(), chosen);
    check(&[&logits], &ours);
    // The same with candle's own operations.
    let zeros = || Tensor::zeros(rows, DType::F32, &Device::Cpu).unwrap();
    let (mut log_prob, mut entropy) = (zeros(), zeros());
    let mut at = 0;
    for (component, &size) in heads.sizes().iter().enumerate() {
        let log_probs = candle_nn::ops::log_softmax(&logits.narrow(1, at, size).unwrap(), 1).unwrap();
        let choice: Vec<u32> = actions.iter().skip(component).step_by(3).map(|&a| a.into()).collect();
        let choice = Tensor::from_vec(choice, (rows, 1), &Device::Cpu).unwrap();
        log_prob = (log_prob + log_probs.gather(&choice, 1).unwrap().squeeze(1).unwrap()).unwrap();
        entropy = (entropy - (log_probs.exp().unwrap() * &log_probs).unwrap().sum(1).unwrap()).unwrap();
        at += size;
    }
    let theirs = Tensor::stack(&[&log_prob, &entropy], 0).unwrap();
    let largest = |x: Tensor| x.abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
    assert!(largest((ours() - &theirs).unwrap()) < 1e-5);
    let gradient = |y: &Tensor| probe(y).backward().unwrap().get(&logits).unwrap().clone();
    assert!(largest((gradient(&ours()) - gradient(&theirs)).unwrap()) < 1e-5);
    assert!(ops::action_log_probs(&logits, vec![9; rows * 3], &heads).is_err());
}

#[test]
fn exp_tanh_and_softmax() {
    let x = var(&[3, 21], 1);
    for f in [ops::exp, ops::tanh, ops::softmax] {
        check(&[&x], &|| f(&x).unwrap());
    }
    let special = Tensor::new(&[0.0, f32::NAN, 200.0, -200.0, f32::INFINITY, f32::NEG_INFINITY], &Device::Cpu).unwrap();
    let y = ops::exp(&special).unwrap().to_vec1::<f32>().unwrap();
    // A loss that is not finite must stay so: the update is skipped for it.
    assert!(y[0] == 1.0 && y[1].is_nan() && y[2..] == [f32::INFINITY, 0.0, f32::INFINITY, 0.0], "{y:?}");
    let theirs = x.exp().unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
    for (a, b) in ops::exp(&x).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap().into_iter().zip(theirs) {
        assert!((a - b).abs() <= 3e-7 * b, "{a} and {b}");
    }
}

/// The graph block written with candle's operations: one joint state, straight-through by detach.
fn naive_graph(f: &Tensor, q: &Tensor, score: &Tensor, n: usize, p: usize, width: usize) -> Tensor {
    let (u, v) = (f.narrow(1, 0, p).unwrap(), f.narrow(1, p, p).unwrap());
    let z = f.narrow(1, 2 * p, width).unwrap();
    let own = f.narrow(1, 2 * p + width, width).unwrap();
    let u = (u - q).unwrap().unsqueeze(1).unwrap().broadcast_as((n, n, p)).unwrap();
    let v = (v + q).unwrap().unsqueeze(0).unwrap().broadcast_as((n, n, p)).unwrap();
    let hidden = (u + v).unwrap().relu().unwrap();
    let w2 = score.narrow(0, 0, p).unwrap();
    let logits =
        hidden.broadcast_mul(&w2).unwrap().sum(2).unwrap().broadcast_add(&score.narrow(0, p, 1).unwrap()).unwrap();
    let soft = candle_nn_sigmoid(&logits);
    let off_diagonal = {
        let mut m = vec![1.0f32; n * n];
        (0..n).for_each(|i| m[i * n + i] = 0.0);
        Tensor::from_vec(m, (n, n), &Device::Cpu).unwrap()
    };
    let hard = logits.gt(0.0).unwrap().to_dtype(DType::F32).unwrap();
    let edge = (((hard - soft.detach()).unwrap() + soft).unwrap() * off_diagonal).unwrap();
    let degree = edge.sum_keepdim(1).unwrap().maximum(1.0).unwrap();
    let message = edge.matmul(&z).unwrap().broadcast_div(&degree).unwrap();
    (own + message).unwrap().relu().unwrap()
}

fn candle_nn_sigmoid(x: &Tensor) -> Tensor {
    ((x.neg().unwrap().exp().unwrap() + 1.0).unwrap()).recip().unwrap()
}

#[test]
fn graph_block_matches_straight_through_autodiff() {
    for n in [2, 5, 19, 33] {
        let (p, width) = (6, 32);
        let (f, q, score) = (var(&[n, 2 * p + 2 * width], 1), var(&[n, p], 2), var(&[p + 1], 3));
        let block = GraphBlock { agents: n, pair_hidden: p, width, block: 0, self_path: true, temperature: 1.0 };
        let ours = ops::graph_block(&f, &q, &score, block, GraphNoise::Off).unwrap();
        let reference = naive_graph(&f, &q, &score, n, p, width);
        let gap = (&ours - &reference).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
        assert!(gap < 1e-4, "forward differs by {gap}");
        let (a, b) = (probe(&ours).backward().unwrap(), probe(&reference).backward().unwrap());
        for (name, v) in [("features", &f), ("relative", &q), ("score", &score)] {
            let (ga, gb) = (a.get(v).unwrap(), b.get(v).unwrap());
            let scale = gb.abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap().max(1.0);
            let gap = (ga - gb).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
            assert!(gap < 1e-3 * scale, "n = {n}, {name}: {gap} at scale {scale}");
        }
    }
}

#[test]
fn keyed_noise_is_replayed_and_makes_edges_random() {
    let (n, p, width) = (20, 4, 16);
    let (f, q, score) = (var(&[2 * n, 2 * p + 2 * width], 1), var(&[2 * n, p], 2), var(&[p + 1], 3));
    let block = GraphBlock { agents: n, pair_hidden: p, width, block: 1, self_path: true, temperature: 1.0 };
    let run = |keys: Vec<u64>| {
        let noise = GraphNoise::Keyed(Arc::new(keys));
        ops::graph_block(&f, &q, &score, block.clone(), noise).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap()
    };
    assert_eq!(run(vec![5, 6]), run(vec![5, 6]));
    assert_ne!(run(vec![5, 6]), run(vec![6, 5]));
    // A joint state's graph depends on its own key only.
    assert_eq!(run(vec![5, 6])[..n * width], run(vec![5, 7])[..n * width]);
}

/// Random joint states of a task.
struct States {
    positions: Vec<f32>,
    velocities: Vec<f32>,
    agent_state: Vec<f32>,
    /// One episode per state.
    statics: Statics,
    goals: Vec<u32>,
}

impl States {
    fn new(task: &TaskConfig, count: usize) -> Self {
        let s = task.shape(count);
        let goals = |_| (0..s.agents as u32).flat_map(|i| std::iter::repeat_n(i, s.goals_per_agent));
        Self {
            positions: normal(count * s.bodies * s.dims, 1),
            velocities: normal(count * s.bodies * s.dims, 2),
            agent_state: normal(count * s.agents * s.agent_state, 4).iter().map(|x| -x.abs()).collect(),
            statics: Statics::landmarks(s.landmarks, s.dims, normal(count * s.landmarks * s.dims, 3)),
            goals: (0..count).flat_map(goals).collect(),
        }
    }

    fn part(&self, task: &TaskConfig, from: usize, to: usize) -> JointState<'_> {
        let s = task.shape(1);
        let state = s.bodies * s.dims;
        JointState {
            positions: &self.positions[from * state..to * state],
            velocities: &self.velocities[from * state..to * state],
            agent_state: &self.agent_state[from * s.agents * s.agent_state..to * s.agents * s.agent_state],
            world_states: &[],
            masks: &[],
            marks: &[],
            statics: self.statics.episodes(from..to),
            goals: &self.goals[from * s.agents * s.goals_per_agent..to * s.agents * s.goals_per_agent],
        }
    }
}

const TASKS: [TaskName; 3] = [TaskName::SimpleSpread, TaskName::PushBall, TaskName::Drones];

fn drawn(name: TaskName, kind: ExecutorKind, agents: usize, outputs: usize) -> (ExecutorConfig, TaskConfig, Params) {
    let config = ExecutorConfig { kind, neighbours: 3, ..ExecutorConfig::default() };
    let task = TaskConfig::of(name, agents, Spawn::Uniform);
    let mut params = ParamBuilder::layout();
    build(&config, &feature_spec(&config, &task), (outputs, 1.0), false, &mut params).unwrap();
    let params = Params::init(params.entries(), Key::new(3, Purpose::Init, &[0]).stream());
    (config, task, params)
}

#[test]
fn the_gradient_of_every_executor_is_its_slope_in_every_tensor() {
    let kinds = [
        ExecutorKind::Magex,
        ExecutorKind::MagexLiteral,
        ExecutorKind::Attention,
        ExecutorKind::Mlp,
        ExecutorKind::Local,
        ExecutorKind::Flat,
        ExecutorKind::Dicg,
    ];
    for (name, kind) in TASKS.into_iter().flat_map(|name| kinds.map(|kind| (name, kind))) {
        let (steps, sequences, agents) = (4, 3, 6);
        let (config, task, mut params) = drawn(name, kind, agents, 5);
        let spec = feature_spec(&config, &task);
        let states = States::new(&task, steps * sequences);
        let features = Arc::new(spec.compute(&states.part(&task, 0, steps * sequences)));
        let output = |tensors: Vec<Tensor>| {
            let net = build(&config, &spec, (5, 1.0), false, &mut ParamBuilder::with(tensors)).unwrap();
            let input = Input {
                steps,
                sequences,
                agents,
                features: &features,
                hidden: normal(sequences * agents * config.memory(), 5),
                noise: GraphNoise::Keyed(Arc::new((0..(steps * sequences) as u64).collect())),
            };
            net.forward(&input).unwrap().out
        };
        let vars = params.variables().unwrap();
        let out = output(vars.iter().map(|v| v.as_tensor().clone()).collect());
        assert_eq!(out.dims(), [steps * sequences * agents, 5]);
        let gradient = params.gradient(&vars, &probe(&out).backward().unwrap()).unwrap();
        for entry in params.entries.clone() {
            let own = &gradient[entry.range()];
            assert!(own.iter().all(|g| g.is_finite()), "{name} {kind}: {}", entry.name);
            let largest = (0..own.len()).max_by(|&a, &b| own[a].abs().total_cmp(&own[b].abs())).unwrap();
            assert!(own[largest] != 0.0, "{name} {kind}: {} has no gradient", entry.name);
            // What moves hard edges has a straight-through gradient, which is no slope; its own test compares it with autodiff.
            if hard_edges(kind) && ["f_o", "gcn", "block"].iter().any(|prefix| entry.name.starts_with(prefix)) {
                continue;
            }
            for place in [largest, (largest + own.len() / 2) % own.len()] {
                let at = entry.start + place;
                let mut moved = |step: f32| {
                    let before = params.values[at];
                    params.values[at] += step;
                    let value = probe(&output(params.tensors().unwrap())).to_scalar::<f32>().unwrap();
                    params.values[at] = before;
                    f64::from(value)
                };
                // Two steps: a kink of ReLU within the larger one is not within the smaller one.
                let slopes = [1e-3, 1e-4].map(|step| (moved(step) - moved(-step)) / f64::from(2.0 * step));
                let (gradient, scale) = (f64::from(own[place]), f64::from(own[largest].abs()));
                let close = slopes.iter().any(|slope| (slope - gradient).abs() < 0.05 * scale + 0.02);
                assert!(close, "{name} {kind}: {}: {slopes:?} and {gradient}", entry.name);
            }
        }
    }
}

fn hard_edges(kind: ExecutorKind) -> bool {
    matches!(kind, ExecutorKind::Magex | ExecutorKind::MagexLiteral)
}

#[test]
fn a_joint_state_gets_the_same_bits_alone_and_in_a_batch() {
    let kinds = [
        ExecutorKind::Magex,
        ExecutorKind::MagexLiteral,
        ExecutorKind::Mlp,
        ExecutorKind::Local,
        ExecutorKind::Flat,
        ExecutorKind::Dicg,
    ];
    for (name, kind) in TASKS.into_iter().flat_map(|name| kinds.map(|kind| (name, kind))) {
        let (count, agents) = (7, 9);
        let (config, task, params) = drawn(name, kind, agents, 5);
        let spec = feature_spec(&config, &task);
        let net = build(&config, &spec, (5, 1.0), false, &mut ParamBuilder::with(params.tensors().unwrap())).unwrap();
        let states = States::new(&task, count);
        let run = |from: usize, to: usize| {
            let features = Arc::new(spec.compute(&states.part(&task, from, to)));
            let input = Input {
                steps: 1,
                sequences: to - from,
                agents,
                features: &features,
                hidden: vec![0.1; (to - from) * agents * config.memory()],
                noise: GraphNoise::Keyed(Arc::new((from as u64..to as u64).collect())),
            };
            net.forward(&input).unwrap().out.flatten_all().unwrap().to_vec1::<f32>().unwrap()
        };
        let all = run(0, count);
        for s in 0..count {
            assert_eq!(run(s, s + 1), all[s * agents * 5..(s + 1) * agents * 5], "{name} {kind}, state {s}");
        }
    }
}
