//! MAPPO (Yu et al. 2022, "The Surprising Effectiveness of PPO in Cooperative Multi-Agent Games") for the action executor,
//! from top to bottom: values → GAE → epochs → minibatches → losses → clipped gradients → Adam.
//!
//! | | implementation detail | source |
//! |---|---|---|
//! | 1 | one policy and one value function for all agents, each with its Adam (ε = 1e-5) | section 3; on-policy `MPE_runner` |
//! | 2 | value targets are normalised by running statistics (ValueNorm) | section 5.1; `utils/valuenorm.py` |
//! | 3 | the statistics take in a minibatch before its targets are normalised | `r_mappo.py`, `cal_value_loss` |
//! | 4 | advantages by GAE(λ), normalised over the whole batch: (A − mean) / (deviation + 1e-5) | `r_mappo.py`, `train` |
//! | 5 | few epochs, large minibatches | sections 5.3 and 5.5 |
//! | 6 | memories are differentiated through chunks of L steps; each chunk enters with the memory of the rollout | appendix; `recurrent_generator` |
//! | 7 | clipped surrogate over the action of one agent (or, with `joint_ratio`, of the team) | section 5.4; Schulman et al. 2017, equation 7 |
//! | 8 | clipped value loss around the old value, Huber loss with δ = 10 | `cal_value_loss` |
//! | 9 | entropy bonus; gradient clipped by its global norm, network by network | `ppo_update` |
//! | 10 | orthogonal initialisation, gain 0.01 in the last layer of the policy | `r_actor_critic.py` |
//! | 11 | the horizon is a time limit: the value of the true last state is bootstrapped | ours (on-policy masks it) |
//! | 12 | a minibatch is cut into a fixed number of slices whose gradients are added in their order | ours: the number of threads does not reach a number |
//! | 13 | log-probabilities that the first minibatch (with memories: every chunk) does not reproduce refuse the batch before anything is changed | ours |
//! | 14 | a minibatch with a loss or a gradient that is not finite is skipped | ours |
//! | 15 | rows of agents that do not act (their episode is over, the next one has not begun) count nowhere | on-policy, `active_masks` |

mod sums;

use self::sums::{PolicySums, Totals};
use crate::train::batch::{Batch, Slice, column, sum_of_rows};
use crate::train::gae::{Gae, ValueNorm};
use crate::train::learned::{Learned, Network};
use crate::train::stats::UpdateStats;
use crate::train::suspect::{LOG_PROB_TOLERANCE, Suspect, UpdateError};
use candle_core::{Result as CandleResult, Tensor, Var};
use magex_core::config::{ExecutorKind, RunConfig};
use magex_core::rng::{Key, Purpose};
use magex_nets::executor::{self as nets, Model, Part, Policy, Taken};
use magex_nets::features::{FeatureSpec, Features};
use magex_nets::ops::{self, GraphNoise};
use magex_nets::params::{ParamBuilder, ParamError, Params};
use rayon::prelude::*;
use std::sync::Arc;

type Result<T> = std::result::Result<T, ParamError>;

/// The gradient of each network, as flat as its parameters; empty for networks that a loss does not read.
type Gradients = Vec<Vec<f32>>;

/// A network and the variables that it is on, one list for each part.
type Differentiable<T> = (Box<T>, Vec<Vec<Var>>);

/// Policy and value function.
type Functions = (Box<dyn Policy>, Box<dyn nets::Network>);

/// Rows of one pass of a network without memory, about: a longer pass gains nothing, and some need much room for one.
const AT_ONCE: usize = 2048;

/// Rows of one step of a network with memory, about.
const STEP_ROWS: usize = 48;

/// The algorithm with its settings.
#[derive(Debug)]
pub struct Mappo {
    config: RunConfig,
    model: Model,
    /// L: steps of a chunk; 1 for networks without memory.
    chunk: usize,
    /// Largest difference between an actor's log-probabilities and ours: none where acting and evaluating have the same bits.
    tolerance: f64,
}

/// Values and memories under the weights that an iteration starts with.
#[derive(Clone, Default)]
struct Evaluation {
    /// [T+1, N] normalised values of one episode.
    values: Vec<f32>,
    /// [T/L, N, H] memory of the policy entering each chunk.
    policy_memory: Vec<f32>,
    /// [T/L, N, H] memory of the value function entering each chunk.
    value_memory: Vec<f32>,
    /// max |ln π − ln π_old| of one episode, of networks with a memory.
    error: f64,
}

