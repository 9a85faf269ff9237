//! QMIX (Rashid et al. 2018, "QMIX: Monotonic Value Function Factorisation for Deep Multi-Agent Reinforcement Learning"), from top to
//! bottom: buffer → batches → values → mixing → temporal differences → clipped gradients → RMSprop → target networks.
//!
//! | | implementation detail | source |
//! |---|---|---|
//! | 1 | one network of action values for all agents, with a GRU, unrolled over whole episodes from an empty memory | section 4; pymarl `rnn_agent.py` |
//! | 2 | agents see their own last action and their index | pymarl `obs_last_action`, `obs_agent_id` |
//! | 3 | weights of the mixing network by their magnitude, from the state of the whole team | section 4; pymarl `qmix.py` |
//! | 4 | double Q-learning: live networks choose the next action, target networks value it | pymarl `double_q` |
//! | 5 | the reward of a team is the mean over its agents, whatever the task pays each | ours: the size of Q does not grow with N |
//! | 6 | the horizon is a time limit: the value of the true last state is bootstrapped; `bootstrap_at_horizon = false` makes it an end | pymarl, `terminated` is false there |
//! | 7 | one RMSprop and one limit of the gradient's norm for all networks | pymarl `q_learner.py` |
//! | 8 | targets are copies, renewed every 200 episodes | pymarl `target_update_interval` |
//! | 9 | an iteration's episodes enter the buffer together, then follow its gradient steps | ours (pymarl: in turn) |
//! | 10 | a batch is cut into a fixed number of slices whose gradients are added in their order | ours: the number of threads does not reach a number |
//! | 11 | a batch with a loss or a gradient that is not finite is skipped | ours |
//!
//! MASER adds its intrinsic reward to the reward and its losses to the loss: [`maser`].

mod actions;

use crate::train::batch::{column, plain, sum_of_rows};
use crate::train::learned::{Learned, Moments, Network};
use crate::train::mappo::{part, sum, sum_in_order};
use crate::train::maser::{self, MaserSums, Subgoals};
use crate::train::replay::{Episodes, Replay};
use crate::train::stats::UpdateStats;
use candle_core::{Result as CandleResult, Var};
use magex_core::config::{Algorithm, RunConfig};
use magex_core::joint_state::JointState;
use magex_core::rng::{Key, Purpose};
use magex_core::trajectory::Trajectory;
use magex_nets::executor::{Model, Part, one_hot};
use magex_nets::ops;
use magex_nets::params::{ParamBuilder, ParamError, Params};
use rayon::prelude::*;

type Result<T> = std::result::Result<T, ParamError>;

/// The gradient of each trained network, as flat as its parameters; empty for one that no loss trains.
type Gradients = Vec<Vec<f32>>;

/// The algorithm with its settings.
#[derive(Debug)]
pub struct Qmix {
    config: RunConfig,
    model: Model,
}

impl Qmix {
    /// Checks that the task's actions fit, and fixes the sizes.
    pub fn new(config: &RunConfig) -> Result<Self> {
        Ok(Self { config: config.clone(), model: Model::new(config)? })
    }

    /// An empty replay buffer.
    pub fn replay(&self) -> Replay {
        Replay::new(&self.config)
    }

    /// Initial networks and optimisers: those of [`Model::parts`], then the target networks of the first two.
    pub fn init(&self) -> Result<Vec<Network>> {
        let key = |index: u32| Key::new(self.config.run.seed, Purpose::Init, &[index]);
        let parts = self.model.parts().iter().zip(self.model.layouts()?).zip(0..);
        let init = |((part, layout), index): ((&Part, _), u32)| {
            let params = Params::init(layout, key(index).stream());
            let moments = match self.trains(part) {
                true => Moments::rmsprop(params.values.len()),
                false => Moments::default(),
            };
            Network { name: part.name.to_owned(), params, moments, published: part.policy }
        };
        let mut networks: Vec<Network> = parts.map(init).collect();
        for source in 0..2 {
            let Network { name, params, .. } = &networks[source];
            let (name, params) = (format!("target_{name}"), params.clone());
            networks.push(Network { name, params, moments: Moments::default(), published: false });
        }
        Ok(networks)
    }

