//! MAPPO (Yu et al. 2022) for the action executor, from top to bottom: values → advantages → epochs → minibatches →
//! losses → clipped gradients → Adam. Actor and critic are two networks with two optimisers.
//!
//! Every sum has a fixed order: a minibatch is cut into a fixed number of shards whose gradients are added in order,
//! however many threads compute them. The number of threads does not reach a number.

use crate::train::adam::Adam;
use crate::train::batch::Batch;
use crate::train::gae::{Gae, ValueNorm};
use candle_core::{Device, Result, Tensor, Var};
use magex_core::config::{ExecutorKind, RunConfig};
use magex_core::rng::{Key, Purpose};
use magex_nets::distribution::ActionHeads;
use magex_nets::executor::{self, Input, Network};
use magex_nets::features::FeatureSpec;
use magex_nets::ops::{self, GraphNoise};
use magex_nets::params::{ParamError, Params, Source};
use rayon::prelude::*;
use std::sync::Arc;

/// Everything that learning changes. A checkpoint holds exactly this (and the commander's counterpart).
#[derive(Debug, Clone, PartialEq)]
pub struct ExecutorState {
    /// Policy network.
    pub actor: Params,
    /// Value network.
    pub critic: Params,
    /// Moments of the actor's gradient.
    pub actor_adam: Adam,
    /// Moments of the critic's gradient.
    pub critic_adam: Adam,
    /// Running statistics of returns.
    pub value_norm: ValueNorm,
}

/// What an update did; means over all minibatches of all epochs.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub struct UpdateStats {
    /// Clipped surrogate loss.
    pub policy_loss: f64,
    /// Clipped Huber loss in normalised units.
    pub value_loss: f64,
    /// Entropy of an agent's action, in nats.
    pub entropy: f64,
    /// Share of samples outside the clip range.
    pub clip_fraction: f64,
    /// Estimated divergence from the old policy, in nats.
    pub divergence: f64,
    /// max |ρ − 1| over the first minibatch, before any step: 0 unless actor and learner disagree.
    pub first_ratio_error: f64,
    /// Norm of the actor's gradient before clipping.
    pub actor_grad_norm: f64,
    /// Norm of the critic's gradient before clipping.
    pub critic_grad_norm: f64,
    /// Minibatches left out because a loss or a gradient was not finite.
    pub skipped: f64,
}

/// The algorithm with its settings.
#[derive(Debug)]
pub struct Mappo {
    config: RunConfig,
    spec: FeatureSpec,
    heads: ActionHeads,
    agents: usize,
    /// L: steps of a chunk; 1 for networks without memory.
    chunk: usize,
}

/// Values and memories under the weights that an iteration starts with.
struct Evaluation {
    /// [T+1, N] normalised values of one episode.
    values: Vec<f32>,
    /// [T/L, N, H] memory of the actor entering each chunk.
    actor_memory: Vec<f32>,
    /// [T/L, N, H] memory of the critic entering each chunk.
    critic_memory: Vec<f32>,
}

/// Which of the two networks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    Actor,
    Critic,
}

impl Mappo {
    /// Checks that the task's actions fit, and fixes the sizes.
    pub fn new(config: &RunConfig) -> std::result::Result<Self, ParamError> {
        let heads = ActionHeads::new(config.task.action_heads())
            .ok_or_else(|| ParamError::Mismatch("an action component must have 1 to 16 choices".to_owned()))?;
        Ok(Self {
            spec: executor::feature_spec(&config.executor, &config.task),
            heads,
            agents: config.task.agents,
            chunk: if config.executor.kind == ExecutorKind::Local { 1 } else { config.mappo.chunk_length },
            config: config.clone(),
        })
    }

    /// What the networks see.
    pub fn spec(&self) -> &FeatureSpec {
        &self.spec
    }

    /// Fresh networks and optimisers.
    pub fn start(&self) -> std::result::Result<ExecutorState, ParamError> {
        let draw = |role: Role, index: u32| -> std::result::Result<Params, ParamError> {
            let mut source = Source::new(Key::new(self.config.run.seed, Purpose::Init, &[index]).stream());
            self.network(role, &mut source)?;
            match source {
                Source::New { params, .. } => Ok(params),
                Source::Existing { .. } => Err(ParamError::Mismatch("a new source became an existing one".to_owned())),
            }
        };
        let (actor, critic) = (draw(Role::Actor, 0)?, draw(Role::Critic, 1)?);
        Ok(ExecutorState {
            actor_adam: Adam::new(actor.numbers.len()),
            critic_adam: Adam::new(critic.numbers.len()),
            value_norm: ValueNorm::new(self.config.mappo.value_norm),
            actor,
            critic,
        })
    }

