//! The `local` executor: an agent, its goal and its k nearest neighbours. No graph, no memory.

use super::{Input, Network, Output, RELU_GAIN};
use crate::features::FeatureSpec;
use crate::ops::{Activation, Chain, ChainBuilder};
use crate::params::{ParamBuilder, ParamError};
use candle_core::Result as CandleResult;
use magex_core::config::ExecutorConfig;

/// own → h; Σ over neighbours of relu(neighbour → h/2); `[both]` → h → outputs.
pub(super) struct LocalNet {
    chain: Chain,
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
        let (h, relu) = (config.hidden, Activation::Relu);
        let chain = ChainBuilder::new()
            .features("own", |features| &features.goals, (spec.goal_width(), h), relu, RELU_GAIN)
            .neighbours("neighbour", spec.neighbours, (spec.neighbour_width(), h / 2), RELU_GAIN)
            .dense("mix", h, relu, RELU_GAIN)
            .dense("head", outputs, Activation::Identity, head_gain);
        Ok(Self { chain: chain.build(params)? })
    }
}

impl Network for LocalNet {
    fn forward(&self, input: &Input<'_>) -> CandleResult<Output> {
        Ok(Output { out: self.chain.forward(None, input.features)?, states: None })
    }
}
