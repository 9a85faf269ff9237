//! PPO for the goal commander: one decision per episode and stage, reward R_c = 1 − C_c / C_h (paper, eq. 4), known as soon as
//! the decision is made. The baseline is the reward of the greedy decision on the same instance (self-critical), so no critic
//! is needed.
//!
//! With the objective `arrival`, the reward is what was measured in the episode instead, the same for all its stages. The
//! surrogate is clipped pick by pick: the ratio of a whole 50-agent decision would leave the clip range at once.

mod arrival;
#[cfg(test)]
mod arrival_tests;
mod imitation;
#[cfg(test)]
mod tests;

use crate::train::batch::column;
use crate::train::learned::Network;
use crate::train::mappo::clipped_surrogate;
use crate::train::suspect::{LOG_PROB_TOLERANCE, Suspect, UpdateError};
use candle_core::{Tensor, Var};
use magex_core::config::{CommanderConfig, CommanderObjective};
use magex_core::joint_state::group_positions;
use magex_core::keys::random_goals;
use magex_core::rng::{Key, Purpose};
use magex_core::statics::LANDMARKS;
use magex_core::task::{Stage, TaskConfig};
use magex_core::trajectory::Trajectory;
use magex_nets::commander::{Commander, CommanderError, Instance, Team};
use magex_nets::ops::{self, Pick};
use magex_nets::params::{ParamBuilder, ParamError};

pub use imitation::Lesson;

/// The name of its network.
pub const NAME: &str = "commander";

/// One team and what was decided for it.
#[derive(Debug, Clone)]
pub struct Sample {
    /// What the network saw.
    pub instance: Instance,
    /// What was decided, in the order of the picks.
    pub picks: Vec<Pick>,
    /// Log-probability of each pick when it was decided.
    pub log_probs: Vec<f32>,
    /// R_c of the decision minus R_c of the greedy decision; or the measured reward minus its forecast.
    pub advantage: f32,
}

/// What an update did.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub struct CommanderStats {
    /// Clipped surrogate loss.
    pub loss: f64,
    /// Mean entropy of a pick, in nats.
    pub entropy: f64,
    /// C_c / C_h of the greedy decision on the iteration's teams.
    pub greedy_cost_ratio: f64,
    /// max over episodes of |Δ log-probability of the whole decision| / picks between commander and learner.
    pub first_ratio_error: f64,
    /// Decisions and minibatches left out because an advantage, a loss or a gradient was not finite.
    pub skipped: f64,
}

/// The algorithm with its settings.
#[derive(Debug, Clone)]
pub struct CommanderPpo {
    config: CommanderConfig,
    agents: usize,
    dims: usize,
    horizon: u32,
    stages: &'static [Stage],
    seed: u64,
}

impl CommanderPpo {
    /// For the teams of a task.
    pub fn new(config: &CommanderConfig, task: &TaskConfig, seed: u64) -> Self {
        let TaskConfig { agents, horizon, .. } = *task;
        Self { config: config.clone(), agents, dims: task.dims(), horizon, stages: task.stages(), seed }
    }

    /// Initial network and optimiser; without parameters if the scheduler is not learned.
    pub fn init(&self) -> Result<Network, ParamError> {
        let params = Commander::init(&self.config, self.agents, self.dims, self.seed)?;
        Ok(Network::new(NAME, params, true))
    }

    /// The scheduler with the parameters of a network, as constants.
    pub fn commander(&self, network: &Network) -> Result<Commander, ParamError> {
        Commander::of(&self.config, self.agents, self.dims, &network.params)
    }

