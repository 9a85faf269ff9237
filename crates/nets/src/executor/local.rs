//! The `local` executor: an agent, its goal and its k nearest neighbours. No graph, no memory.

use super::{Input, Layer, NeighbourEncoder, Network, Output, RELU_GAIN};
use crate::features::FeatureSpec;
use crate::ops::{Activation, constant};
use crate::params::{ParamBuilder, ParamError};
use candle_core::{Result as CandleResult, Tensor};
use candle_nn::Module;
use magex_core::config::ExecutorConfig;

/// own → h; Σ over neighbours of relu(neighbour → h/2); `[both]` → h → outputs.
pub(super) struct LocalNet {
    own: Layer,
    neighbours: NeighbourEncoder,
    mix: Layer,
    head: Layer,
    goal_width: usize,
}

impl LocalNet {
    /// Builds with `config.hidden` units and `config.neighbours` neighbours.
    pub(super) fn build(
        config: &ExecutorConfig,
        spec: &FeatureSpec,
        outputs: usize,
        head_gain: f64,
        params: &mut ParamBuilder,
    ) -> Result<Self, ParamError> {
        let (h, half) = (config.hidden, config.hidden / 2);
        Ok(Self {
            own: Layer::build(params, "own", (spec.goal_width(), h), Activation::Relu, RELU_GAIN)?.on_features(),
            neighbours: NeighbourEncoder::build(params, "neighbour", spec, half)?,
            mix: Layer::build(params, "mix", (h + half, h), Activation::Relu, RELU_GAIN)?,
            head: Layer::build(params, "head", (h, outputs), Activation::Identity, head_gain)?,
            goal_width: spec.goal_width(),
        })
    }
}

impl Network for LocalNet {
    fn forward(&self, input: &Input<'_>) -> CandleResult<Output> {
        let own = self.own.forward(&constant(input.features.goals.as_slice(), self.goal_width)?)?;
        let team = self.neighbours.forward(input.features)?;
        let mixed = self.mix.forward(&Tensor::cat(&[&own, &team], 1)?)?;
        Ok(Output { out: self.head.forward(&mixed)?, states: None })
    }
}
