//! What the learner of QMIX has beside the action values: the mixing network, and MASER's distance between observations. Actors need
//! neither.

use super::Layer;
use crate::distribution::ActionHeads;
use crate::features::FeatureSpec;
use crate::ops::{Activation, constant, elu, mix};
use crate::params::{ParamBuilder, ParamError};
use candle_core::{Result as CandleResult, Tensor};
use candle_nn::Module;
use magex_core::config::RunConfig;

/// Q_tot = ELU(q |W₁(s)| + b₁(s)) |W₂(s)| + V(s): the value of the team's action, which grows with every agent's value, so that what
/// is best for each agent is best for the team. Another network computes the weights from the state s of the whole team.
pub struct Mixer {
    /// s → N·E
    first: Layer,
    /// s → E
    first_bias: Layer,
    /// s → E
    second: Layer,
    /// s → E (ReLU) → 1
    value: [Layer; 2],
    state_width: usize,
}

impl Mixer {
    pub(super) fn build(config: &RunConfig, spec: &FeatureSpec, params: &mut ParamBuilder) -> Result<Self, ParamError> {
        let (s, units, identity) = (spec.state_width(), config.qmix.mixer_hidden, Activation::Identity);
        let mut layer = |name, sizes, act| Layer::uniform(params, name, sizes, act);
        Ok(Self {
            first: layer("first", (s, spec.shape.agents * units), identity)?.on_features(),
            first_bias: layer("first_bias", (s, units), identity)?.on_features(),
            second: layer("second", (s, units), identity)?.on_features(),
            value: [
                layer("value.hidden", (s, units), Activation::Relu)?.on_features(),
                layer("value.out", (units, 1), identity)?,
            ],
            state_width: s,
        })
    }

    /// Q_tot `[S]` of the agents' values [S, N] in the states [S, W].
    pub fn forward(&self, values: &Tensor, states: &[f32]) -> CandleResult<Tensor> {
        let states = constant(states, self.state_width)?;
        let hidden = elu(&mix(values, &self.first.forward(&states)?.abs()?, &self.first_bias.forward(&states)?)?)?;
        let own = self.value[1].forward(&self.value[0].forward(&states)?)?;
        mix(&hidden, &self.second.forward(&states)?.abs()?, &own)?.flatten_all()
    }
}

/// φ of MASER: observation vector → h (ReLU) → A. The distance of two observations is that of their images.
pub struct Distance {
    layers: [Layer; 2],
    width: usize,
}

impl Distance {
    pub(super) fn build(
        config: &RunConfig,
        spec: &FeatureSpec,
        heads: &ActionHeads,
        params: &mut ParamBuilder,
    ) -> Result<Self, ParamError> {
        let (width, units) = (spec.vector_width(), config.maser.distance_hidden);
        let hidden = Layer::uniform(params, "hidden", (width, units), Activation::Relu)?.on_features();
        let out = Layer::uniform(params, "out", (units, heads.logits()), Activation::Identity)?;
        Ok(Self { layers: [hidden, out], width })
    }

    /// Images [R, A] of observation vectors [R, V].
    pub fn forward(&self, vectors: &[f32]) -> CandleResult<Tensor> {
        self.layers[1].forward(&self.layers[0].forward(&constant(vectors, self.width)?)?)
    }
}