    /// Whether a loss trains a network: in the released code of MASER, none trains the distance.
    fn trains(&self, part: &Part) -> bool {
        part.name != "distance" || self.config.maser.trained_distance
    }

    /// Takes an iteration's episodes into the buffer, then does its gradient steps.
    pub fn update(&self, learned: &mut Learned, trajectories: &[Trajectory], iteration: u32) -> Result<UpdateStats> {
        let q = &self.config.qmix;
        let missing = || ParamError::Mismatch("there is no replay buffer".to_owned());
        let replay = learned.replay.as_mut().ok_or_else(missing)?;
        replay.push(iteration, trajectories)?;
        let replay = &*replay;
        let count = self.model.parts().len();
        let networks = &mut learned.networks[..count + 2];
        let steps = self.config.collect.episodes_per_iteration / q.episodes_per_gradient_step;
        let mut total = Totals { grad_norms: vec![0.0; count], ..Totals::default() };
        for step in 0..steps {
            if replay.len() >= q.batch_episodes {
                // 1. A batch of whole episodes, and its gradients, slice by slice.
                let mut stream = Key::new(self.config.run.seed, Purpose::Replay, &[iteration, step]).stream();
                let batch = replay.draw(&mut stream, q.batch_episodes);
                let slices = q.gradient_slices.min(batch.len());
                let slices: Vec<&[usize]> = (0..slices).map(|s| &batch[part(batch.len(), slices, s)]).collect();
                let of = |slice: &&[usize]| self.slice(networks, &replay.gather(slice), batch.len());
                let results = slices.par_iter().map(of).collect::<Result<Vec<_>>>()?;

                // 2. One step of the optimiser, if everything is finite.
                let mut sums = Sums::default();
                results.iter().for_each(|(_, slice)| sums.add(slice));
                let gradients: Gradients =
                    (0..count).map(|k| sum_in_order(results.iter().map(|(gradients, _)| &gradients[k]))).collect();
                self.descend(&mut networks[..count], &gradients, &sums, &mut total);
            }
            // 3. The target networks, as often as the configuration says.
            let episodes = u64::from(iteration) * u64::from(self.config.collect.episodes_per_iteration)
                + u64::from(step + 1) * u64::from(q.episodes_per_gradient_step);
            let (every, each) = (u64::from(q.target_update_every), u64::from(q.episodes_per_gradient_step));
            if episodes / every > (episodes - each) / every {
                for k in 0..2 {
                    networks[count + k].params.values = networks[k].params.values.clone();
                }
            }
        }
        Ok(total.stats(self, replay, iteration))
    }

    /// Clips the gradient by its norm over all networks, and steps; a batch with a number that is not finite is skipped.
    fn descend(&self, networks: &mut [Network], gradients: &Gradients, sums: &Sums, total: &mut Totals) {
        let q = &self.config.qmix;
        let square = |gradient: &Vec<f32>| gradient.iter().map(|&g| f64::from(g) * f64::from(g)).sum::<f64>();
        let squares: Vec<f64> = gradients.iter().map(square).collect();
        let norm = squares.iter().sum::<f64>().sqrt();
        if !(norm.is_finite() && sums.finite()) {
            total.skipped += 1.0;
            return;
        }
        let limit = f64::from(q.max_grad_norm);
        let scale = if norm > limit { limit / (norm + 1e-6) } else { 1.0 } as f32;
        for (network, gradient) in networks.iter_mut().zip(gradients) {
            let settings = (q.rmsprop_alpha, q.rmsprop_epsilon);
            network.moments.rmsprop_step(&mut network.params.values, gradient, scale, q.learning_rate, settings);
        }
        total.steps += 1.0;
        total.sums.add(sums);
        total.grad_norms.iter_mut().zip(&squares).for_each(|(total, square)| *total += square.sqrt());
    }

