//! Hand-written gradients against finite differences and against candle's own automatic differentiation.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use candle_core::{DType, Device, Tensor, Var};
use magex_core::config::{ExecutorConfig, ExecutorKind};
use magex_core::joint_state::JointState;
use magex_core::rng::{Key, Purpose};
use magex_core::statics::Statics;
use magex_core::task::{Spawn, TaskConfig, TaskName};
use magex_nets::Activation;
use magex_nets::executor::{Input, build, feature_spec, memory};
use magex_nets::ops::{self, GraphBlock, GraphNoise};
use magex_nets::params::{Params, Source};
use std::sync::Arc;

fn normal(n: usize, tag: u32) -> Vec<f32> {
    let mut s = Key::new(11, Purpose::Bench, &[tag]).stream();
    (0..n).map(|_| s.normal() as f32).collect()
}

fn var(shape: &[usize], tag: u32) -> Var {
    Var::from_tensor(&Tensor::from_vec(normal(shape.iter().product(), tag), shape, &Device::Cpu).unwrap()).unwrap()
}

/// A fixed random projection to a scalar, so that every output matters differently.
fn probe(y: &Tensor) -> Tensor {
    let weights = Tensor::from_vec(normal(y.elem_count(), 99), y.shape(), &Device::Cpu).unwrap();
    (y * weights).unwrap().sum_all().unwrap()
}

fn check(vars: &[&Var], f: &dyn Fn() -> Tensor) {
    let grads = probe(&f()).backward().unwrap();
    for (index, v) in vars.iter().enumerate() {
        let grad = grads.get(v).unwrap_or_else(|| panic!("variable {index} has no gradient"));
        let grad = grad.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let start = v.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let step = 1e-2;
        let (mut worst, mut scale) = (0.0f32, 1e-3f32);
        for place in 0..start.len().min(40) {
            let at = (place * 37) % start.len();
            let value = |delta: f32| {
                let mut moved = start.clone();
                moved[at] += delta;
                v.set(&Tensor::from_vec(moved, v.shape(), &Device::Cpu).unwrap()).unwrap();
                probe(&f()).to_scalar::<f32>().unwrap()
            };
            let numeric = (value(step) - value(-step)) / (2.0 * step);
            worst = worst.max((numeric - grad[at]).abs());
            scale = scale.max(grad[at].abs());
        }
        v.set(&Tensor::from_vec(start, v.shape(), &Device::Cpu).unwrap()).unwrap();
        assert!(worst < 0.03 * scale, "variable {index}: off by {worst} at scale {scale}");
    }
}

#[test]
fn linear_and_norm() {
    let (x, w, b) = (var(&[6, 5], 1), var(&[5, 7], 2), var(&[7], 3));
    for act in [Activation::Identity, Activation::Tanh] {
        check(&[&x, &w, &b], &|| ops::linear(&x, &w, &b, act, false).unwrap());
    }
    let (scale, shift) = (var(&[5], 4), var(&[5], 5));
    check(&[&x, &scale, &shift], &|| ops::layer_norm(&x, &scale, &shift).unwrap());
    check(&[&x], &|| ops::mean_of_others(&x, 3).unwrap());
}

#[test]
fn recurrent_unit() {
    let (x, w, b) = (var(&[4, 3, 48], 1), var(&[16, 48], 2), var(&[48], 3));
    let w = Var::from_tensor(&(w.as_tensor() * 0.3).unwrap()).unwrap();
    let h0 = normal(3 * 16, 4);
    check(&[&x, &w, &b], &|| ops::gru(&x, &w, &b, h0.clone()).unwrap());
}