    /// One update on the decisions of an iteration's episodes, with `rate_factor` (0 to 1) of the configured step size. Does
    /// nothing if the scheduler is not learned.
    pub fn update(
        &self,
        network: &mut Network,
        trajectories: &[Trajectory],
        iteration: u32,
        rate_factor: f64,
    ) -> Result<CommanderStats, UpdateError> {
        if !self.config.kind.learned() {
            return Ok(CommanderStats::default());
        }
        let commander = self.commander(network)?;
        // Of every episode: what was measured, and what was known of its instances before the decisions.
        let (mut rewards, mut known) = (Vec::new(), Vec::<Vec<f64>>::new());
        let mut decided = Vec::new();
        for (trajectory, t) in trajectories.iter().enumerate() {
            let (stages, points) = (self.stages.len(), (&*t.positions, t.statics.get(LANDMARKS)));
            for b in 0..t.shape.episodes {
                if random_goals(self.seed, &t.shard, b as u32, self.config.random_assignment_fraction).is_some() {
                    // The scheduler had no say in this episode.
                    continue;
                }
                rewards.push(arrival::reward(&t.metrics[b], self.horizon, self.config.collision_cost));
                known.push(Vec::new());
                for (k, stage) in self.stages.iter().enumerate() {
                    let team = Team {
                        agents: group_positions(&t.shape, points, stage.from, b),
                        goals: group_positions(&t.shape, points, stage.to, b),
                        dims: t.shape.dims,
                    };
                    let instance = commander.instance(&team)?;
                    let picks = stage_goals(t, b, k).and_then(|goals| instance.picks_of(&goals)).ok_or_else(|| {
                        CommanderError::Instance(format!("the goals of stage {k} of episode {b} are not one-to-one"))
                    })?;
                    decided.push(((instance, picks), team, (trajectory, b * stages + k, rewards.len() - 1)));
                }
            }
        }
        let (mut samples, mut episode_of_sample) = (Vec::new(), Vec::new());
        let (mut ratio_sum, mut error, mut skipped) = (0.0, 0.0f64, 0.0);
        let mut decided = decided.into_iter().peekable();
        // Many at a time: one alone is not worth a pass of the network.
        while decided.peek().is_some() {
            let group: Vec<_> = decided.by_ref().take(self.config.minibatch).collect();
            let (instances, picks): (Vec<&Instance>, Vec<&[Pick]>) =
                group.iter().map(|((instance, picks), ..)| (instance, &**picks)).unzip();
            let scores = commander.scores(&instances)?;
            let log_probs = Commander::log_probs_of(&scores, &instances, &picks)?.get(0)?.to_vec1::<f32>()?;
            let (scores, mut log_probs) = (scores.flatten_all()?.to_vec1::<f32>()?, log_probs.into_iter());
            let mut rest = &scores[..];
            for ((instance, picks), team, (trajectory, at, episode)) in group {
                let (own, others) = rest.split_at(instance.cells());
                rest = others;
                let log_probs: Vec<f32> = log_probs.by_ref().take(picks.len()).collect();
                let (t, goals) = (&trajectories[trajectory], instance.decide(own, None).0.goals);
                let greedy = cost(&team, &goals);
                known[episode].extend([greedy, arrival::longest(&team, &goals)]);
                let exact = f64::from(t.exact_costs[at]).max(1e-9);
                let advantage = ((greedy - f64::from(t.costs[at])) / exact) as f32;
                if !advantage.is_finite() {
                    // It would spoil the scale of all others.
                    skipped += 1.0;
                    continue;
                }
                ratio_sum += greedy / exact;
                // In the commander's order.
                let total = log_probs.iter().sum::<f32>();
                let difference = f64::from((total - t.goal_log_probs[at]).abs()) / picks.len().max(1) as f64;
                if difference.is_nan() || difference > LOG_PROB_TOLERANCE {
                    let (field, limit) = ("goal_log_probs", LOG_PROB_TOLERANCE);
                    return Err(Suspect { trajectory, field, error: difference, limit }.into());
                }
                error = error.max(difference);
                episode_of_sample.push(episode);
                samples.push(Sample { instance, picks, log_probs, advantage });
            }
        }
        if self.config.objective == CommanderObjective::Arrival {
            let advantages = arrival::advantages(&rewards, &known);
            for (sample, &episode) in samples.iter_mut().zip(&episode_of_sample) {
                sample.advantage = advantages[episode] as f32;
            }
            let all = samples.len();
            samples.retain(|sample| sample.advantage.is_finite());
            skipped += (all - samples.len()) as f64;
        }
        if samples.is_empty() {
            return Ok(CommanderStats { skipped, ..CommanderStats::default() });
        }
        let mut stats = self.improve(network, &samples, iteration, rate_factor)?;
        stats.greedy_cost_ratio = ratio_sum / samples.len().max(1) as f64;
        stats.first_ratio_error = error;
        stats.skipped += skipped;
        Ok(stats)
    }