    /// Gradients and sums of the C episodes of a slice of a batch of `batch` episodes.
    pub(super) fn slice(&self, networks: &[Network], episodes: &Episodes, batch: usize) -> Result<(Gradients, Sums)> {
        let parts = self.model.parts();
        let (trained, targets) = networks.split_at(parts.len());
        let variables = |(network, part): (&Network, &Part)| match self.trains(part) {
            true => network.params.variables(),
            false => Ok(Vec::new()),
        };
        let variables = trained.iter().zip(parts).map(variables).collect::<CandleResult<Vec<Vec<Var>>>>()?;
        let builder = |k: usize| -> CandleResult<ParamBuilder> {
            Ok(ParamBuilder::with(match variables[k].is_empty() {
                true => trained[k].params.tensors()?,
                false => variables[k].iter().map(|v| v.as_tensor().clone()).collect(),
            }))
        };
        let constants =
            |k: usize| -> CandleResult<ParamBuilder> { Ok(ParamBuilder::with(targets[k].params.tensors()?)) };
        let (agent, mixer) = (self.model.q_network(&mut builder(0)?)?, self.model.mixer(&mut builder(1)?)?);
        let target_agent = self.model.q_network(&mut constants(0)?)?;
        let target_mixer = self.model.mixer(&mut constants(1)?)?;

        // 1. Values of all T+1 observations, rows [T+1, C, N].
        let (shape, heads) = (self.model.spec().shape, self.model.heads());
        let (steps, n, a) = (shape.steps, shape.agents, heads.logits());
        let c = episodes.rewards.len() / steps;
        let (joint, rows) = (steps * c, steps * c * n);
        let features = self.model.spec().compute(&JointState {
            positions: &episodes.positions,
            velocities: &episodes.velocities,
            agent_state: &episodes.agent_state,
            world_states: &[],
            masks: &[],
            marks: &[],
            statics: episodes.statics.view(),
            goals: &episodes.goals,
        });
        let values = agent.values(&features.vectors, &episodes.actions, steps + 1)?;
        let target_values = target_agent.values(&features.vectors, &episodes.actions, steps + 1)?;

        // 2. What the target networks expect of the best actions, each agent [T+1, C, N] and the team [T+1, C].
        let (live, target) = (plain(&values)?, plain(&target_values)?);
        let chooser = if self.config.qmix.double_q { &live } else { &target };
        let mut best = vec![0; heads.count()];
        let expected = chooser.chunks_exact(a).zip(target.chunks_exact(a)).map(|(chooser, target)| {
            heads.best(chooser, &mut best);
            heads.value(target, &best)
        });
        let individual: Vec<f32> = expected.collect();
        let width = features.states.len() / (joint + c);
        let team = plain(&target_mixer.forward(&ops::constant(individual.clone(), n)?, &features.states)?)?;

        // 3. What the live networks expected of the actions that were taken.
        let mask = ops::constant(one_hot(&episodes.actions, heads), a)?;
        let taken = sum_of_rows(&(values.narrow(0, 0, rows)? * mask)?)?;
        let total = mixer.forward(&taken.reshape((joint, n))?, &features.states[..joint * width])?;

        // 4. Temporal differences of the team; MASER's reward has an intrinsic part.
        let mut rewards = episodes.rewards.clone();
        let subgoals = match (self.config.run.algorithm, parts.len()) {
            (Algorithm::Maser, 3..) => {
                let distance = self.model.distance(&mut builder(2)?)?;
                let images = distance.forward(&features.vectors[..features.vectors.len() / (steps + 1) * steps])?;
                let subgoals = Subgoals::find(&self.config.maser, (steps, c, n), &individual, &team, images)?;
                subgoals.reward(&self.config.maser, &mut rewards);
                Some(subgoals)
            }
            _ => None,
        };
        let gamma = self.config.qmix.gamma;
        let discount = |row: usize| if row < joint - c || self.config.qmix.bootstrap_at_horizon { gamma } else { 0.0 };
        let next = team[c..].iter().enumerate().map(|(row, next)| discount(row) * next);
        let targets: Vec<f32> = rewards.iter().zip(next).map(|(r, next)| r + next).collect();
        let target_sum = targets.iter().map(|&y| f64::from(y)).sum::<f64>();
        let error = (&total - column(targets)?)?;
        let samples = (batch * steps) as f64;
        let mut loss = (error.sqr()?.sum_all()? * (1.0 / samples))?;
        let mut sums = Sums {
            weight: 1.0 / samples,
            squares: sum(&error.sqr()?)?,
            errors: sum(&error.abs()?)?,
            values: sum(&total)?,
            targets: target_sum,
            ..Sums::default()
        };

        // 5. MASER's own losses.
        if let Some(subgoals) = &subgoals {
            let view =
                maser::Values { taken: &taken, values: &values, target: &target, individual: &individual[c * n..] };
            let (own, maser) = maser::losses(&self.config, heads, subgoals, &view, &rewards, batch)?;
            loss = (loss + (own * f64::from(self.config.maser.loss_factor))?)?;
            sums.maser = maser;
        }
        let store = loss.backward()?;
        let flat = |(network, variables): (&Network, &Vec<Var>)| Ok(network.params.gradient(variables, &store)?);
        Ok((trained.iter().zip(&variables).map(flat).collect::<Result<Gradients>>()?, sums))
    }
}