#[test]
fn neighbour_pool() {
    let features = Tensor::from_vec(normal(5 * 3 * 4, 1), (5, 3, 4), &Device::Cpu).unwrap();
    let counts = Arc::new(vec![3, 0, 1, 2, 3]);
    let (w, b) = (var(&[4, 20], 2), var(&[20], 3));
    check(&[&w, &b], &|| ops::neighbour_pool(&features, counts.clone(), &w, &b).unwrap());
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
            statics: self.statics.episodes(from..to),
            goals: &self.goals[from * s.agents * s.goals_per_agent..to * s.agents * s.goals_per_agent],
        }
    }
}

const TASKS: [TaskName; 3] = [TaskName::SimpleSpread, TaskName::PushBall, TaskName::Drones];

fn drawn(name: TaskName, kind: ExecutorKind, agents: usize, outputs: usize) -> (ExecutorConfig, TaskConfig, Params) {
    let config = ExecutorConfig { kind, neighbours: 3, ..ExecutorConfig::default() };
    let task = TaskConfig::of(name, agents, Spawn::Uniform);
    let mut source = Source::new(Key::new(3, Purpose::Init, &[0]).stream());
    build(&config, &feature_spec(&config, &task), agents, outputs, 1.0, &mut source).unwrap();
    match source {
        Source::New { params, .. } => (config, task, params),
        Source::Existing { .. } => unreachable!(),
    }
}

#[test]
fn every_parameter_of_every_executor_receives_a_gradient() {
    let kinds = [
        ExecutorKind::Magex,
        ExecutorKind::MagexLiteral,
        ExecutorKind::Attention,
        ExecutorKind::Mlp,
        ExecutorKind::Local,
    ];
    for (name, kind) in TASKS.into_iter().flat_map(|name| kinds.map(|kind| (name, kind))) {
        let (steps, sequences, agents) = (4, 3, 6);
        let (config, task, params) = drawn(name, kind, agents, 5);
        let spec = feature_spec(&config, &task);
        let states = States::new(&task, steps * sequences);
        let features = spec.compute(&states.part(&task, 0, steps * sequences));
        let vars = params.variables().unwrap();
        let mut source = params.source(vars.iter().map(|v| v.as_tensor().clone()).collect());
        let net = build(&config, &spec, agents, 5, 1.0, &mut source).unwrap();
        let input = Input {
            steps,
            sequences,
            agents,
            features: &features,
            hidden: normal(sequences * agents * memory(&config), 5),
            noise: GraphNoise::Keyed(Arc::new((0..(steps * sequences) as u64).collect())),
        };
        let out = net.forward(&input).unwrap().out;
        assert_eq!(out.dims(), [steps * sequences * agents, 5]);
        let grads = probe(&out).backward().unwrap();
        for (entry, v) in params.entries.iter().zip(&vars) {
            let size = grads
                .get(v)
                .unwrap_or_else(|| panic!("{name} {kind}: {} has no gradient", entry.name))
                .abs()
                .unwrap()
                .max_all()
                .unwrap()
                .to_scalar::<f32>()
                .unwrap();
            assert!(size > 0.0 && size.is_finite(), "{name} {kind}: the gradient of {} is {size}", entry.name);
        }
    }
}

#[test]
fn a_joint_state_gets_the_same_bits_alone_and_in_a_batch() {
    let kinds = [ExecutorKind::Magex, ExecutorKind::MagexLiteral, ExecutorKind::Mlp, ExecutorKind::Local];
    for (name, kind) in TASKS.into_iter().flat_map(|name| kinds.map(|kind| (name, kind))) {
        let (count, agents) = (7, 9);
        let (config, task, params) = drawn(name, kind, agents, 5);
        let spec = feature_spec(&config, &task);
        let net = build(&config, &spec, agents, 5, 1.0, &mut params.source(params.plain().unwrap())).unwrap();
        let states = States::new(&task, count);
        let run = |from: usize, to: usize| {
            let features = spec.compute(&states.part(&task, from, to));
            let input = Input {
                steps: 1,
                sequences: to - from,
                agents,
                features: &features,
                hidden: vec![0.1; (to - from) * agents * memory(&config)],
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
