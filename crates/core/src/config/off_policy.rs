//! Algorithms beside MAPPO: QMIX, and MASER, which is QMIX with subgoals out of the replay buffer.

use super::{ExecutorConfig, ExecutorKind, MappoConfig, RunConfig};
use crate::error::FieldError;
use crate::section::section;
use serde::{Deserialize, Serialize};

/// What the learner does with the episodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Algorithm {
    /// MAPPO: an actor and a critic, trained on the iteration's own episodes.
    Mappo,
    /// QMIX: action values that a monotone network mixes, trained on episodes out of a replay buffer.
    Qmix,
    /// MASER: QMIX, and subgoals out of the replay buffer.
    Maser,
}

impl Algorithm {
    /// Its name in configurations.
    pub fn name(self) -> &'static str {
        match self {
            Self::Mappo => "mappo",
            Self::Qmix => "qmix",
            Self::Maser => "maser",
        }
    }

    /// Whether it trains on episodes out of a replay buffer, whatever weights collected them.
    pub fn off_policy(self) -> bool {
        self != Self::Mappo
    }
}

impl std::fmt::Display for Algorithm {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

section! {
    /// `[qmix]`
    QmixConfig {
        /// γ.
        gamma: f32 = 0.99, 0.0..=1.0;
        /// Episodes that the replay buffer holds, the newest.
        buffer_episodes: usize = 5000, 1..=100_000_000;
        /// Whole episodes per gradient step.
        batch_episodes: usize = 32, 1..=100_000;
        /// Collected episodes per gradient step; must divide `collect.episodes_per_iteration`.
        episodes_per_gradient_step: u32 = 1, 1..=100_000;
        /// Episodes between copies of the trained networks into the target networks.
        target_update_every: u32 = 200, 1..=1_000_000_000;
        /// RMSprop's step size.
        learning_rate: f64 = 5e-4, 0.0..=1.0;
        /// α of RMSprop: how much of the mean square of the gradient a step keeps.
        rmsprop_alpha: f64 = 0.99, 0.0..=1.0;
        /// RMSprop's ε.
        rmsprop_epsilon: f64 = 1e-5, 1e-12..=1.0;
        /// Limit of the norm of the gradient of all networks together.
        max_grad_norm: f32 = 10.0, 1e-6..=1e9;
        /// Share of random actions at the start.
        epsilon_start: f32 = 1.0, 0.0..=1.0;
        /// Share of random actions from `epsilon_steps` on, and in sampled evaluation.
        epsilon_end: f32 = 0.05, 0.0..=1.0;
        /// Joint environment steps over which the share falls linearly.
        epsilon_steps: u64 = 50_000, 1..=1_000_000_000_000;
        /// Whether the trained networks choose the next action that the target networks value (double Q-learning).
        double_q: bool = true;
        /// Bootstrap the value of the true last state: the horizon is a time limit, not an end.
        bootstrap_at_horizon: bool = true;
        /// Whether agents see their own last action.
        last_action: bool = true;
        /// Units of the mixing network.
        mixer_hidden: usize = 32, 1..=1024;
        /// Parts of a batch whose gradients are summed in a fixed order; computed by as many threads as there are.
        gradient_slices: usize = 4, 1..=64;
    }
}

impl QmixConfig {
    /// ε after a number of joint environment steps.
    pub fn epsilon(&self, steps: u64) -> f32 {
        let share = (steps as f64 / self.epsilon_steps as f64).min(1.0);
        let (start, end) = (f64::from(self.epsilon_start), f64::from(self.epsilon_end));
        (start + (end - start) * share) as f32
    }
}

section! {
    /// `[maser]`
    MaserConfig {
        /// α: weight of the agent's own value against the team's in the choice of a subgoal.
        alpha: f32 = 0.5, 0.0..=1.0;
        /// λ: weight of the intrinsic reward.
        lambda: f32 = 0.03, 0.0..=1000.0;
        /// Factor of all losses but the temporal difference of the team.
        loss_factor: f32 = 0.001, 0.0..=1000.0;
        /// Weight of the temporal difference of each agent.
        individual_coef: f32 = 1.0, 0.0..=1000.0;
        /// Weight of the next two together.
        mixed_coef: f32 = 1.0, 0.0..=1000.0;
        /// Weight of the loss that evens action values out behind the subgoal.
        exploration_coef: f32 = 1.0, 0.0..=1000.0;
        /// Weight of the loss of the distance network.
        distance_coef: f32 = 1.0, 0.0..=1000.0;
        /// Units of the distance network.
        distance_hidden: usize = 128, 1..=4096;
        /// Whether the distance network is trained; not in the released code, where two losses then change no weight.
        trained_distance: bool = true;
    }
}

impl RunConfig {
    /// Checks what depends on the algorithm: an option that does nothing would look as if it did something.
    pub(super) fn check_algorithm(&self) -> Result<(), FieldError> {
        let algorithm = self.run.algorithm;
        let foreign = match algorithm {
            Algorithm::Mappo => QmixConfig::default().changed(&self.qmix).map(|key| ("qmix", key)),
            _ => MappoConfig::default().changed(&self.mappo).map(|key| ("mappo", key)),
        };
        let maser = MaserConfig::default().changed(&self.maser).filter(|_| algorithm != Algorithm::Maser);
        if let Some((section, key)) = foreign.or(maser.map(|key| ("maser", key))) {
            let owners = if section == "qmix" { "qmix and maser" } else { section };
            let problem = format!("belongs to the algorithm {owners}; run.algorithm is {algorithm}; remove it");
            return Err(FieldError::new(format!("{section}.{key}"), problem));
        }
        if algorithm.off_policy() { self.check_off_policy() } else { Ok(()) }
    }

    fn check_off_policy(&self) -> Result<(), FieldError> {
        let (algorithm, qmix) = (self.run.algorithm, &self.qmix);
        let kind = self.executor.kind;
        if kind != ExecutorKind::Flat {
            let problem = format!("{kind} is not an executor of {algorithm}; use \"flat\"");
            return Err(FieldError::new("executor.kind", problem));
        }
        if self.executor.centralised_critic != ExecutorConfig::default().centralised_critic {
            let problem = format!("belongs to the algorithm mappo; {algorithm} has no critic; remove it");
            return Err(FieldError::new("executor.centralised_critic", problem));
        }
        if qmix.batch_episodes > qmix.buffer_episodes {
            let problem =
                format!("{} is more than qmix.buffer_episodes = {}", qmix.batch_episodes, qmix.buffer_episodes);
            return Err(FieldError::new("qmix.batch_episodes", problem));
        }
        let (each, episodes) = (qmix.episodes_per_gradient_step, self.collect.episodes_per_iteration);
        if !episodes.is_multiple_of(each) {
            let problem = format!("{each} must divide collect.episodes_per_iteration = {episodes}");
            return Err(FieldError::new("qmix.episodes_per_gradient_step", problem));
        }
        Ok(())
    }
}