/// Sums over the joint steps of a batch, or of one of its slices, in order and in double precision.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Sums {
    /// One over the joint steps of the batch.
    weight: f64,
    squares: f64,
    errors: f64,
    values: f64,
    targets: f64,
    maser: MaserSums,
}

impl Sums {
    fn add(&mut self, other: &Self) {
        self.weight = other.weight;
        self.squares += other.squares;
        self.errors += other.errors;
        self.values += other.values;
        self.targets += other.targets;
        self.maser.add(&other.maser);
    }

    fn finite(&self) -> bool {
        self.squares.is_finite() && self.values.is_finite() && self.targets.is_finite() && self.maser.finite()
    }

    /// The loss that was differentiated.
    #[cfg(test)]
    pub(super) fn loss(&self, config: &RunConfig) -> f64 {
        self.squares * self.weight + f64::from(config.maser.loss_factor) * self.maser.total(&config.maser)
    }
}

/// Sums over the gradient steps of an update.
#[derive(Debug, Default)]
struct Totals {
    steps: f64,
    skipped: f64,
    sums: Sums,
    grad_norms: Vec<f64>,
}

impl Totals {
    fn stats(self, qmix: &Qmix, replay: &Replay, iteration: u32) -> UpdateStats {
        let mut stats = UpdateStats::default();
        // Before the buffer holds a batch there is nothing to report.
        if self.steps > 0.0 {
            let each = self.sums.weight / self.steps;
            stats.push("td_loss", self.sums.squares * each);
            stats.push("td_error", self.sums.errors * each);
            stats.push("q_tot_mean", self.sums.values * each);
            stats.push("target_mean", self.sums.targets * each);
            if qmix.config.run.algorithm == Algorithm::Maser {
                self.sums.maser.report(self.steps, &mut stats);
            }
            for (part, norm) in qmix.model.parts().iter().zip(&self.grad_norms).filter(|(part, _)| qmix.trains(part)) {
                stats.push(format!("{}_grad_norm", part.name), norm / self.steps);
            }
        }
        let steps = u64::from(iteration) * qmix.config.steps_per_iteration();
        stats.push("epsilon", qmix.config.qmix.epsilon(steps).into());
        stats.push("buffer_episodes", replay.len() as f64);
        stats.push("gradient_steps", self.steps);
        stats.push("skipped_gradient_steps", self.skipped);
        stats
    }
}

#[cfg(test)]
mod tests;
