//! The `local` executor: an agent, its goal and its k nearest neighbours. No graph, no memory.

use super::{Input, Layer, Network, Output, RELU_GAIN};
use crate::features::FeatureSpec;
use crate::ops::{Activation, constant, neighbour_pool};
use crate::params::{Init, ParamBuilder, ParamError};
use candle_core::{Device, Result as CandleResult, Tensor};
use candle_nn::Module;
use magex_core::config::ExecutorConfig;
use std::sync::Arc;

/// own → h; Σ over neighbours of relu(neighbour → h/2); `[both]` → h → outputs.
pub struct LocalNet {
    own: Layer,
    neighbour: (Tensor, Tensor),
    mix: Layer,
    head: Layer,
    goal_width: usize,
    neighbours: usize,
    neighbour_width: usize,
}

impl LocalNet {
    /// Builds with `config.hidden` units and `config.neighbours` neighbours.
    pub fn build(
        config: &ExecutorConfig,
        spec: &FeatureSpec,
        outputs: usize,
        head_gain: f64,
        params: &mut ParamBuilder,
    ) -> Result<Self, ParamError> {
        let (h, half) = (config.hidden, config.hidden / 2);
        let width = spec.neighbour_width();
        Ok(Self {
            own: Layer::build(params, "own", (spec.goal_width(), h), Activation::Relu, RELU_GAIN)?.on_features(),
            neighbour: (
                params.tensor("neighbour.weight", &[width, half], Init::Orthogonal(RELU_GAIN))?,
                params.tensor("neighbour.bias", &[half], Init::Constant(0.0))?,
            ),
            mix: Layer::build(params, "mix", (h + half, h), Activation::Relu, RELU_GAIN)?,
            head: Layer::build(params, "head", (h, outputs), Activation::Identity, head_gain)?,
            goal_width: spec.goal_width(),
            neighbours: spec.neighbours,
            neighbour_width: width,
        })
    }
}

impl Network for LocalNet {
    fn forward(&self, input: &Input<'_>) -> CandleResult<Output> {
        let f = input.features;
        let own = self.own.forward(&constant(f.goals.as_slice(), self.goal_width)?)?;
        let shape = (f.counts.len(), self.neighbours, self.neighbour_width);
        let neighbours = Tensor::from_slice(&f.neighbours, shape, &Device::Cpu)?;
        let (w, b) = &self.neighbour;
        let team = neighbour_pool(&neighbours, Arc::new(f.counts.clone()), w, b)?;
        let mixed = self.mix.forward(&Tensor::cat(&[&own, &team], 1)?)?;
        Ok(Output { out: self.head.forward(&mixed)?, states: None })
    }
}
