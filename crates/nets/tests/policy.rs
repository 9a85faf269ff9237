//! The seam between policies, rollouts and updates, seen by a policy that decodes agent by agent.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use candle_core::{Result, Tensor, Var};
use magex_core::config::{ExecutorConfig, ExecutorKind, RunConfig};
use magex_core::joint_state::JointState;
use magex_core::rng::{Key, Purpose, Stream};
use magex_core::statics::Statics;
use magex_core::task::{RewardTarget, Spawn, TaskConfig};
use magex_nets::distribution::ActionHeads;
use magex_nets::executor::{Act, Chooser, Evaluated, Input, Model, Policy, Taken};
use magex_nets::features::Features;
use magex_nets::ops::{self, Activation, GraphNoise};
use magex_nets::params::{ParamBuilder, Params, to_safetensors};
use std::sync::Arc;

/// Logits of agent i = features_i · w + Σ over agents before it of v[action]: the smallest policy whose agents see what the
/// agents before them do.
struct Decoder {
    w: Tensor,
    v: Tensor,
    heads: ActionHeads,
}

impl Decoder {
    fn new(w: Tensor, v: Tensor) -> Self {
        Self { w, v, heads: ActionHeads::new(vec![5]).unwrap() }
    }

    /// Logits [S·N, A] given the actions of the agents before each agent.
    fn logits(&self, input: &Input<'_>, actions: &[u8]) -> Result<Tensor> {
        let mut before = vec![0.0; actions.len() * 5];
        for (state, actions) in actions.chunks_exact(input.agents).enumerate() {
            for (i, &action) in actions.iter().enumerate() {
                for later in i + 1..input.agents {
                    before[(state * input.agents + later) * 5 + usize::from(action)] += 1.0;
                }
            }
        }
        let zeros = Tensor::zeros_like(&self.v.get(0)?)?;
        let width = input.features.goals.len() / actions.len();
        let own =
            ops::linear(&ops::constant(input.features.goals.as_slice(), width)?, &self.w, &zeros, IDENTITY, true)?;
        own + ops::linear(&ops::constant(before, 5)?, &self.v, &zeros, IDENTITY, true)?
    }
}

const IDENTITY: Activation = Activation::Identity;

impl Act for Decoder {
    fn act(&self, input: &Input<'_>, choose: &mut dyn Chooser) -> Result<Option<Tensor>> {
        let rows = input.steps * input.sequences * input.agents;
        let mut actions = vec![0; rows];
        for agent in 0..input.agents {
            let logits = self.logits(input, &actions)?.to_vec2::<f32>()?;
            for row in (agent..rows).step_by(input.agents) {
                actions[row] = choose.choose(row, &logits[row])[0];
            }
        }
        Ok(None)
    }
}

impl Policy for Decoder {
    fn evaluate(&self, input: &Input<'_>, Taken { choices: actions, .. }: Taken<'_>) -> Result<Evaluated> {
        let both = ops::action_log_probs(&self.logits(input, actions)?, actions.to_vec(), &self.heads)?;
        Ok(Evaluated { log_probs: both.get(0)?, entropies: both.get(1)?, states: None })
    }
}

/// Samples from one stream per joint state; the first agents may be made to do something else.
struct Sampler {
    heads: ActionHeads,
    streams: Vec<Stream>,
    agents: usize,
    forced: Option<u8>,
    actions: Vec<u8>,
    log_probs: Vec<f32>,
}

impl Sampler {
    fn new(heads: &ActionHeads, states: usize, agents: usize, forced: Option<u8>) -> Self {
        let stream = |s: usize| Key::new(1, Purpose::Action, &[s as u32]).stream();
        let rows = states * agents;
        Self {
            heads: heads.clone(),
            streams: (0..states).map(stream).collect(),
            agents,
            forced,
            actions: vec![0; rows * heads.count()],
            log_probs: vec![0.0; rows],
        }
    }
}

impl Chooser for Sampler {
    fn choose(&mut self, row: usize, logits: &[f32]) -> &[u8] {
        let action = &mut self.actions[row * self.heads.count()..(row + 1) * self.heads.count()];
        self.log_probs[row] = self.heads.choose(logits, Some(&mut self.streams[row / self.agents]), action);
        if let Some(forced) = self.forced.filter(|_| row.is_multiple_of(self.agents)) {
            action.fill(forced);
        }
        action
    }
}

fn normal(n: usize, tag: u32) -> Vec<f32> {
    let mut s = Key::new(11, Purpose::Bench, &[tag]).stream();
    (0..n).map(|_| s.normal() as f32).collect()
}

const AGENTS: usize = 4;
const STATES: usize = 6;

