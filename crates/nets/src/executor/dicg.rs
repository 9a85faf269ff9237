//! DICG (Li et al. 2021, "Deep Implicit Coordination Graphs for Multi-Agent Reinforcement Learning"), centralised execution: agents
//! weigh each other by attention, exchange features along that graph twice, and act.

use super::{Input, Layer, Network, Output, TANH_GAIN};
use crate::features::FeatureSpec;
use crate::ops::{Activation, Attention, attention, constant, linear, tanh};
use crate::params::{Init, ParamBuilder, ParamError};
use candle_core::{DType, Device, Result as CandleResult, Tensor};
use candle_nn::Module;
use magex_core::config::ExecutorConfig;

/// e⁰ = tanh MLP(vector); M = softmax((E⁰ W_a) E⁰ᵀ), not scaled; E^{l+1} = tanh(M E^l W_l + b_l), l = 0, 1; e⁰ + e² → head.
pub(super) struct DicgNet {
    encoder: [Layer; 2],
    /// W_a
    score: Tensor,
    graph: Vec<(Tensor, Tensor)>,
    head: [Layer; 4],
    vector_width: usize,
    agents: usize,
    hidden: usize,
}

/// Layers of graph convolution.
const LAYERS: usize = 2;

impl DicgNet {
    /// Builds with `config.hidden` features per agent.
    pub(super) fn build(
        config: &ExecutorConfig,
        spec: &FeatureSpec,
        (outputs, head_gain): (usize, f64),
        params: &mut ParamBuilder,
    ) -> Result<Self, ParamError> {
        let (h, width, t) = (config.hidden, spec.vector_width(), Activation::Tanh);
        let mut layer = |name: &str, sizes, act, gain| Layer::build(params, name, sizes, act, gain);
        let encoder = [
            layer("encoder.0", (width, 2 * h), t, TANH_GAIN)?.on_features(),
            layer("encoder.1", (2 * h, h), t, TANH_GAIN)?,
        ];
        let head = [
            layer("head.0", (h, 2 * h), t, TANH_GAIN)?,
            layer("head.1", (2 * h, h), t, TANH_GAIN)?,
            layer("head.2", (h, h / 2), t, TANH_GAIN)?,
            layer("head.3", (h / 2, outputs), Activation::Identity, head_gain)?,
        ];
        let score = params.tensor("attention.weight", &[h, h], Init::Orthogonal(1.0))?;
        let convolution = |l: usize| -> Result<(Tensor, Tensor), ParamError> {
            let weight = params.tensor(&format!("graph.{l}.weight"), &[h, h], Init::Orthogonal(1.0))?;
            let bias = params.tensor(&format!("graph.{l}.bias"), &[h], Init::Constant(0.0))?;
            // The authors' code keeps these layers in a list that the optimiser does not see.
            Ok(if config.frozen_graph { (weight.detach(), bias.detach()) } else { (weight, bias) })
        };
        let graph = (0..LAYERS).map(convolution).collect::<Result<_, _>>()?;
        Ok(Self { encoder, score, graph, head, vector_width: width, agents: spec.shape.agents, hidden: h })
    }
}

impl Network for DicgNet {
    fn forward(&self, input: &Input<'_>) -> CandleResult<Output> {
        let [wide, narrow] = &self.encoder;
        let e0 = narrow.forward(&wide.forward(&constant(input.features.vectors.as_slice(), self.vector_width)?)?)?;
        let zeros = Tensor::zeros(self.hidden, DType::F32, &Device::Cpu)?;
        let projected = |x: &Tensor, w: &Tensor| linear(x, w, &zeros, Activation::Identity, false);
        let queries = projected(&e0, &self.score)?;
        let shape = Attention { agents: self.agents, heads: 1, causal: false, scale: 1.0 };
        let mut e = e0.clone();
        for (weight, bias) in &self.graph {
            // M (E W): the same M for both layers, computed anew because it is cheaper than keeping it.
            e = tanh(&attention(&queries, &e0, &projected(&e, weight)?, shape)?.broadcast_add(bias)?)?;
        }
        let out = self.head.iter().try_fold((e0 + e)?, |x, layer| layer.forward(&x))?;
        Ok(Output { out, states: None })
    }
}