    fn network(&self, role: Role, source: &mut Source<'_>) -> std::result::Result<Box<dyn Network>, ParamError> {
        let (outputs, gain) = match role {
            Role::Actor => (self.heads.logits(), 0.01),
            Role::Critic => (1, 1.0),
        };
        executor::build(&self.config.executor, &self.spec, self.agents, outputs, gain, source)
    }

    /// One update of actor and critic on an iteration's batch. `progress` in [0, 1] is the share of the budget spent.
    pub fn update(
        &self,
        state: &mut ExecutorState,
        batch: &Batch,
        iteration: u32,
        progress: f64,
    ) -> std::result::Result<UpdateStats, ParamError> {
        let m = &self.config.mappo;
        let (steps, episodes, n) = (batch.shape.steps, batch.shape.episodes, batch.shape.agents);

        // 1. Values and memories under the weights that collected the batch.
        let evaluations: Vec<Evaluation> = (0..episodes)
            .into_par_iter()
            .map(|episode| self.evaluate(state, batch, episode))
            .collect::<std::result::Result<_, _>>()?;

        // 2. Advantages and returns in raw units, with the statistics that the values were made under.
        let (mean, deviation) = state.value_norm.moments();
        let rows = episodes * steps * n;
        let (mut advantages, mut returns) = (vec![0.0; rows], vec![0.0; rows]);
        let mut old_values = Vec::with_capacity(rows);
        let gae = Gae { gamma: m.gamma, lambda: m.gae_lambda, bootstrap: m.bootstrap_at_horizon };
        for (episode, evaluation) in evaluations.iter().enumerate() {
            let raw: Vec<f32> = evaluation.values.iter().map(|v| v * deviation + mean).collect();
            let (from, to) = (episode * steps * n, (episode + 1) * steps * n);
            for agent in 0..n {
                gae.run(
                    &batch.rewards[from + agent..to],
                    &raw[agent..],
                    n,
                    &mut advantages[from + agent..to],
                    &mut returns[from + agent..to],
                );
            }
            old_values.extend_from_slice(&evaluation.values[..steps * n]);
        }
        normalise(&mut advantages);

        // 3. Epochs over shuffled minibatches of chunks.
        let units: Vec<(usize, usize)> =
            (0..episodes).flat_map(|e| (0..steps / self.chunk).map(move |c| (e, c * self.chunk))).collect();
        let per_minibatch = (m.minibatch_size / (self.chunk * n)).clamp(1, units.len());
        let minibatches = units.len().div_ceil(per_minibatch);
        let decay = if m.linear_decay { 1.0 - progress } else { 1.0 };
        let mut stats = UpdateStats::default();
        let mut done = 0.0;
        for epoch in 0..m.epochs {
            let mut order = units.clone();
            Key::new(self.config.run.seed, Purpose::Shuffle, &[iteration, epoch]).stream().shuffle(&mut order);
            for index in 0..minibatches {
                let units = &order[part(order.len(), minibatches, index)];
                let samples = (units.len() * self.chunk * n) as f32;

                // 4. Value targets: the statistics take in this minibatch first, as the MAPPO authors do.
                state.value_norm.update(batch.rows(&returns, 1, units, self.chunk).into_iter());
                let (mean, deviation) = state.value_norm.moments();

                // 5. Gradients of both networks, shard by shard.
                let shards = m.gradient_slices.min(units.len());
                let jobs: Vec<(Role, usize)> = [Role::Actor, Role::Critic]
                    .into_iter()
                    .flat_map(|role| (0..shards).map(move |s| (role, s)))
                    .collect();
                let results: Vec<(Vec<f32>, PolicyStats, f64)> = jobs
                    .into_par_iter()
                    .map(|(role, shard)| {
                        let units = &units[part(units.len(), shards, shard)];
                        let data = ShardData { batch, units, evaluations: &evaluations, scale: 1.0 / samples };
                        match role {
                            Role::Actor => self.policy_gradient(state, &data, &advantages),
                            Role::Critic => self.value_gradient(state, &data, &returns, &old_values, mean, deviation),
                        }
                    })
                    .collect::<std::result::Result<_, _>>()?;
                let (actor_results, critic_results) = results.split_at(shards);
                let actor_gradient = sum_in_order(actor_results);
                let critic_gradient = sum_in_order(critic_results);

                // 6. Clip by global norm, step. Where a loss is not finite neither network moves, and where a gradient is not, not
                // its own; the value statistics have taken the minibatch in by then.
                let sum = |f: fn(&PolicyStats) -> f64| actor_results.iter().map(|r| f(&r.1)).sum::<f64>();
                let value_sum = critic_results.iter().map(|r| r.2).sum::<f64>();
                if !(sum(|s| s.loss).is_finite() && value_sum.is_finite()) {
                    stats.skipped += 1.0;
                    continue;
                }
                let actor_norm = state.actor_adam.step(
                    &mut state.actor.numbers,
                    &actor_gradient,
                    m.actor_learning_rate * decay,
                    m.adam_epsilon,
                    m.max_grad_norm.into(),
                );
                let critic_norm = state.critic_adam.step(
                    &mut state.critic.numbers,
                    &critic_gradient,
                    m.critic_learning_rate * decay,
                    m.adam_epsilon,
                    m.max_grad_norm.into(),
                );

                // 7. Bookkeeping.
                if !(actor_norm.is_finite() && critic_norm.is_finite()) {
                    stats.skipped += 1.0;
                    continue;
                }
                let samples = f64::from(samples);
                stats.policy_loss += sum(|s| s.loss) / samples;
                stats.entropy += sum(|s| s.entropy) / samples;
                stats.clip_fraction += sum(|s| s.clipped) / samples;
                stats.divergence += sum(|s| s.divergence) / samples;
                stats.value_loss += value_sum / samples;
                stats.actor_grad_norm += actor_norm;
                stats.critic_grad_norm += critic_norm;
                if epoch == 0 && index == 0 {
                    stats.first_ratio_error = actor_results.iter().map(|r| r.1.ratio_error).fold(0.0, f64::max);
                }
                done += 1.0;
            }
        }
        for mean in [
            &mut stats.policy_loss,
            &mut stats.value_loss,
            &mut stats.entropy,
            &mut stats.clip_fraction,
            &mut stats.divergence,
            &mut stats.actor_grad_norm,
            &mut stats.critic_grad_norm,
        ] {
            *mean /= f64::max(done, 1.0);
        }
        Ok(stats)
    }