impl Mappo {
    /// Checks that the task's actions fit, and fixes the sizes.
    pub fn new(config: &RunConfig) -> Result<Self> {
        let model = Model::new(config)?;
        let chunk = if model.memory() == 0 { 1 } else { config.mappo.chunk_length };
        // Its products are candle's, whose bits depend on the size of a batch.
        let tolerance = if config.executor.kind == ExecutorKind::Attention { LOG_PROB_TOLERANCE } else { 0.0 };
        Ok(Self { config: config.clone(), model, chunk, tolerance })
    }

    /// What the networks see.
    pub fn spec(&self) -> &FeatureSpec {
        self.model.spec()
    }

    /// L: steps of a chunk.
    pub fn chunk(&self) -> usize {
        self.chunk
    }

    /// Initial networks and optimisers.
    pub fn init(&self) -> Result<Vec<Network>> {
        let key = |index: u32| Key::new(self.config.run.seed, Purpose::Init, &[index]);
        let parts = self.model.parts().iter().zip(self.model.layouts()?).zip(0..);
        let init = |((part, layout), index): ((&Part, _), u32)| {
            Network::new(part.name, Params::init(layout, key(index).stream()), part.policy)
        };
        Ok(parts.map(init).collect())
    }

    /// Statistics of no returns yet.
    pub fn value_norm(&self) -> ValueNorm {
        ValueNorm::new(self.config.mappo.value_norm)
    }

