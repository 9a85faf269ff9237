//! MAT (Wen et al. 2022, "Multi-Agent Reinforcement Learning is a Sequence Modeling Problem"): an encoder over all agents'
//! observations, and a decoder that decides agent by agent, each knowing what the agents before it do. MAT-Dec replaces the decoder
//! by one MLP for all agents.
//!
//! The update evaluates all agents in one pass with their actions as inputs; a rollout decodes them in order and keeps keys and values
//! ([`cache`]): O(N) work per agent instead of a pass over all of them. Both give the same bits.

mod cache;

use super::memory::Norm;
use super::{Act, Chooser, Evaluated, Input, Layer, Network, Output, Policy, RELU_GAIN, Taken};
use crate::distribution::ActionHeads;
use crate::features::FeatureSpec;
use crate::ops::{Activation, Attention, action_log_probs, attention, constant, gelu, linear, row, with_values};
use crate::params::{Init, ParamBuilder, ParamError};
use cache::Cache;
use candle_core::{DType, Device, Result as CandleResult, Tensor};
use candle_nn::Module;
use magex_core::config::{ExecutorConfig, ExecutorKind};

/// Gain of layers that no activation follows.
const GAIN: f64 = 0.01;

/// Observation vectors → features of the agents, which see each other.
struct Encoder {
    vector_norm: Norm,
    embed: Layer,
    norm: Norm,
    blocks: Vec<EncoderBlock>,
    vector_width: usize,
}

struct EncoderBlock {
    attention: SelfAttention,
    norms: [Norm; 2],
    mlp: Mlp,
}

/// Queries, keys, values and what is made of the result, [d → d] each.
struct SelfAttention {
    query: Layer,
    key: Layer,
    value: Layer,
    out: Layer,
    shape: Attention,
}

/// d → d (GELU) → d.
struct Mlp {
    wide: Layer,
    narrow: Layer,
}

/// d → d (GELU, layer norm) → outputs.
struct Head {
    wide: Layer,
    norm: Norm,
    out: Layer,
}

struct DecoderBlock {
    /// Among the actions of the agents before.
    own: SelfAttention,
    /// The encoder's features ask the actions.
    cross: SelfAttention,
    norms: [Norm; 3],
    mlp: Mlp,
}

/// Actions of the agents before → logits.
struct Decoder {
    /// [1 + A, d], no bias; row 0 is the token that starts.
    embed: Tensor,
    norm: Norm,
    blocks: Vec<DecoderBlock>,
}

/// Policy and value function: one network, two ways through it.
pub(super) struct Mat {
    encoder: Encoder,
    value: Head,
    /// `None` for MAT-Dec.
    decoder: Option<Decoder>,
    logits: Head,
    heads: ActionHeads,
    width: usize,
}

impl SelfAttention {
    fn build(params: &mut ParamBuilder, name: &str, d: usize, shape: Attention) -> Result<Self, ParamError> {
        let mut layer =
            |part: &str| Layer::build(params, &format!("{name}.{part}"), (d, d), Activation::Identity, GAIN);
        Ok(Self { query: layer("query")?, key: layer("key")?, value: layer("value")?, out: layer("out")?, shape })
    }

    fn forward(&self, asking: &Tensor, asked: &Tensor) -> CandleResult<Tensor> {
        let (query, key, value) = (self.query.forward(asking)?, self.key.forward(asked)?, self.value.forward(asked)?);
        self.out.forward(&attention(&query, &key, &value, self.shape)?)
    }
}

impl Mlp {
    fn build(params: &mut ParamBuilder, name: &str, d: usize) -> Result<Self, ParamError> {
        let identity = Activation::Identity;
        Ok(Self {
            wide: Layer::build(params, &format!("{name}.wide"), (d, d), identity, RELU_GAIN)?,
            narrow: Layer::build(params, &format!("{name}.narrow"), (d, d), identity, GAIN)?,
        })
    }