    /// Values of all T+1 states of one episode, and the memories entering each chunk, by running both networks through
    /// the episode a chunk at a time.
    fn evaluate(
        &self,
        state: &ExecutorState,
        batch: &Batch,
        episode: usize,
    ) -> std::result::Result<Evaluation, ParamError> {
        let (steps, n) = (batch.shape.steps, batch.shape.agents);
        let actor = self.network(Role::Actor, &mut state.actor.source(state.actor.plain()?))?;
        let critic = self.network(Role::Critic, &mut state.critic.source(state.critic.plain()?))?;
        let memory = critic.memory();
        let mut out = Evaluation {
            values: Vec::with_capacity((steps + 1) * n),
            actor_memory: Vec::new(),
            critic_memory: Vec::new(),
        };
        let mut critic_hidden = vec![0.0; n * memory];
        let mut actor_hidden = critic_hidden.clone();
        // Networks without memory have no chunks to respect: a chunk's length only bounds the working memory.
        let stride = if memory == 0 { 10 } else { self.chunk };
        let mut start = 0;
        while start <= steps {
            let count = stride.min(steps + 1 - start);
            let units = [(episode, start)];
            let features = batch.gather(&units, count);
            let input = |hidden: &[f32], noise| Input {
                steps: count,
                sequences: 1,
                agents: n,
                features: &features,
                hidden: hidden.to_vec(),
                noise,
            };
            let output = critic.forward(&input(&critic_hidden, GraphNoise::Off))?;
            out.values.extend(output.out.flatten_all()?.to_vec1::<f32>()?);
            if memory > 0 && start < steps {
                out.actor_memory.extend_from_slice(&actor_hidden);
                out.critic_memory.extend_from_slice(&critic_hidden);
                critic_hidden = last_state(output.states.as_ref(), critic_hidden)?;
                let noise = GraphNoise::Keyed(Arc::new(batch.noise_keys(&units, count)));
                actor_hidden = last_state(actor.forward(&input(&actor_hidden, noise))?.states.as_ref(), actor_hidden)?;
            }
            start += count;
        }
        Ok(out)
    }

