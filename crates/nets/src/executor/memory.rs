//! The memory of an executor: a gated recurrent unit with layer normalisation behind it.

use super::{Input, Output};
use crate::ops::{Activation, Before, Chain, ChainBuilder, Gru, layer_norm, recurrent};
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

/// A network from what enters its memory to its outputs: layers, GRU of H units (a multiple of 16), layer normalisation, head.
pub(super) struct Memory {
    /// What the gates see [R, H].
    first: Chain,
    gru: Gru,
    head: Chain,
    width: usize,
}

impl Memory {
    /// `first` gives what the gates see.
    pub(super) fn build(
        first: ChainBuilder,
        width: usize,
        (outputs, head_gain): (usize, f64),
        params: &mut ParamBuilder,
    ) -> Result<Self, ParamError> {
        let (identity, zero) = (Activation::Identity, Init::Constant(0.0));
        let inputs = first.width();
        let inits = [Init::Orthogonal(1.0), zero, Init::Orthogonal(1.0), zero];
        Ok(Self {
            first: first.build(params)?,
            gru: Gru::build("gru", (inputs, width), inits, params)?,
            head: ChainBuilder::new()
                .input(width)
                .norm("gru.norm")
                .dense("head", outputs, identity, head_gain)
                .build(params)?,
            width,
        })
    }

    /// `x` is the input of the first layers, if they have one.
    pub(super) fn forward(&self, x: Option<&Tensor>, input: &Input<'_>) -> CandleResult<Output> {
        let sequences = input.sequences * input.agents;
        let rows = x.map(|x| self.first.forward(Some(x), input.features)).transpose()?;
        let before = rows.as_ref().map_or(Before::Layers(&self.first), Before::Rows);
        // The state of a world's agents ends with its episode.
        let firsts = input.features.firsts.iter().flat_map(|first| std::iter::repeat_n(*first, input.agents)).collect();
        let parts = (before, &self.gru, &self.head);
        let (out, states) = recurrent(parts, input.features, input.hidden.clone(), firsts)?;
        Ok(Output { out, states: Some(states.reshape((input.steps, sequences, self.width))?) })
    }
}
