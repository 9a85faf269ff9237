use super::*;
use crate::executor::{Model, feature_spec};
use crate::features::Features;
use crate::ops::GraphNoise;
use crate::params::Params;
use magex_core::config::RunConfig;
use magex_core::joint_state::JointState;
use magex_core::rng::{Key, Purpose, Stream};
use magex_core::statics::Statics;
use magex_core::task::{RewardTarget, Spawn, TaskConfig};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Samples from one stream and keeps what it chose.
struct Sampler {
    heads: ActionHeads,
    stream: Stream,
    actions: Vec<u8>,
    log_probs: Vec<f32>,
}

impl Chooser for Sampler {
    fn choose(&mut self, row: usize, logits: &[f32]) -> &[u8] {
        self.log_probs[row] = self.heads.choose(logits, Some(&mut self.stream), &mut self.actions[row..row + 1]);
        &self.actions[row..row + 1]
    }
}

impl Sampler {
    fn new(rows: usize) -> Self {
        let heads = ActionHeads::new(vec![5]).unwrap();
        let stream = Key::new(1, Purpose::Action, &[]).stream();
        Self { heads, stream, actions: vec![0; rows], log_probs: vec![0.0; rows] }
    }
}

/// As the authors' code acts: the whole decoder for every agent.
fn decode_without_cache(mat: &Mat, encoded: &Tensor, agents: usize, sampler: &mut Sampler) {
    let decoder = mat.decoder.as_ref().unwrap();
    for i in 0..agents {
        let features = decoder.forward(encoded, &mat.tokens(&sampler.actions, agents).unwrap()).unwrap();
        let logits = mat.logits.forward(&features).unwrap().to_vec2::<f32>().unwrap();
        for row in (i..logits.len()).step_by(agents) {
            sampler.choose(row, &logits[row]);
        }
    }
}

fn numbers(count: usize, tag: u32) -> Vec<f32> {
    let mut stream = Key::new(9, Purpose::Bench, &[tag]).stream();
    (0..count).map(|_| stream.normal() as f32).collect()
}

/// A transformer for N agents, and what it sees of S joint states.
fn transformer(agents: usize, states: usize) -> (Mat, Arc<Features>) {
    let mut config = RunConfig { task: TaskConfig::simple_spread(agents, Spawn::Uniform), ..RunConfig::default() };
    config.task.reward_target = RewardTarget::Team;
    config.executor = ExecutorConfig { kind: ExecutorKind::Mat, ..ExecutorConfig::default() };
    let layout = Model::new(&config).unwrap().layouts().unwrap().remove(0);
    let params = Params::init(layout, Key::new(1, Purpose::Init, &[]).stream());
    let (spec, heads) = (feature_spec(&config.executor, &config.task), ActionHeads::new(vec![5]).unwrap());
    let mat = Mat::build(&config.executor, &spec, &heads, &mut ParamBuilder::with(params.tensors().unwrap())).unwrap();
    let landmarks = Statics::landmarks(agents, 2, numbers(states * agents * 2, 1));
    let features = Arc::new(spec.compute(&JointState {
        positions: &numbers(states * agents * 2, 2),
        velocities: &numbers(states * agents * 2, 3),
        agent_state: &[],
        world_states: &[],
        masks: &[],
        marks: &[],
        statics: landmarks.view(),
        goals: &(0..states).flat_map(|_| 0..agents as u32).collect::<Vec<_>>(),
    }));
    (mat, features)
}

fn input(features: &Arc<Features>, agents: usize, sequences: usize) -> Input<'_> {
    Input { steps: 1, sequences, agents, features, hidden: Vec::new(), noise: GraphNoise::Off }
}

#[test]
fn decoding_with_kept_keys_and_values_gives_the_bits_of_decoding_without() {
    let (agents, states) = (19, 3);
    let (mat, features) = transformer(agents, states);
    let encoded = mat.encoder.forward(&input(&features, agents, states)).unwrap();
    let (mut with, mut without) = (Sampler::new(agents * states), Sampler::new(agents * states));
    mat.act(&input(&features, agents, states), &mut with).unwrap();
    decode_without_cache(&mat, &encoded, agents, &mut without);
    assert_eq!((with.actions, with.log_probs), (without.actions, without.log_probs));
}

/// `cargo test --release -p magex-nets -- --ignored --nocapture kept_keys`; the numbers are in docs/results.md.
#[test]
#[ignore = "a measurement"]
fn time_of_a_joint_step_with_and_without_kept_keys_and_values() {
    for (agents, states) in [(5, 16), (20, 16), (50, 16), (50, 1)] {
        let (mat, features) = transformer(agents, states);
        let mut ratios = Vec::new();
        let mut best = [Duration::MAX; 2];
        for _ in 0..5 {
            let mut times = [Duration::ZERO; 2];
            for (k, time) in times.iter_mut().enumerate() {
                let clock = Instant::now();
                for _ in 0..if k == 0 { 20 } else { 2 } {
                    let mut sampler = Sampler::new(agents * states);
                    if k == 0 {
                        mat.act(&input(&features, agents, states), &mut sampler).unwrap();
                    } else {
                        let encoded = mat.encoder.forward(&input(&features, agents, states)).unwrap();
                        decode_without_cache(&mat, &encoded, agents, &mut sampler);
                    }
                }
                *time = clock.elapsed() / if k == 0 { 20 } else { 2 };
            }
            ratios.push(times[0].as_secs_f64() / times[1].as_secs_f64());
            best = std::array::from_fn(|k| best[k].min(times[k]));
        }
        ratios.sort_by(f64::total_cmp);
        println!("N = {agents}, {states} worlds: with {:?}, without {:?}, ratio {:.4}", best[0], best[1], ratios[2]);
    }
}
