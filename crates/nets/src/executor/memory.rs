//! The memory of an executor: a gated recurrent unit with layer normalisation behind it.

use super::{Input, Layer};
use crate::ops::{Activation, gru, layer_norm};
use crate::params::{Init, ParamBuilder, ParamError};
use candle_core::{Result as CandleResult, Tensor};
use candle_nn::Module;

pub(super) struct Norm {
    pub(super) scale: Tensor,
    pub(super) shift: Tensor,
}

impl Norm {
    pub(super) fn build(params: &mut ParamBuilder, name: &str, width: usize) -> Result<Self, ParamError> {
        Ok(Self {
            scale: params.tensor(&format!("{name}.scale"), &[width], Init::Constant(1.0))?,
            shift: params.tensor(&format!("{name}.shift"), &[width], Init::Constant(0.0))?,
        })
    }
}

impl Module for Norm {
    fn forward(&self, x: &Tensor) -> CandleResult<Tensor> {
        layer_norm(x, &self.scale, &self.shift)
    }
}

/// GRU of H units, H a multiple of 16.
pub(super) struct Memory {
    gates: Layer,
    weight: Tensor,
    bias: Tensor,
    norm: Norm,
    width: usize,
}

impl Memory {
    pub(super) fn build(params: &mut ParamBuilder, width: usize) -> Result<Self, ParamError> {
        Ok(Self {
            gates: Layer::build(params, "gru.input", (width, 3 * width), Activation::Identity, 1.0)?,
            weight: params.tensor("gru.weight", &[width, 3 * width], Init::Orthogonal(1.0))?,
            bias: params.tensor("gru.bias", &[3 * width], Init::Constant(0.0))?,
            norm: Norm::build(params, "gru.norm", width)?,
            width,
        })
    }

    /// From x [L·C·N, H] to normalised features [L·C·N, H] and the states [L, C·N, H] after each step.
    pub(super) fn forward(&self, x: &Tensor, input: &Input<'_>) -> CandleResult<(Tensor, Tensor)> {
        let sequences = input.sequences * input.agents;
        let gates = self.gates.forward(x)?.reshape((input.steps, sequences, 3 * self.width))?;
        let states = gru(&gates, &self.weight, &self.bias, input.hidden.clone())?;
        let flat = states.reshape((input.steps * sequences, self.width))?;
        Ok((self.norm.forward(&flat)?, states))
    }
}