    fn forward(&self, x: &Tensor) -> CandleResult<Tensor> {
        self.narrow.forward(&gelu(&self.wide.forward(x)?)?)
    }
}

impl Head {
    fn build(
        params: &mut ParamBuilder,
        name: &str,
        (d, outputs): (usize, usize),
        gain: f64,
    ) -> Result<Self, ParamError> {
        Ok(Self {
            wide: Layer::build(params, &format!("{name}.wide"), (d, d), Activation::Identity, RELU_GAIN)?,
            norm: Norm::build(params, &format!("{name}.norm"), d)?,
            out: Layer::build(params, &format!("{name}.out"), (d, outputs), Activation::Identity, gain)?,
        })
    }

    fn forward(&self, x: &Tensor) -> CandleResult<Tensor> {
        self.out.forward(&self.norm.forward(&gelu(&self.wide.forward(x)?)?)?)
    }
}

impl Encoder {
    fn build(
        params: &mut ParamBuilder,
        spec: &FeatureSpec,
        (d, blocks): (usize, usize),
        shape: Attention,
    ) -> Result<Self, ParamError> {
        let width = spec.vector_width();
        Ok(Self {
            vector_norm: Norm::build(params, "encoder.vector_norm", width)?,
            embed: Layer::build(params, "encoder.embed", (width, d), Activation::Identity, RELU_GAIN)?,
            norm: Norm::build(params, "encoder.norm", d)?,
            blocks: (0..blocks)
                .map(|b| {
                    let name = |part: &str| format!("encoder.{b}.{part}");
                    Ok(EncoderBlock {
                        attention: SelfAttention::build(params, &name("attention"), d, shape)?,
                        norms: [Norm::build(params, &name("norm.0"), d)?, Norm::build(params, &name("norm.1"), d)?],
                        mlp: Mlp::build(params, &name("mlp"), d)?,
                    })
                })
                .collect::<Result<_, ParamError>>()?,
            vector_width: width,
        })
    }

    /// [R, d]
    fn forward(&self, input: &Input<'_>) -> CandleResult<Tensor> {
        let vectors = constant(input.features.vectors.as_slice(), self.vector_width)?;
        let mut x = self.norm.forward(&gelu(&self.embed.forward(&self.vector_norm.forward(&vectors)?)?)?)?;
        for block in &self.blocks {
            x = block.norms[0].forward(&(&x + block.attention.forward(&x, &x)?)?)?;
            x = block.norms[1].forward(&(&x + block.mlp.forward(&x)?)?)?;
        }
        Ok(x)
    }
}

impl Decoder {
    fn build(
        params: &mut ParamBuilder,
        choices: usize,
        (d, blocks): (usize, usize),
        shape: Attention,
    ) -> Result<Self, ParamError> {
        Ok(Self {
            embed: params.tensor("decoder.embed.weight", &[1 + choices, d], Init::Orthogonal(RELU_GAIN))?,
            norm: Norm::build(params, "decoder.norm", d)?,
            blocks: (0..blocks)
                .map(|b| {
                    let name = |part: &str| format!("decoder.{b}.{part}");
                    Ok(DecoderBlock {
                        own: SelfAttention::build(params, &name("own"), d, shape)?,
                        cross: SelfAttention::build(params, &name("cross"), d, shape)?,
                        norms: [
                            Norm::build(params, &name("norm.0"), d)?,
                            Norm::build(params, &name("norm.1"), d)?,
                            Norm::build(params, &name("norm.2"), d)?,
                        ],
                        mlp: Mlp::build(params, &name("mlp"), d)?,
                    })
                })
                .collect::<Result<_, ParamError>>()?,
        })
    }

    /// Tokens [R, 1 + A] → [R, d].
    fn embed(&self, tokens: &Tensor) -> CandleResult<Tensor> {
        let zeros = Tensor::zeros(self.embed.dim(1)?, DType::F32, &Device::Cpu)?;
        self.norm.forward(&gelu(&linear(tokens, &self.embed, &zeros, Activation::Identity, true)?)?)
    }