    /// One update on an iteration's batch. `progress` in [0, 1] is the share of the budget spent.
    ///
    /// # Errors
    /// [`Suspect`] names the episode whose log-probabilities are not those of the networks; then nothing has changed.
    pub fn update(
        &self,
        learned: &mut Learned,
        batch: &Batch,
        iteration: u32,
        progress: f64,
    ) -> std::result::Result<UpdateStats, UpdateError> {
        let m = &self.config.mappo;
        let (steps, episodes, n) = (batch.shape.steps, batch.shape.episodes, batch.shape.agents);
        let (parts, value_norm) = (self.model.parts(), &mut learned.value_norm);
        let networks = &mut learned.networks[..parts.len()];

        // 1. Values and memories under the weights that collected the batch.
        let constants = self.constants(networks)?;
        let all: Vec<usize> = (0..episodes).collect();
        let groups = all.par_chunks(self.together(batch)).map(|group| self.evaluate(&constants, batch, group));
        let evaluations: Vec<Evaluation> = groups.collect::<Result<Vec<_>>>()?.into_iter().flatten().collect();
        for (episode, evaluation) in evaluations.iter().enumerate() {
            self.check_log_probs(episode, evaluation.error)?;
        }

        // 2. Advantages and returns in raw units, with the statistics that the values were made under.
        let (mean, deviation) = value_norm.moments();
        let rows = episodes * steps * n;
        let (mut advantages, mut returns) = (vec![0.0; rows], vec![0.0; rows]);
        let mut old_values = Vec::with_capacity(rows);
        let gae = Gae { gamma: m.gamma, lambda: m.gae_lambda, bootstrap: m.bootstrap_at_horizon };
        for (episode, evaluation) in evaluations.iter().enumerate() {
            let raw: Vec<f32> = evaluation.values.iter().map(|v| v * deviation + mean).collect();
            let (from, to) = (episode * steps * n, (episode + 1) * steps * n);
            let marks = batch.marks_of(episode);
            for agent in 0..n {
                let (advantages, returns) = (&mut advantages[from + agent..to], &mut returns[from + agent..to]);
                let columns = (&batch.rewards[from + agent..to], &raw[agent..], marks.get(agent..).unwrap_or_default());
                gae.run(columns, n, advantages, returns);
            }
            old_values.extend_from_slice(&evaluation.values[..steps * n]);
        }
        normalise(&mut advantages, &batch.active);

        // 3. Epochs over shuffled minibatches of chunks.
        let units: Vec<(usize, usize)> =
            (0..episodes).flat_map(|e| (0..steps / self.chunk).map(move |c| (e, c * self.chunk))).collect();
        let per_minibatch = (m.minibatch_size / (self.chunk * n)).clamp(1, units.len());
        let minibatches = units.len().div_ceil(per_minibatch);
        let decay = if m.linear_decay { 1.0 - progress } else { 1.0 };
        let mut total = Totals { grad_norms: vec![0.0; parts.len()], ..Totals::default() };
        for epoch in 0..m.epochs {
            let mut order = units.clone();
            Key::new(self.config.run.seed, Purpose::Shuffle, &[iteration, epoch]).stream().shuffle(&mut order);
            for index in 0..minibatches {
                let units = &order[part(order.len(), minibatches, index)];
                let samples = batch.samples(units, self.chunk);
                if samples == 0.0 {
                    continue;
                }

                // 4. Value targets: the statistics take in this minibatch first.
                let statistics = *value_norm;
                value_norm.update(batch.acting(&returns, units, self.chunk).into_iter());
                let moments = value_norm.moments();

                // 5. Gradients of both losses, slice by slice.
                let (policy, value) = rayon::join(|| self.policy(networks), || self.value(networks));
                let (policy, value) = (policy?, value?);
                let count = m.gradient_slices.min(units.len());
                let slice = |s| Slice { batch, units: &units[part(units.len(), count, s)], chunk: self.chunk, samples };
                let slices: Vec<Slice<'_>> = (0..count).map(slice).collect();
                let losses = |s: &Slice<'_>| {
                    let features = s.features();
                    let (policy, value) = rayon::join(
                        || self.policy_loss(networks, &policy, (s, &features), &evaluations, &advantages),
                        || {
                            let (slice, targets) = ((s, &features), (&returns[..], moments));
                            self.value_loss(networks, &value, slice, &evaluations, targets, &old_values)
                        },
                    );
                    Ok((policy?, value?))
                };
                let both = slices.par_iter().map(losses).collect::<Result<Vec<_>>>()?;
                let (policy, value): (Vec<_>, Vec<_>) = both.into_iter().unzip();
                if epoch == 0 && index == 0 {
                    // The networks are still those that acted.
                    for (slice, (_, sums)) in slices.iter().zip(&policy) {
                        let (error, row) = sums.worst;
                        self.check_log_probs(slice.episode_of(row, m.joint_ratio), error)
                            .inspect_err(|_| *value_norm = statistics)?;
                    }
                }

                // 6. If a loss is not finite, skip the update of all networks; `value_norm` has taken in the minibatch by then.
                let mut sums = PolicySums::default();
                policy.iter().for_each(|(_, slice)| sums.add(slice));
                let value_sum = value.iter().map(|(_, slice)| slice).sum::<f64>();
                if !(sums.loss.is_finite() && value_sum.is_finite()) {
                    total.skipped += 1.0;
                    continue;
                }

                // 7. Clip by global norm, step. If only the gradient of one network is not finite, skip that network.
                let step = |(k, (network, part)): (usize, (&mut Network, &Part))| {
                    let gradients = policy.iter().map(|(g, _)| &g[k]).chain(value.iter().map(|(g, _)| &g[k]));
                    let rate = if part.policy { m.actor_learning_rate } else { m.critic_learning_rate } * decay;
                    let (values, limit) = (&mut network.params.values, m.max_grad_norm.into());
                    network.moments.adam_step(values, &sum_in_order(gradients), rate, m.adam_epsilon, limit)
                };
                let norms: Vec<f64> = networks.par_iter_mut().zip(parts).enumerate().map(step).collect();
                if norms.iter().any(|norm| !norm.is_finite()) {
                    total.skipped += 1.0;
                    continue;
                }
                if epoch == 0 && index == 0 {
                    total.first_ratio_error = sums.ratio_error;
                }
                total.minibatch(&sums, value_sum, &norms, samples.into());
            }
        }
        Ok(total.stats(parts))
    }

    /// The log-probabilities [E, T, N] of a batch's actions under these networks: what its actors should have sent.
    pub fn log_probs(&self, learned: &Learned, batch: &Batch) -> Result<Vec<f32>> {
        let (steps, n) = (batch.shape.steps, batch.shape.agents);
        let networks = &learned.networks[..self.model.parts().len()];
        let constant = |network: &Network| Ok(ParamBuilder::with(network.params.tensors()?));
        let policy = self.model.policy(&mut networks.iter().map(constant).collect::<Result<Vec<_>>>()?)?;
        let mut out = Vec::with_capacity(batch.shape.episodes * steps * n);
        for episode in 0..batch.shape.episodes {
            let mut hidden = vec![0.0; n * self.model.memory()];
            for start in (0..steps).step_by(self.chunk) {
                let slice = Slice { batch, units: &[(episode, start)], chunk: self.chunk, samples: 0.0 };
                let features = slice.features();
                let input = slice.input(&features, hidden.clone(), slice.noise());
                let (choices, moves) = (slice.actions(), slice.moves());
                let now = policy.evaluate(&input, Taken { choices: &choices, moves: &moves })?;
                out.extend(now.log_probs.to_vec1::<f32>()?);
                hidden = last_state(now.states.as_ref(), hidden)?;
            }
        }
        Ok(out)
    }

    /// Episodes that are evaluated together: enough rows for a pass to be worth it, few enough for every thread to get some. Rows do
    /// not depend on each other.
    fn together(&self, batch: &Batch) -> usize {
        let (states, n) = (batch.shape.steps + 1, batch.shape.agents);
        let (rows, wanted) = if self.model.memory() == 0 { (states * n, AT_ONCE / 2) } else { (n, STEP_ROWS) };
        (wanted / rows).max(1)
    }

    /// Values of all T+1 states of some episodes, and the memories entering each chunk, by running both networks through
    /// the episodes a chunk at a time.
    fn evaluate(&self, (policy, value): &Functions, batch: &Batch, episodes: &[usize]) -> Result<Vec<Evaluation>> {
        let (steps, n, memory) = (batch.shape.steps, batch.shape.agents, self.model.memory());
        let mut out = vec![Evaluation::default(); episodes.len()];
        let mut value_hidden = vec![0.0; episodes.len() * n * memory];
        let mut policy_hidden = value_hidden.clone();
        // Networks without memory have no chunks to respect: a chunk's length only bounds the working memory.
        let stride = if memory == 0 { (AT_ONCE / (episodes.len() * n)).max(10) } else { self.chunk };
        let mut start = 0;
        while start <= steps {
            let count = stride.min(steps + 1 - start);
            let units: Vec<(usize, usize)> = episodes.iter().map(|&episode| (episode, start)).collect();
            let slice = Slice { batch, units: &units, chunk: count, samples: 0.0 };
            let features = slice.features();
            let output = value.forward(&slice.input(&features, value_hidden.clone(), GraphNoise::Off))?;
            // [L, C, N]
            let values = output.out.flatten_all()?.to_vec1::<f32>()?;
            for (row, values) in values.chunks_exact(n).enumerate() {
                out[row % episodes.len()].values.extend_from_slice(values);
            }
            if memory > 0 && start < steps {
                let entering = policy_hidden.chunks_exact(n * memory).zip(value_hidden.chunks_exact(n * memory));
                for (out, (policy, value)) in out.iter_mut().zip(entering) {
                    out.policy_memory.extend_from_slice(policy);
                    out.value_memory.extend_from_slice(value);
                }
                value_hidden = last_state(output.states.as_ref(), value_hidden)?;
                let input = slice.input(&features, policy_hidden.clone(), slice.noise());
                let (choices, moves) = (slice.actions(), slice.moves());
                let now = policy.evaluate(&input, Taken { choices: &choices, moves: &moves })?;
                let differences = (now.log_probs - slice.column(&batch.log_probs)?)?;
                let differences = only(slice.active()?.as_ref(), differences)?.to_vec1::<f32>()?;
                for (row, differences) in differences.chunks_exact(n).enumerate() {
                    let out = &mut out[row % episodes.len()];
                    out.error = differences.iter().copied().fold(out.error, worse);
                }
                policy_hidden = last_state(now.states.as_ref(), policy_hidden)?;
            }
            start += count;
        }
        Ok(out)
    }

    /// Loss of the policy on one slice of a minibatch: −min(ρ A, clip(ρ, 1 ± ε) A) − c H, with the ratio
    /// ρ = exp(ln π − ln π_old) of the whole action of one agent and H the entropy summed over its components.
    fn policy_loss(
        &self,
        networks: &[Network],
        (policy, variables): &Differentiable<dyn Policy>,
        (slice, features): (&Slice<'_>, &Arc<Features>),
        evaluations: &[Evaluation],
        advantages: &[f32],
    ) -> Result<(Gradients, PolicySums)> {
        let m = &self.config.mappo;
        let hidden = slice.memories(|episode| &evaluations[episode].policy_memory);
        let (choices, moves) = (slice.actions(), slice.moves());
        let taken = Taken { choices: &choices, moves: &moves };
        let now = policy.evaluate(&slice.input(features, hidden, slice.noise()), taken)?;

        // Rows of agents that do not act have the ratio 1, no advantage and no entropy.
        let active = slice.active()?;
        let log_ratio = only(active.as_ref(), ops::minus(&now.log_probs, &slice.column(&slice.batch.log_probs)?)?)?;
        let entropies = only(active.as_ref(), now.entropies)?;
        let (log_ratio, advantages, entropies, agents) = if m.joint_ratio {
            let agents = slice.batch.shape.agents;
            let sum = |x: &Tensor| sum_of_rows(&x.reshape(((), agents))?);
            let mean = |x: &Tensor| sum(x)? / agents as f64;
            let (advantages, entropies) = (mean(&slice.column(advantages)?)?, mean(&entropies)?);
            (sum(&log_ratio)?, advantages, entropies, agents)
        } else {
            (log_ratio, slice.column(advantages)?, entropies, 1)
        };
        let ratio = ops::exp(&log_ratio)?;
        let surrogate = clipped_surrogate(&ratio, &advantages, m.clip_epsilon)?;
        // Means over the whole minibatch, so that the gradients of its slices add up.
        let objective = (&surrogate + (&entropies * f64::from(m.entropy_coef))?)?;
        let weight = agents as f64;
        let loss = (objective.sum_all()? * (-weight / f64::from(slice.samples)))?;

        let sums = PolicySums::of(&surrogate, &entropies, &ratio, &log_ratio, m.clip_epsilon)?.times(weight);
        Ok((gradients(networks, variables, &loss)?, sums))
    }

    /// Loss of the value function on one slice of a minibatch: [`clipped_value_loss`] in normalised units, and its sum.
    fn value_loss(
        &self,
        networks: &[Network],
        (value, variables): &Differentiable<dyn nets::Network>,
        (slice, features): (&Slice<'_>, &Arc<Features>),
        evaluations: &[Evaluation],
        (returns, (mean, deviation)): (&[f32], (f32, f32)),
        old_values: &[f32],
    ) -> Result<(Gradients, f64)> {
        let m = &self.config.mappo;
        let hidden = slice.memories(|episode| &evaluations[episode].value_memory);
        let values = value.forward(&slice.input(features, hidden, GraphNoise::Off))?.out.flatten_all()?;

        let mut targets = slice.batch.rows(returns, 1, slice.units, slice.chunk);
        targets.iter_mut().for_each(|r| *r = (*r - mean) / deviation);
        let (targets, old_values) = (column(targets)?, slice.column(old_values)?);
        let losses = clipped_value_loss(&values, &old_values, &targets, m.clip_epsilon, m.huber_delta)?;
        let losses = only(slice.active()?.as_ref(), losses)?;
        let loss = (losses.sum_all()? * (1.0 / f64::from(slice.samples)))?;

        Ok((gradients(networks, variables, &loss)?, sum(&losses)?))
    }

    /// Refuses log-probabilities that the networks do not give.
    fn check_log_probs(&self, episode: usize, error: f64) -> std::result::Result<(), Suspect> {
        let limit = self.tolerance;
        if error <= limit { Ok(()) } else { Err(Suspect { trajectory: episode, field: "log_probs", error, limit }) }
    }

    /// Policy and value function without a gradient.
    fn constants(&self, networks: &[Network]) -> Result<Functions> {
        let constant = |network: &Network| Ok(ParamBuilder::with(network.params.tensors()?));
        let constants = || networks.iter().map(constant).collect::<Result<Vec<_>>>();
        Ok((self.model.policy(&mut constants()?)?, self.model.value(&mut constants()?)?))
    }

    /// The policy on variables, which all slices of a minibatch share.
    fn policy(&self, networks: &[Network]) -> Result<Differentiable<dyn Policy>> {
        let (variables, mut parts) = self.variables(networks, |part| part.policy)?;
        Ok((self.model.policy(&mut parts)?, variables))
    }

    /// The same for the value function.
    fn value(&self, networks: &[Network]) -> Result<Differentiable<dyn nets::Network>> {
        let (variables, mut parts) = self.variables(networks, |part| part.value)?;
        Ok((self.model.value(&mut parts)?, variables))
    }

    /// Variables of the parts that a loss reads (none of the others), and a builder for each part.
    fn variables(&self, networks: &[Network], reads: fn(&Part) -> bool) -> Result<(Vec<Vec<Var>>, Vec<ParamBuilder>)> {
        let parts = networks.iter().zip(self.model.parts());
        let variables =
            parts.map(|(network, part)| if reads(part) { network.params.variables() } else { Ok(Vec::new()) });
        let variables = variables.collect::<CandleResult<Vec<Vec<Var>>>>()?;
        let builder = |vars: &Vec<Var>| ParamBuilder::with(vars.iter().map(|v| v.as_tensor().clone()).collect());
        let builders = variables.iter().map(builder).collect();
        Ok((variables, builders))
    }
}

/// min(ρ A, clip(ρ, 1 ± ε) A), element by element.
pub(crate) fn clipped_surrogate(ratio: &Tensor, advantages: &Tensor, clip: f32) -> CandleResult<Tensor> {
    let clipped = ops::times(&ops::clamp(ratio, 1.0 - clip, 1.0 + clip)?, advantages)?;
    ops::minimum(&ops::times(ratio, advantages)?, &clipped)
}

/// max( hub(V_c − y), hub(V − y) ) with V_c = V_old + clip(V − V_old, ± ε), element by element.
fn clipped_value_loss(values: &Tensor, old: &Tensor, targets: &Tensor, clip: f32, delta: f32) -> CandleResult<Tensor> {
    let clipped = ops::plus(&ops::clamp(&ops::minus(values, old)?, -clip, clip)?, old)?;
    let loss = |values: &Tensor| ops::huber(&ops::minus(values, targets)?, delta);
    ops::maximum(&loss(values)?, &loss(&clipped)?)
}

fn gradients(networks: &[Network], variables: &[Vec<Var>], loss: &Tensor) -> Result<Gradients> {
    let store = loss.backward()?;
    let flat = |(network, variables): (&Network, &Vec<Var>)| Ok(network.params.gradient(variables, &store)?);
    networks.iter().zip(variables).map(flat).collect()
}

/// The larger of an error and |x|; infinite if x is no number.
fn worse(error: f64, x: f32) -> f64 {
    if x.is_nan() { f64::INFINITY } else { error.max(f64::from(x.abs())) }
}

/// (A − mean) / (standard deviation + 1e-5) over the samples of agents that act (all, if `active` is empty); 0 for the others.
fn normalise(advantages: &mut [f32], active: &[f32]) {
    let acts = |place: usize| active.get(place).is_none_or(|active| *active != 0.0);
    let acting = || advantages.iter().enumerate().filter(|(place, _)| acts(*place)).map(|(_, &a)| f64::from(a));
    let count = acting().count().max(1) as f64;
    let mean = acting().sum::<f64>() / count;
    let variance = acting().map(|a| (a - mean).powi(2)).sum::<f64>() / count;
    let scale = 1.0 / (variance.sqrt() + 1e-5);
    for (place, a) in advantages.iter_mut().enumerate() {
        *a = if acts(place) { ((f64::from(*a) - mean) * scale) as f32 } else { 0.0 };
    }
}

/// The rows of agents that act; 0 for the others.
fn only(active: Option<&Tensor>, rows: Tensor) -> CandleResult<Tensor> {
    match active {
        Some(active) => rows * active,
        None => Ok(rows),
    }
}

/// The `index`-th of `parts` nearly equal consecutive ranges of 0..count.
pub(crate) fn part(count: usize, parts: usize, index: usize) -> std::ops::Range<usize> {
    count * index / parts..count * (index + 1) / parts
}

/// Σ of the gradients, first slice first.
pub(crate) fn sum_in_order<'a>(gradients: impl Iterator<Item = &'a Vec<f32>>) -> Vec<f32> {
    let mut gradients = gradients.filter(|gradient| !gradient.is_empty());
    let mut total = gradients.next().cloned().unwrap_or_default();
    for gradient in gradients {
        for (t, g) in total.iter_mut().zip(gradient) {
            *t += g;
        }
    }
    total
}

/// The memory after the last step.
fn last_state(states: Option<&Tensor>, otherwise: Vec<f32>) -> CandleResult<Vec<f32>> {
    match states {
        Some(states) => states.get(states.dim(0)? - 1)?.flatten_all()?.to_vec1::<f32>(),
        None => Ok(otherwise),
    }
}

/// Σ in order, in double precision.
pub(crate) fn sum(values: &Tensor) -> CandleResult<f64> {
    Ok(values.to_vec1::<f32>()?.into_iter().map(f64::from).sum())
}

#[cfg(test)]
mod tests;
