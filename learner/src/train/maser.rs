//! What MASER (Jeon et al. 2022, "MASER: Multi-Agent Reinforcement Learning with Subgoals Generated from Experience Replay Buffer") adds
//! to QMIX: each agent's subgoal, an observation of the same episode; an intrinsic reward for being close to it; and three losses.
//!
//! | | implementation detail | source |
//! |---|---|---|
//! | 1 | the subgoal is the observation of the step t* with the largest α Q_i + (1 − α) Q_tot / N of the target networks | equation 3; `maser_q_learner.py` |
//! | 2 | intrinsic reward −‖φ(o_i) − φ(subgoal)‖₂, its mean over the agents times λ on top of the team's reward | equation 5 |
//! | 3 | each agent's own temporal difference, on its share of the team's reward: softmax of the agents' target values | equation 7 |
//! | 4 | the distance is to be one minus the cosine of the target values of both observations | equation 6 |
//! | 5 | from t* on, action values are to be even: divergence of their softmax from the uniform distribution | `maser_q_learner.py` |
//! | 6 | losses 4 and 5 train the distance and the live values, with targets as constants | ours: the released code passes its optimiser no weight that they reach |
//! | 7 | the intrinsic reward is a constant: no gradient flows through it | ours |
//!
//! `maser.trained_distance = false` is the released code: the distance keeps its random initial weights, and losses 4 and 5 are
//! reported but train nothing.

use crate::train::batch::{column, plain};
use crate::train::mappo::sum;
use crate::train::stats::UpdateStats;
use candle_core::{Result, Tensor};
use magex_core::config::{MaserConfig, RunConfig};
use magex_nets::distribution::ActionHeads;
use magex_nets::ops;

/// Subgoals of the agents of some episodes, and how far every step is from them.
pub(super) struct Subgoals {
    /// T, C, N.
    sizes: (usize, usize, usize),
    /// t* [C, N].
    pub(super) steps: Vec<usize>,
    /// ‖φ(o) − φ(subgoal)‖ [T·C·N].
    distances: Tensor,
    /// The same as plain numbers.
    pub(super) plain: Vec<f32>,
}

/// What networks expect in the same episodes.
pub(super) struct Values<'a> {
    /// Live values of the actions that were taken `[T·C·N]`.
    pub(super) taken: &'a Tensor,
    /// Live values of all choices [(T+1)·C·N, A].
    pub(super) values: &'a Tensor,
    /// Target values of all choices [(T+1)·C·N, A].
    pub(super) target: &'a [f32],
    /// Target values of the best actions of the next step [T, C, N].
    pub(super) individual: &'a [f32],
}

/// t* [C, N]: the first step with the largest α Q_i + (1 − α) Q_tot / N, from target values of the best actions of each agent
/// [T.., C, N] and of the team [T.., C].
pub(super) fn choose(alpha: f32, (steps, c, n): (usize, usize, usize), individual: &[f32], team: &[f32]) -> Vec<usize> {
    let score = |step: usize, row: usize| {
        let of_team = team[step * c + row / n] / n as f32;
        alpha * individual[step * c * n + row] + (1.0 - alpha) * of_team
    };
    let best =
        |row: usize| (1..steps).fold(0, |best, step| if score(step, row) > score(best, row) { step } else { best });
    (0..c * n).map(best).collect()
}

impl Subgoals {
    /// From target values [T+1, C, N] and [T+1, C], and the images φ(o) [T·C·N, A].
    pub(super) fn find(
        config: &MaserConfig,
        sizes: (usize, usize, usize),
        individual: &[f32],
        team: &[f32],
        images: Tensor,
    ) -> Result<Self> {
        let (steps, c, n) = sizes;
        let chosen = choose(config.alpha, sizes, individual, team);
        let others = (0..steps * c * n).map(|row| chosen[row % (c * n)] * c * n + row % (c * n)).collect();
        let distances = ops::row_distances(&images, others)?;
        let plain = plain(&distances)?;
        Ok(Self { sizes, steps: chosen, distances, plain })
    }

    /// Adds λ times the mean intrinsic reward of the agents to the rewards [T, C].
    pub(super) fn reward(&self, config: &MaserConfig, rewards: &mut [f32]) {
        let n = self.sizes.2;
        for (reward, distances) in rewards.iter_mut().zip(self.plain.chunks_exact(n)) {
            let mean = distances.iter().sum::<f32>() / n as f32;
            *reward -= config.lambda * mean;
        }
    }
}

/// Each agent's share of the team's reward: softmax of the values of its agents.
pub(super) fn shares(values: &[f32]) -> Vec<f32> {
    let max = values.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let weights: Vec<f32> = values.iter().map(|&value| libm::expf(value - max)).collect();
    let total: f32 = weights.iter().sum();
    weights.into_iter().map(|weight| weight / total).collect()
}