    fn policy_gradient(
        &self,
        state: &ExecutorState,
        data: &ShardData<'_>,
        advantages: &[f32],
    ) -> std::result::Result<(Vec<f32>, PolicyStats, f64), ParamError> {
        let (batch, m) = (data.batch, &self.config.mappo);
        let row = |values: &[f32]| column(batch.rows(values, 1, data.units, self.chunk));
        let actions = batch.rows(&batch.actions, batch.shape.action_components, data.units, self.chunk);
        let (old_log_probs, advantages) = (row(&batch.log_probs)?, row(advantages)?);
        let noise = GraphNoise::Keyed(Arc::new(batch.noise_keys(data.units, self.chunk)));
        let mut stats = PolicyStats::default();
        let gradient = self.gradient(Role::Actor, &state.actor, data, noise, |logits| {
            let now = ops::action_log_probs(logits, actions, &self.heads)?;
            let (log_probs, entropy) = (now.get(0)?, now.get(1)?);
            let log_ratio = (log_probs - old_log_probs)?;
            let ratio = ops::exp(&log_ratio)?;
            let surrogate = clipped_surrogate(&ratio, &advantages, m.clip_epsilon)?;
            stats = PolicyStats::of(&surrogate, &entropy, &ratio, &log_ratio, m.clip_epsilon)?;
            // Scaled by the rows of the whole minibatch, so that the gradients of its slices add up.
            (surrogate + (entropy * f64::from(m.entropy_coef))?)?.sum_all()? * -f64::from(data.scale)
        })?;
        Ok((gradient, stats, 0.0))
    }

    #[allow(clippy::too_many_arguments)] // each is one symbol of the value loss
    fn value_gradient(
        &self,
        state: &ExecutorState,
        data: &ShardData<'_>,
        returns: &[f32],
        old_values: &[f32],
        mean: f32,
        deviation: f32,
    ) -> std::result::Result<(Vec<f32>, PolicyStats, f64), ParamError> {
        let batch = data.batch;
        let mut targets = batch.rows(returns, 1, data.units, self.chunk);
        targets.iter_mut().for_each(|r| *r = (*r - mean) / deviation);
        let old_values = column(batch.rows(old_values, 1, data.units, self.chunk))?;
        let targets = column(targets)?;
        let mut total = 0.0;
        let m = &self.config.mappo;
        let gradient = self.gradient(Role::Critic, &state.critic, data, GraphNoise::Off, |values| {
            let values = values.flatten_all()?;
            let loss = clipped_value_loss(&values, &old_values, &targets, m.clip_epsilon, m.huber_delta)?;
            total = sum(&loss)?;
            loss.sum_all()? * f64::from(data.scale)
        })?;
        Ok((gradient, PolicyStats::default(), total))
    }

    /// Forward through one network, loss, backward; the gradient as flat as the parameters.
    fn gradient(
        &self,
        role: Role,
        params: &Params,
        data: &ShardData<'_>,
        noise: GraphNoise,
        loss: impl FnOnce(&Tensor) -> Result<Tensor>,
    ) -> std::result::Result<Vec<f32>, ParamError> {
        let variables = params.variables()?;
        let mut source = params.source(variables.iter().map(|v: &Var| v.as_tensor().clone()).collect());
        let network = self.network(role, &mut source)?;
        let features = data.batch.gather(data.units, self.chunk);
        let n = data.batch.shape.agents;
        let input = Input {
            steps: self.chunk,
            sequences: data.units.len(),
            agents: n,
            features: &features,
            hidden: data.memories(role, n * network.memory(), self.chunk),
            noise,
        };
        let loss = loss(&network.forward(&input)?.out)?;
        let gradients = loss.backward()?;
        let mut flat = Vec::with_capacity(params.numbers.len());
        for (entry, variable) in params.entries.iter().zip(&variables) {
            match gradients.get(variable) {
                Some(gradient) => flat.extend(gradient.flatten_all()?.to_vec1::<f32>()?),
                None => flat.resize(flat.len() + entry.len(), 0.0),
            }
        }
        Ok(flat)
    }
}

/// min(ρ A, clip(ρ, 1 ± ε) A), element by element.
pub(crate) fn clipped_surrogate(ratio: &Tensor, advantages: &Tensor, clip: f32) -> Result<Tensor> {
    let clipped = (ratio.clamp(1.0 - clip, 1.0 + clip)? * advantages)?;
    (ratio * advantages)?.minimum(&clipped)
}

