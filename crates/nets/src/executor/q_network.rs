//! The action values of QMIX (Rashid et al. 2018): what an agent expects of its actions, given what it has seen and done itself.
//!
//! An action of several components (drones) has a value for every choice of every component, and the value of the action is their
//! sum (branching; Tavakoli et al. 2018): the best action is the best choice of each component, and three components of three choices
//! have 9 outputs, not 27.

use super::{Act, Chooser, Input, Layer};
use crate::distribution::ActionHeads;
use crate::features::FeatureSpec;
use crate::ops::{Activation, Gru, constant, with_values};
use crate::params::{Init, ParamBuilder, ParamError};
use candle_core::{Device, Result as CandleResult, Tensor};
use candle_nn::Module;
use magex_core::config::RunConfig;

/// observation vector and last action → h (ReLU) → memory or h (ReLU) → values of all choices.
pub struct QNetwork {
    first: Layer,
    second: Second,
    head: Layer,
    heads: ActionHeads,
    vector_width: usize,
    hidden: usize,
    last_action: bool,
}

enum Second {
    Layer(Layer),
    Memory(Gru),
}

/// Choices [.., H] as ones in rows of zeros [.., A].
pub fn one_hot(actions: &[u8], heads: &ActionHeads) -> Vec<f32> {
    let mut out = vec![0.0; actions.len() / heads.count() * heads.logits()];
    for (row, action) in out.chunks_exact_mut(heads.logits()).zip(actions.chunks_exact(heads.count())) {
        heads.mark(action, row);
    }
    out
}

impl QNetwork {
    pub(super) fn build(
        config: &RunConfig,
        spec: &FeatureSpec,
        heads: &ActionHeads,
        params: &mut ParamBuilder,
    ) -> Result<Self, ParamError> {
        let (h, vector_width, last_action) = (config.executor.hidden, spec.vector_width(), config.qmix.last_action);
        let inputs = vector_width + if last_action { heads.logits() } else { 0 };
        let bound = Init::Uniform(1.0 / (h as f64).sqrt());
        Ok(Self {
            first: Layer::uniform(params, "first", (inputs, h), Activation::Relu)?.on_features(),
            second: if config.executor.recurrent {
                Second::Memory(Gru::build("gru", (h, h), [bound; 4], params)?)
            } else {
                Second::Layer(Layer::uniform(params, "second", (h, h), Activation::Relu)?)
            },
            head: Layer::uniform(params, "head", (h, heads.logits()), Activation::Identity)?,
            heads: heads.clone(),
            vector_width,
            hidden: h,
            last_action,
        })
    }

    /// Values [L·R, A] of all choices in L consecutive steps of R agents, from an empty memory: `vectors` [L·R, V] are what they
    /// observe, `actions` [L−1, R, H] what they did in all steps but the last.
    pub fn values(&self, vectors: &[f32], actions: &[u8], steps: usize) -> CandleResult<Tensor> {
        let rows = vectors.len() / self.vector_width / steps.max(1);
        let mut last = vec![0.0; rows * self.heads.logits()];
        last.extend(one_hot(actions, &self.heads));
        Ok(self.forward(vectors, &last, steps, vec![0.0; rows * self.hidden])?.0)
    }

    /// From `vectors` [L·R, V], last actions [L·R, A] and the memory [R·H] that enters the first step to values [L·R, A] and the states
    /// of the memory [L, R, H].
    fn forward(
        &self,
        vectors: &[f32],
        last: &[f32],
        steps: usize,
        memory: Vec<f32>,
    ) -> CandleResult<(Tensor, Option<Tensor>)> {
        let (width, choices) = (self.vector_width, self.heads.logits());
        let inputs = if self.last_action {
            let rows = vectors.chunks_exact(width).zip(last.chunks_exact(choices));
            let joined: Vec<f32> = rows.flat_map(|(vector, last)| vector.iter().chain(last)).copied().collect();
            constant(joined, width + choices)?
        } else {
            constant(vectors, width)?
        };
        let first = self.first.forward(&inputs)?;
        let (features, states) = match &self.second {
            Second::Layer(layer) => (layer.forward(&first)?, None),
            Second::Memory(gru) => {
                let rows = vectors.len() / width / steps;
                let states = gru.forward(&first, memory, Vec::new())?;
                let steps = states.detach().reshape((steps, rows, self.hidden))?;
                (states, Some(steps))
            }
        };
        Ok((self.head.forward(&features)?, states))
    }

    /// Width of the memory proper, without the last action.
    fn recurrent(&self) -> usize {
        if matches!(self.second, Second::Memory(..)) { self.hidden } else { 0 }
    }
}

impl Act for QNetwork {
    /// What is carried from step to step is the memory and, behind it, the last action: [L, C·N, H + A].
    fn act(&self, input: &Input<'_>, choose: &mut dyn Chooser) -> CandleResult<Option<Tensor>> {
        let (h, choices) = (self.recurrent(), self.heads.logits());
        let width = h + if self.last_action { choices } else { 0 };
        let (mut memory, mut last) = (Vec::new(), Vec::new());
        if width > 0 {
            for row in input.hidden.chunks_exact(width) {
                memory.extend_from_slice(&row[..h]);
                last.extend_from_slice(&row[h..]);
            }
        }
        let (values, states) = self.forward(&input.features.vectors, &last, input.steps, memory)?;
        let mut actions = Vec::new();
        with_values(&values, |values| {
            for (row, values) in values.chunks_exact(choices).enumerate() {
                actions.extend_from_slice(choose.choose(row, values));
            }
        })?;
        if !self.last_action {
            return Ok(states);
        }
        let chosen = one_hot(&actions, &self.heads);
        let states = states.map(|states| states.flatten_all()?.to_vec1::<f32>()).transpose()?.unwrap_or_default();
        let mut carried = Vec::with_capacity(chosen.len() / choices * width);
        for (row, chosen) in chosen.chunks_exact(choices).enumerate() {
            carried.extend_from_slice(&states[row * h..(row + 1) * h]);
            carried.extend_from_slice(chosen);
        }
        let rows = chosen.len() / choices / input.steps;
        Ok(Some(Tensor::from_vec(carried, (input.steps, rows, width), &Device::Cpu)?))
    }
}
