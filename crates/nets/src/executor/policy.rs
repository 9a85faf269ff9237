//! What a policy does: act in a rollout, and evaluate given actions in the update.

use super::{Input, Network};
use crate::distribution::ActionHeads;
use crate::ops::{self, Activation, action_log_densities, action_log_probs, with_values};
use candle_core::{Result, Tensor};

/// Chooses actions: from a random stream, or the most likely one. It keeps what it chose.
pub trait Chooser {
    /// Chooses the action of one row of the batch, `[H]`, given its logits, or action values, `[A]`. Every row is asked for once. An
    /// action of real numbers is kept by the chooser; then there is nothing to return.
    fn choose(&mut self, row: usize, logits: &[f32]) -> &[u8];
}

/// Given actions of R rows.
#[derive(Debug, Clone, Copy)]
pub struct Taken<'a> {
    /// [R, H]
    pub choices: &'a [u8],
    /// [R, C]
    pub moves: &'a [f32],
}

impl<'a> Taken<'a> {
    /// Actions that are choices.
    pub fn choices(choices: &'a [u8]) -> Self {
        Self { choices, moves: &[] }
    }
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
    /// Evaluates the actions of every row of the batch.
    fn evaluate(&self, input: &Input<'_>, actions: Taken<'_>) -> Result<Evaluated>;
}

/// Agents act independently of each other, given what they see: one network computes the logits of all rows at once.
pub struct Independent {
    pub(super) network: Box<dyn Network>,
    pub(super) heads: ActionHeads,
    /// [1, C] logarithms of the standard deviations of actions of real numbers, the same in every state.
    pub(super) log_deviations: Option<Tensor>,
}

/// What is taken off the logit of a choice that is forbidden: its probability underflows to 0, and nothing becomes infinite.
const FORBIDDEN: f32 = 1e9;

impl Independent {
    /// The outputs of the network as a distribution: forbidden choices out of reach, standard deviations beside the means.
    fn outputs(&self, input: &Input<'_>, out: Tensor) -> Result<Tensor> {
        let rows = out.dim(0)?;
        if let Some(log_deviations) = &self.log_deviations {
            // A product with ones: its gradient is a sum in an order of ours.
            let width = log_deviations.dim(1)?;
            let (ones, zeros) = (ops::constant(vec![1.0; rows], 1)?, Tensor::zeros(width, out.dtype(), out.device())?);
            let spread = ops::linear(&ones, log_deviations, &zeros, Activation::Identity, true)?;
            return Tensor::cat(&[&out, &spread], 1);
        }
        let masks = &input.features.masks;
        if masks.is_empty() {
            return Ok(out);
        }
        let numbers = |of: fn(u8) -> f32| {
            ops::constant(masks.iter().map(|mask| of(*mask)).collect::<Vec<_>>(), self.heads.logits())
        };
        let (keep, away) = (numbers(f32::from)?, numbers(|mask| if mask == 0 { -FORBIDDEN } else { 0.0 })?);
        (out * keep)? + away
    }
}

impl Act for Independent {
    fn act(&self, input: &Input<'_>, choose: &mut dyn Chooser) -> Result<Option<Tensor>> {
        let output = self.network.forward(input)?;
        with_values(&self.outputs(input, output.out)?, |logits| {
            for (row, logits) in logits.chunks_exact(self.heads.logits()).enumerate() {
                choose.choose(row, logits);
            }
        })?;
        Ok(output.states)
    }
}

impl Policy for Independent {
    fn evaluate(&self, input: &Input<'_>, actions: Taken<'_>) -> Result<Evaluated> {
        let output = self.network.forward(input)?;
        let out = self.outputs(input, output.out)?;
        let both = match self.log_deviations {
            Some(_) => action_log_densities(&out, actions.moves.to_vec())?,
            None => action_log_probs(&out, actions.choices.to_vec(), &self.heads)?,
        };
        Ok(Evaluated { log_probs: ops::row(&both, 0)?, entropies: ops::row(&both, 1)?, states: output.states })
    }
}