/// max( hub(y − V_c), hub(y − V) ) with V_c = V_old + clip(V − V_old, ± ε), element by element.
fn clipped_value_loss(values: &Tensor, old: &Tensor, targets: &Tensor, clip: f32, delta: f32) -> Result<Tensor> {
    let clipped = (old + (values - old)?.clamp(-clip, clip)?)?;
    huber(&(targets - values)?, delta)?.maximum(&huber(&(targets - clipped)?, delta)?)
}

/// e²/2 for |e| ≤ δ, δ (|e| − δ/2) beyond, element by element.
fn huber(error: &Tensor, delta: f32) -> Result<Tensor> {
    let size = error.abs()?;
    let inner = size.minimum(delta)?;
    let outer = ((size - &inner)? * f64::from(delta))?;
    (inner.sqr()? * 0.5)? + outer
}

/// What the policy loss saw, summed over rows in double precision.
#[derive(Debug, Clone, Copy, Default)]
struct PolicyStats {
    loss: f64,
    entropy: f64,
    clipped: f64,
    divergence: f64,
    ratio_error: f64,
}

impl PolicyStats {
    fn of(surrogate: &Tensor, entropy: &Tensor, ratio: &Tensor, log_ratio: &Tensor, clip: f32) -> Result<Self> {
        let mut stats = Self { loss: -sum(surrogate)?, entropy: sum(entropy)?, ..Self::default() };
        for (ratio, log_ratio) in ratio.to_vec1::<f32>()?.into_iter().zip(log_ratio.to_vec1::<f32>()?) {
            stats.clipped += f64::from(u8::from((ratio - 1.0).abs() > clip));
            stats.divergence += f64::from(ratio - 1.0 - log_ratio);
            stats.ratio_error = stats.ratio_error.max(f64::from((ratio - 1.0).abs()));
        }
        Ok(stats)
    }
}

fn column(values: Vec<f32>) -> Result<Tensor> {
    let rows = values.len();
    Tensor::from_vec(values, rows, &Device::Cpu)
}

/// Σ in order, in double precision.
fn sum(values: &Tensor) -> Result<f64> {
    Ok(values.to_vec1::<f32>()?.into_iter().map(f64::from).sum())
}

/// One shard of a minibatch.
struct ShardData<'a> {
    batch: &'a Batch,
    /// (episode, first step) of each chunk.
    units: &'a [(usize, usize)],
    evaluations: &'a [Evaluation],
    /// 1 / samples of the whole minibatch.
    scale: f32,
}

impl ShardData<'_> {
    /// [C·N·H] memories entering the chunks, as they were when the iteration started.
    fn memories(&self, role: Role, width: usize, chunk: usize) -> Vec<f32> {
        let mut out = Vec::with_capacity(self.units.len() * width);
        for &(episode, start) in self.units {
            let memory = match role {
                Role::Actor => &self.evaluations[episode].actor_memory,
                Role::Critic => &self.evaluations[episode].critic_memory,
            };
            let at = start / chunk * width;
            out.extend_from_slice(&memory[at..at + width]);
        }
        out
    }
}

/// (A − mean) / (standard deviation + 1e-5) over all samples.
fn normalise(advantages: &mut [f32]) {
    let count = advantages.len().max(1) as f64;
    let mean = advantages.iter().map(|&a| f64::from(a)).sum::<f64>() / count;
    let variance = advantages.iter().map(|&a| (f64::from(a) - mean).powi(2)).sum::<f64>() / count;
    let scale = 1.0 / (variance.sqrt() + 1e-5);
    for a in advantages {
        *a = ((f64::from(*a) - mean) * scale) as f32;
    }
}

/// The `index`-th of `parts` nearly equal consecutive ranges of 0..count.
fn part(count: usize, parts: usize, index: usize) -> std::ops::Range<usize> {
    count * index / parts..count * (index + 1) / parts
}

/// Σ of the shards' gradients, first shard first.
fn sum_in_order(results: &[(Vec<f32>, PolicyStats, f64)]) -> Vec<f32> {
    let mut total = results.first().map(|r| r.0.clone()).unwrap_or_default();
    for (gradient, ..) in results.iter().skip(1) {
        for (t, g) in total.iter_mut().zip(gradient) {
            *t += g;
        }
    }
    total
}

/// The memory after the last step.
fn last_state(states: Option<&Tensor>, otherwise: Vec<f32>) -> Result<Vec<f32>> {
    match states {
        Some(states) => states.get(states.dim(0)? - 1)?.flatten_all()?.to_vec1::<f32>(),
        None => Ok(otherwise),
    }
}

#[cfg(test)]
mod tests;
