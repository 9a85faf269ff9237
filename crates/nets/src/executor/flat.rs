//! The networks of MAPPO and IPPO (Yu et al. 2022): two hidden layers, or one and a memory, on the flat observation vector.

use super::memory::Memory;
use super::{Input, Network, Output, TANH_GAIN};
use crate::features::{FeatureSpec, Features};
use crate::ops::{Activation, Chain, ChainBuilder};
use crate::params::{ParamBuilder, ParamError};
use candle_core::Result as CandleResult;
use magex_core::config::ExecutorConfig;

/// vector → h (tanh) → h (tanh) or memory → outputs.
pub(super) enum FlatNet {
    Layers(Chain),
    Memory(Memory),
}

impl FlatNet {
    /// Builds with `config.hidden` units. A `centralised` network reads the agent's observation vector and the state of the team:
    /// W [vector; state] = W₁ vector + W₂ state, where the second term is the same for all agents of a joint state.
    pub(super) fn build(
        config: &ExecutorConfig,
        spec: &FeatureSpec,
        (outputs, head_gain): (usize, f64),
        centralised: bool,
        params: &mut ParamBuilder,
    ) -> Result<Self, ParamError> {
        let (h, vector, state) = (config.hidden, spec.vector_width(), spec.state_width());
        let (tanh, identity) = (Activation::Tanh, Activation::Identity);
        let first = if centralised {
            ChainBuilder::new().features_and_team(
                ("own", "team"),
                (vectors, states),
                ((vector, state), h),
                tanh,
                TANH_GAIN,
            )
        } else {
            ChainBuilder::new().features("own", vectors, (vector, h), tanh, TANH_GAIN)
        };
        Ok(if config.recurrent {
            Self::Memory(Memory::build(first, h, (outputs, head_gain), params)?)
        } else {
            let layers = first.dense("second", h, tanh, TANH_GAIN).dense("head", outputs, identity, head_gain);
            Self::Layers(layers.build(params)?)
        })
    }
}

fn vectors(features: &Features) -> &[f32] {
    &features.vectors
}

fn states(features: &Features) -> &[f32] {
    &features.states
}

impl Network for FlatNet {
    fn forward(&self, input: &Input<'_>) -> CandleResult<Output> {
        match self {
            Self::Layers(chain) => Ok(Output { out: chain.forward(None, input.features)?, states: None }),
            Self::Memory(memory) => memory.forward(None, input),
        }
    }
}
