//! What a policy does: act in a rollout, and evaluate given actions in the update.

use super::{Input, Network};
use crate::distribution::ActionHeads;
use crate::ops::{action_log_probs, with_values};
use candle_core::{Result, Tensor};

/// Chooses actions: from a random stream, or the most likely one. It keeps what it chose.
pub trait Chooser {
    /// Chooses the action of one row of the batch, `[H]`, given its logits, or action values, `[A]`. Every row is asked for once.
    fn choose(&mut self, row: usize, logits: &[f32]) -> &[u8];
}

/// What a policy thinks of given actions, differentiable in its parameters.
#[derive(Debug)]
pub struct Evaluated {
    /// `[R]` log-probability of each agent's action.
    pub log_probs: Tensor,
    /// `[R]` entropy of each agent's distribution, in nats.
    pub entropies: Tensor,
    /// [L, C·N, H] states of the memory after each step; `None` for networks without memory.
    pub states: Option<Tensor>,
}

/// What acts in a rollout: a policy, or action values. A row may depend on the actions of other rows of its joint state (decoding
/// agent by agent): the logits of a row are shown to the chooser before those of the next one are computed.
pub trait Act: Send + Sync {
    /// Chooses an action for every row of the batch. Returns the states of the memory after each step, [L, C·N, H]; `None`
    /// for networks without memory.
    fn act(&self, input: &Input<'_>, choose: &mut dyn Chooser) -> Result<Option<Tensor>>;
}

/// A policy of all agents. `evaluate` is given all actions and gives the same log-probabilities for them as `act`, to the bit: the
/// first importance ratio is exactly 1.
pub trait Policy: Act {
    /// Evaluates the actions [R, H] of every row of the batch.
    fn evaluate(&self, input: &Input<'_>, actions: &[u8]) -> Result<Evaluated>;
}

/// Agents act independently of each other, given what they see: one network computes the logits of all rows at once.
pub struct Independent {
    pub(super) network: Box<dyn Network>,
    pub(super) heads: ActionHeads,
}

impl Act for Independent {
    fn act(&self, input: &Input<'_>, choose: &mut dyn Chooser) -> Result<Option<Tensor>> {
        let output = self.network.forward(input)?;
        with_values(&output.out, |logits| {
            for (row, logits) in logits.chunks_exact(self.heads.logits()).enumerate() {
                choose.choose(row, logits);
            }
        })?;
        Ok(output.states)
    }
}

impl Policy for Independent {
    fn evaluate(&self, input: &Input<'_>, actions: &[u8]) -> Result<Evaluated> {
        let output = self.network.forward(input)?;
        let both = action_log_probs(&output.out, actions.to_vec(), &self.heads)?;
        Ok(Evaluated { log_probs: both.get(0)?, entropies: both.get(1)?, states: output.states })
    }
}