fn features(model: &Model, task: &TaskConfig) -> Arc<Features> {
    let s = task.shape(STATES);
    let landmarks = Statics::landmarks(s.landmarks, s.dims, normal(STATES * s.landmarks * s.dims, 3));
    Arc::new(model.spec().compute(&JointState {
        positions: &normal(STATES * s.bodies * s.dims, 1),
        velocities: &normal(STATES * s.bodies * s.dims, 2),
        agent_state: &[],
        world_states: &[],
        masks: &[],
        marks: &[],
        statics: landmarks.view(),
        goals: &(0..STATES).flat_map(|_| 0..AGENTS as u32).collect::<Vec<_>>(),
    }))
}

fn input<'a>(features: &'a Arc<Features>, memory: usize) -> Input<'a> {
    let hidden = vec![0.1; STATES * AGENTS * memory];
    Input { steps: 1, sequences: STATES, agents: AGENTS, features, hidden, noise: GraphNoise::Off }
}

fn config() -> RunConfig {
    RunConfig { task: TaskConfig::simple_spread(AGENTS, Spawn::Uniform), ..RunConfig::default() }
}

#[test]
fn earlier_actions_of_a_decoder_reach_later_agents_and_evaluation_agrees_with_acting() {
    let config = config();
    let model = Model::new(&config).unwrap();
    let features = features(&model, &config.task);
    let width = model.spec().goal_width();
    let var = |rows: usize, tag| Var::from_tensor(&ops::constant(normal(rows * 5, tag), 5).unwrap()).unwrap();
    let (w, v) = (var(width, 4), var(5, 5));
    let decoder = Decoder::new(w.as_tensor().clone(), v.as_tensor().clone());
    let act = |forced| {
        let mut sampler = Sampler::new(&decoder.heads, STATES, AGENTS, forced);
        decoder.act(&input(&features, 0), &mut sampler).unwrap();
        sampler
    };
    let free = act(None);
    let evaluated = decoder.evaluate(&input(&features, 0), Taken::choices(&free.actions)).unwrap();
    assert_eq!(evaluated.log_probs.to_vec1::<f32>().unwrap(), free.log_probs);
    // The same streams, another first agent: the others have other probabilities.
    let other = act(Some(4));
    for state in 0..STATES {
        let (first, last) = (state * AGENTS, (state + 1) * AGENTS - 1);
        assert_eq!(free.log_probs[first], other.log_probs[first]);
        assert_eq!(free.log_probs[last] == other.log_probs[last], free.actions[first] == 4, "state {state}");
    }
    // The update differentiates through what the agents before did.
    let gradients = evaluated.log_probs.sum_all().unwrap().backward().unwrap();
    for variable in [&w, &v] {
        let size = gradients.get(variable).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
        assert!(size > 0.0 && size.is_finite());
    }
}

/// The policies whose acting and evaluating must agree: MAGE-X and every baseline.
fn configs() -> Vec<RunConfig> {
    let baseline = |kind, recurrent| {
        let mut config = config();
        config.task.reward_target = RewardTarget::Team;
        config.executor = ExecutorConfig { kind, recurrent, hidden: 32, attention_heads: 1, ..config.executor };
        config
    };
    let mut several = baseline(ExecutorKind::Mat, false);
    (several.executor.attention_blocks, several.executor.attention_heads) = (2, 4);
    vec![
        config(),
        baseline(ExecutorKind::Flat, false),
        baseline(ExecutorKind::Flat, true),
        baseline(ExecutorKind::Mat, false),
        several,
        baseline(ExecutorKind::MatDec, false),
        baseline(ExecutorKind::Dicg, false),
    ]
}

fn drawn(model: &Model) -> Vec<Params> {
    let stream = |k: u32| Key::new(2, Purpose::Init, &[k]).stream();
    model.layouts().unwrap().into_iter().zip(0..).map(|(layout, k)| Params::init(layout, stream(k))).collect()
}