/// Cosine of the angle between two vectors; 0 if one of them has no length.
pub(super) fn cosine(a: &[f32], b: &[f32]) -> f32 {
    let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>();
    let lengths = (dot(a, a) * dot(b, b)).sqrt();
    if lengths > 0.0 { dot(a, b) / lengths } else { 0.0 }
}

/// c_ind L_ind + c_mix (c_expl L_expl + c_dist L_dist) of a slice of a batch of `batch` episodes; `rewards` [T, C] are those of the
/// team with the intrinsic part.
pub(super) fn losses(
    config: &RunConfig,
    heads: &ActionHeads,
    subgoals: &Subgoals,
    values: &Values<'_>,
    rewards: &[f32],
    batch: usize,
) -> Result<(Tensor, MaserSums)> {
    let (m, q) = (&config.maser, &config.qmix);
    let (steps, c, n) = subgoals.sizes;
    let (a, rows) = (heads.logits(), steps * c * n);

    // L_ind: mean over the steps of the sum over the agents.
    let mut targets = Vec::with_capacity(rows);
    for (joint, next) in values.individual.chunks_exact(n).enumerate() {
        for (agent, share) in shares(next).into_iter().enumerate() {
            let intrinsic = -m.lambda * subgoals.plain[joint * n + agent];
            let gamma = if joint < (steps - 1) * c || q.bootstrap_at_horizon { q.gamma } else { 0.0 };
            targets.push(share * rewards[joint] + intrinsic + gamma * next[agent]);
        }
    }
    let individual = (values.taken - column(targets)?)?.sqr()?;

    // L_dist: mean over steps and agents.
    let row = |row: usize| &values.target[row * a..(row + 1) * a];
    let goal = |r: usize| row(subgoals.steps[r % (c * n)] * c * n + r % (c * n));
    let dissimilar: Vec<f32> = (0..rows).map(|r| 1.0 - cosine(row(r), goal(r))).collect();
    let distance = (&subgoals.distances - column(dissimilar)?)?.sqr()?;

    // L_expl: mean over the steps from t* on, then over the agents, of ln A − entropy, which is the divergence.
    let weights: Vec<f32> = (0..rows)
        .map(|r| {
            let (step, first) = (r / (c * n), subgoals.steps[r % (c * n)]);
            if step < first { 0.0 } else { 1.0 / (steps - first) as f32 }
        })
        .collect();
    let of = match m.trained_distance {
        true => values.values.narrow(0, 0, rows)?,
        false => ops::constant(&values.target[..rows * a], a)?,
    };
    // The actions do not matter: only the entropies are read.
    let entropies = ops::action_log_probs(&of, vec![0; rows * heads.count()], heads)?.get(1)?;
    let even = libm::log(heads.joint() as f64);
    let exploration = ((entropies.neg()? + even)? * column(weights)?)?;

    let (per_step, per_agent) = (1.0 / (batch * steps) as f64, 1.0 / (batch * n) as f64);
    let per_sample = per_step / n as f64;
    let sums = MaserSums {
        individual: sum(&individual)? * per_step,
        exploration: sum(&exploration)? * per_agent,
        distance: sum(&distance)? * per_sample,
        intrinsic: -subgoals.plain.iter().map(|&d| f64::from(d)).sum::<f64>() * per_sample,
    };
    let mixed = f64::from(m.mixed_coef);
    let weighted = |loss: &Tensor, weight: f64| loss.sum_all()? * weight;
    let own = weighted(&individual, per_step * f64::from(m.individual_coef))?;
    let exploration = weighted(&exploration, per_agent * mixed * f64::from(m.exploration_coef))?;
    let distance = weighted(&distance, per_sample * mixed * f64::from(m.distance_coef))?;
    Ok((((own + exploration)? + distance)?, sums))
}

/// Losses of a batch, or of one of its slices, which add up.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct MaserSums {
    individual: f64,
    exploration: f64,
    distance: f64,
    intrinsic: f64,
}

impl MaserSums {
    pub(super) fn add(&mut self, other: &Self) {
        self.individual += other.individual;
        self.exploration += other.exploration;
        self.distance += other.distance;
        self.intrinsic += other.intrinsic;
    }

    pub(super) fn finite(&self) -> bool {
        self.individual.is_finite() && self.exploration.is_finite() && self.distance.is_finite()
    }

    /// The weighted sum, without the factor of all.
    #[cfg(test)]
    pub(super) fn total(&self, m: &MaserConfig) -> f64 {
        let mixed = f64::from(m.exploration_coef) * self.exploration + f64::from(m.distance_coef) * self.distance;
        f64::from(m.individual_coef) * self.individual + f64::from(m.mixed_coef) * mixed
    }

    /// Means over the gradient steps of an update.
    pub(super) fn report(&self, steps: f64, stats: &mut UpdateStats) {
        stats.push("individual_loss", self.individual / steps);
        stats.push("exploration_loss", self.exploration / steps);
        stats.push("distance_loss", self.distance / steps);
        stats.push("intrinsic_reward", self.intrinsic / steps);
    }
}

#[cfg(test)]
mod tests;