    /// Features [R, d] of all agents, given the encoder's and the tokens of all agents.
    fn forward(&self, encoded: &Tensor, tokens: &Tensor) -> CandleResult<Tensor> {
        let mut x = self.embed(tokens)?;
        for block in &self.blocks {
            x = block.norms[0].forward(&(&x + block.own.forward(&x, &x)?)?)?;
            // The residual is the encoder's feature, as in the authors' code.
            x = block.norms[1].forward(&(encoded + block.cross.forward(encoded, &x)?)?)?;
            x = block.norms[2].forward(&(&x + block.mlp.forward(&x)?)?)?;
        }
        Ok(x)
    }
}

impl Mat {
    /// Builds with `config.hidden` features per agent.
    pub(super) fn build(
        config: &ExecutorConfig,
        spec: &FeatureSpec,
        heads: &ActionHeads,
        params: &mut ParamBuilder,
    ) -> Result<Self, ParamError> {
        let (d, parts) = (config.hidden, config.attention_heads);
        let scale = 1.0 / ((d / parts) as f32).sqrt();
        let all = Attention { agents: spec.shape.agents, heads: parts, causal: false, scale };
        let sizes = (d, config.attention_blocks);
        let encoder = Encoder::build(params, spec, sizes, all)?;
        let value = Head::build(params, "value", (d, 1), GAIN)?;
        let decoder = match config.kind {
            ExecutorKind::MatDec => None,
            _ => Some(Decoder::build(params, heads.logits(), sizes, Attention { causal: true, ..all })?),
        };
        let logits = Head::build(params, "logits", (d, heads.logits()), GAIN)?;
        Ok(Self { encoder, value, decoder, logits, heads: heads.clone(), width: d })
    }

    /// The inputs of the decoder [R, 1 + A]: each agent's is the action of the agent before it, the first one's a token of its own.
    fn tokens(&self, actions: &[u8], agents: usize) -> CandleResult<Tensor> {
        let (width, components) = (1 + self.heads.logits(), self.heads.count());
        let mut tokens = vec![0.0; actions.len() / components * width];
        for (row, token) in tokens.chunks_exact_mut(width).enumerate() {
            match row % agents {
                0 => token[0] = 1.0,
                _ => self.heads.mark(&actions[(row - 1) * components..row * components], &mut token[1..]),
            }
        }
        constant(tokens, width)
    }
}

impl Act for Mat {
    fn act(&self, input: &Input<'_>, choose: &mut dyn Chooser) -> CandleResult<Option<Tensor>> {
        let encoded = self.encoder.forward(input)?;
        match &self.decoder {
            None => with_values(&self.logits.forward(&encoded)?, |logits| {
                for (row, logits) in logits.chunks_exact(self.heads.logits()).enumerate() {
                    choose.choose(row, logits);
                }
            })?,
            Some(decoder) => Cache::new(self, decoder)?.decode(&encoded, input.agents, choose)?,
        }
        Ok(None)
    }
}

impl Policy for Mat {
    fn evaluate(&self, input: &Input<'_>, Taken { choices: actions, .. }: Taken<'_>) -> CandleResult<Evaluated> {
        let encoded = self.encoder.forward(input)?;
        let features = match &self.decoder {
            None => encoded,
            Some(decoder) => decoder.forward(&encoded, &self.tokens(actions, input.agents)?)?,
        };
        let both = action_log_probs(&self.logits.forward(&features)?, actions.to_vec(), &self.heads)?;
        Ok(Evaluated { log_probs: row(&both, 0)?, entropies: row(&both, 1)?, states: None })
    }
}

impl Network for Mat {
    fn forward(&self, input: &Input<'_>) -> CandleResult<Output> {
        Ok(Output { out: self.value.forward(&self.encoder.forward(input)?)?, states: None })
    }
}

#[cfg(test)]
mod tests;
