//! The networks of MAPPO and IPPO (Yu et al. 2022): two hidden layers, or one and a memory, on the flat observation vector.

use super::memory::Memory;
use super::{Input, Layer, Network, Output, TANH_GAIN};
use crate::features::FeatureSpec;
use crate::ops::{Activation, constant, linear, tanh};
use crate::params::{Init, ParamBuilder, ParamError};
use candle_core::{DType, Device, Result as CandleResult, Tensor};
use candle_nn::Module;
use magex_core::config::ExecutorConfig;

/// vector → h (tanh) → h (tanh) or memory → outputs.
pub(super) struct FlatNet {
    own: Tensor,
    /// What a centralised critic adds to the first layer: the state of the team → h, once per joint state.
    team: Option<Tensor>,
    bias: Tensor,
    second: Second,
    head: Layer,
    widths: (usize, usize),
    hidden: usize,
}

enum Second {
    Layer(Layer),
    Memory(Memory),
}

impl FlatNet {
    /// Builds with `config.hidden` units. A `centralised` network reads the agent's observation vector and the state of the team.
    pub(super) fn build(
        config: &ExecutorConfig,
        spec: &FeatureSpec,
        (outputs, head_gain): (usize, f64),
        centralised: bool,
        params: &mut ParamBuilder,
    ) -> Result<Self, ParamError> {
        let (h, widths) = (config.hidden, (spec.vector_width(), spec.state_width()));
        let orthogonal = Init::Orthogonal(TANH_GAIN);
        Ok(Self {
            own: params.tensor("own.weight", &[widths.0, h], orthogonal)?,
            team: if centralised { Some(params.tensor("team.weight", &[widths.1, h], orthogonal)?) } else { None },
            bias: params.tensor("own.bias", &[h], Init::Constant(0.0))?,
            second: if config.recurrent {
                Second::Memory(Memory::build(params, h)?)
            } else {
                Second::Layer(Layer::build(params, "second", (h, h), Activation::Tanh, TANH_GAIN)?)
            },
            head: Layer::build(params, "head", (h, outputs), Activation::Identity, head_gain)?,
            widths,
            hidden: h,
        })
    }

    /// The first layer [R, H].
    fn first(&self, input: &Input<'_>) -> CandleResult<Tensor> {
        let vectors = constant(input.features.vectors.as_slice(), self.widths.0)?;
        let Some(team) = &self.team else {
            return linear(&vectors, &self.own, &self.bias, Activation::Tanh, true);
        };
        // W [vector; state] = W₁ vector + W₂ state: the second term is the same for all agents of a joint state.
        let (own, h) = (linear(&vectors, &self.own, &self.bias, Activation::Identity, true)?, self.hidden);
        let zeros = Tensor::zeros(h, DType::F32, &Device::Cpu)?;
        let states = constant(input.features.states.as_slice(), self.widths.1)?;
        let team = linear(&states, team, &zeros, Activation::Identity, true)?.reshape(((), 1, h))?;
        let sum = own.reshape(((), input.agents, h))?.broadcast_add(&team)?;
        tanh(&sum.reshape(((), h))?)
    }
}

impl Network for FlatNet {
    fn forward(&self, input: &Input<'_>) -> CandleResult<Output> {
        let first = self.first(input)?;
        let (features, states) = match &self.second {
            Second::Layer(layer) => (layer.forward(&first)?, None),
            Second::Memory(memory) => {
                let (features, states) = memory.forward(&first, input)?;
                (features, Some(states))
            }
        };
        Ok(Output { out: self.head.forward(&features)?, states })
    }
}