    /// PPO epochs over given samples.
    pub fn improve(
        &self,
        network: &mut Network,
        samples: &[Sample],
        iteration: u32,
        rate_factor: f64,
    ) -> Result<CommanderStats, CommanderError> {
        let c = &self.config;
        // Scaled, not centred: the self-critical baseline already is the centre.
        let square = samples.iter().map(|s| f64::from(s.advantage).powi(2)).sum::<f64>() / samples.len().max(1) as f64;
        let scale = (1.0 / (square.sqrt() + 1e-6)) as f32;
        let mut stats = CommanderStats::default();
        let mut count = 0.0;
        for epoch in 0..c.epochs {
            let mut order: Vec<usize> = (0..samples.len()).collect();
            Key::new(self.seed, Purpose::Shuffle, &[iteration, epoch as u32, 1]).stream().shuffle(&mut order);
            for minibatch in order.chunks(c.minibatch) {
                let (commander, variables) = self.differentiable(network)?;
                let instances: Vec<&Instance> = minibatch.iter().map(|&i| &samples[i].instance).collect();
                let picks: Vec<&[Pick]> = minibatch.iter().map(|&i| &*samples[i].picks).collect();
                let now = commander.pick_log_probs(&instances, &picks)?;
                let rows = now.dim(1)?;
                let old: Vec<f32> = minibatch.iter().flat_map(|&i| samples[i].log_probs.iter().copied()).collect();
                let advantage: Vec<f32> = minibatch
                    .iter()
                    .flat_map(|&i| std::iter::repeat_n(samples[i].advantage * scale, samples[i].picks.len()))
                    .collect();
                let ratio = ops::exp(&ops::minus(&ops::row(&now, 0)?, &column(old)?)?)?;
                let surrogate = clipped_surrogate(&ratio, &column(advantage)?, c.clip)?;
                let mean = |x: Tensor| -> candle_core::Result<Tensor> { x.sum_all()?.affine(1.0 / rows as f64, 0.0) };
                let (surrogate, entropy) = (mean(surrogate)?, mean(ops::row(&now, 1)?)?);
                let loss = (surrogate.neg()? - (&entropy * f64::from(c.entropy))?)?;
                let (surrogate, entropy) = (surrogate.to_scalar::<f32>()?, entropy.to_scalar::<f32>()?);
                // Adam takes no step along a gradient that is not finite.
                let usable = surrogate.is_finite()
                    && entropy.is_finite()
                    && self.descend(network, &variables, &loss, rate_factor)?.is_finite();
                if !usable {
                    stats.skipped += 1.0;
                    continue;
                }
                stats.loss -= f64::from(surrogate);
                stats.entropy += f64::from(entropy);
                count += 1.0;
            }
        }
        stats.loss /= f64::max(count, 1.0);
        stats.entropy /= f64::max(count, 1.0);
        Ok(stats)
    }

    /// The scheduler on variables.
    fn differentiable(&self, network: &Network) -> Result<(Commander, Vec<Var>), CommanderError> {
        let variables = network.params.variables()?;
        let tensors = variables.iter().map(|v| v.as_tensor().clone()).collect();
        let params = &mut ParamBuilder::with(tensors);
        Ok((Commander::build(&self.config, self.agents, self.dims, params)?, variables))
    }

    /// One step of Adam down the gradient of a loss. The gradient's norm.
    fn descend(
        &self,
        network: &mut Network,
        variables: &[Var],
        loss: &Tensor,
        rate_factor: f64,
    ) -> Result<f64, CommanderError> {
        let gradient = network.params.gradient(variables, &loss.backward()?)?;
        let c = &self.config;
        let (rate, max_norm) = (c.learning_rate * rate_factor, c.max_grad_norm.into());
        Ok(network.moments.adam_step(&mut network.params.values, &gradient, rate, 1e-5, max_norm))
    }
}

/// The k-th stage's assignment of an episode, `[N]`, out of the agents' chains of goals; `None` if it is not one-to-one.
pub(crate) fn stage_goals(t: &Trajectory, episode: usize, k: usize) -> Option<Vec<u32>> {
    let (n, stages) = (t.shape.agents, t.shape.goals_per_agent);
    let mut goals = vec![u32::MAX; n];
    for (agent, chain) in t.goals[episode * n * stages..(episode + 1) * n * stages].chunks_exact(stages).enumerate() {
        let from = if k == 0 { agent } else { chain[k - 1] as usize };
        let slot = goals.get_mut(from)?;
        if *slot != u32::MAX {
            return None;
        }
        *slot = chain[k];
    }
    Some(goals)
}

/// C: summed distance of an assignment, in double precision; agents without a goal cost nothing.
pub fn cost(team: &Team<'_>, goals: &[u32]) -> f64 {
    magex_assign::cost_of_points(team.agents, team.goals, team.dims, goals)
}