#[test]
fn a_loaded_policy_acts_as_the_one_that_was_written_and_evaluation_agrees_with_acting() {
    for config in configs() {
        let model = Model::new(&config).unwrap();
        let features = features(&model, &config.task);
        let params = drawn(&model);
        let builder = |params: &Params| ParamBuilder::with(params.tensors().unwrap());
        let own = model.policy(&mut params.iter().map(builder).collect::<Vec<_>>()).unwrap();
        // Actors are sent what the policy reads, and nothing else.
        let published = model.parts().iter().zip(&params).filter(|(part, _)| part.policy);
        let published: Vec<(&str, &Params)> = published.map(|(part, params)| (part.name, params)).collect();
        let loaded = model.load_policy(&to_safetensors(&published, "").unwrap()).unwrap();
        let flat = |states: Option<Tensor>| states.map(|s| s.flatten_all().unwrap().to_vec1::<f32>().unwrap());
        let act = |policy: &dyn Act| {
            let mut sampler = Sampler::new(model.heads(), STATES, AGENTS, None);
            let states = policy.act(&input(&features, model.memory()), &mut sampler).unwrap();
            (sampler.actions, sampler.log_probs, flat(states))
        };
        let (actions, log_probs, states) = act(own.as_ref());
        assert_eq!(act(loaded.as_ref()), (actions.clone(), log_probs.clone(), states.clone()));
        let evaluated = own.evaluate(&input(&features, model.memory()), Taken::choices(&actions)).unwrap();
        let kind = config.executor.kind;
        assert_eq!(evaluated.log_probs.to_vec1::<f32>().unwrap(), log_probs, "{kind}");
        assert_eq!(flat(evaluated.states), states, "{kind}");
    }
}

#[test]
fn a_decoding_transformer_hears_the_agents_before_and_no_agent_after() {
    let config = &configs()[4];
    let model = Model::new(config).unwrap();
    let features = features(&model, &config.task);
    let mut params = drawn(&model);
    // Heads start near zero; make what is said audible.
    params[0].values.iter_mut().for_each(|x| *x = if x.abs() < 0.2 { *x * 20.0 } else { *x });
    let mut parts = [ParamBuilder::with(params[0].tensors().unwrap())];
    let policy = model.policy(&mut parts).unwrap();
    let evaluate = |actions: &[u8]| -> Vec<f32> {
        policy.evaluate(&input(&features, 0), Taken::choices(actions)).unwrap().entropies.to_vec1().unwrap()
    };
    let base = evaluate(&[0; STATES * AGENTS]);
    for changed in 0..AGENTS {
        let mut actions = [0; STATES * AGENTS];
        actions.iter_mut().skip(changed).step_by(AGENTS).for_each(|action| *action = 3);
        let other = evaluate(&actions);
        for (row, (a, b)) in base.iter().zip(&other).enumerate() {
            assert_eq!(a == b, row % AGENTS <= changed, "agent {changed}, row {row}");
        }
    }
}

#[test]
fn the_gradient_of_the_transformer_is_its_slope_in_every_tensor() {
    let config = &configs()[4];
    let model = Model::new(config).unwrap();
    let features = features(&model, &config.task);
    let mut params = drawn(&model).remove(0);
    params.values.iter_mut().for_each(|x| *x = if x.abs() < 0.2 { *x * 20.0 } else { *x });
    let actions: Vec<u8> = (0..STATES * AGENTS).map(|row| (row * 7 % 5) as u8).collect();
    // Both ways through the network: log-probabilities and entropies, and values.
    let loss = |tensors: &[Tensor]| -> Tensor {
        let part = || [ParamBuilder::with(tensors.to_vec())];
        let now = model.policy(&mut part()).unwrap().evaluate(&input(&features, 0), Taken::choices(&actions)).unwrap();
        let values = model.value(&mut part()).unwrap().forward(&input(&features, 0)).unwrap().out;
        let probe = ops::constant(normal(STATES * AGENTS, 9), 1).unwrap();
        let policy = ((now.log_probs + now.entropies).unwrap() * probe.flatten_all().unwrap()).unwrap();
        (policy.sum_all().unwrap() + (values * probe).unwrap().sum_all().unwrap()).unwrap()
    };
    let vars = params.variables().unwrap();
    let tensors: Vec<Tensor> = vars.iter().map(|v| v.as_tensor().clone()).collect();
    let gradient = params.gradient(&vars, &loss(&tensors).backward().unwrap()).unwrap();
    for entry in params.entries.clone() {
        let own = &gradient[entry.range()];
        let largest = (0..own.len()).max_by(|&a, &b| own[a].abs().total_cmp(&own[b].abs())).unwrap();
        // A shift of all keys changes no attention weight.
        if !entry.name.ends_with("key.bias") {
            assert!(own[largest] != 0.0, "{} has no gradient", entry.name);
        }
        let at = entry.start + largest;
        let mut moved = |step: f32| {
            let before = params.values[at];
            params.values[at] += step;
            let value = loss(&params.tensors().unwrap()).to_scalar::<f32>().unwrap();
            params.values[at] = before;
            f64::from(value)
        };
        let slopes = [3e-3, 1e-3].map(|step| (moved(step) - moved(-step)) / f64::from(2.0 * step));
        let close = slopes
            .iter()
            .any(|slope| (slope - f64::from(own[largest])).abs() < 0.05 * f64::from(own[largest].abs()) + 0.02);
        assert!(close, "{}: {slopes:?} and {}", entry.name, own[largest]);
    }
}
