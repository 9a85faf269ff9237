//! The paper's executor: Subgraph Extractor, Goal Encoder, State Extractor, Action Generator; and its ablations.

use super::memory::Memory;
use super::{Input, Layer, Network, Output, RELU_GAIN};
use crate::features::FeatureSpec;
use crate::ops::{
    Activation, Chain, ChainBuilder, GraphBlock, constant, graph_block, linear, softmax, with_mean_of_others,
};
use crate::params::{Init, ParamBuilder, ParamError};
use candle_core::{DType, Device, Result as CandleResult, Tensor};
use candle_nn::Module;
use magex_core::config::{ExecutorConfig, ExecutorKind};

/// Heads and width of a head of the attention ablation (authors' code: 4 × 16).
const HEADS: usize = 4;
const HEAD_WIDTH: usize = 16;

/// Where an agent's team feature E_a comes from.
enum Team {
    /// Observation Encoder with a fully connected GCN, then hard Gumbel-softmax blocks.
    Graph {
        blocks: Vec<Block>,
        literal: bool,
    },
    Attention {
        qkv: Layer,
        out: Layer,
    },
    Concat {
        mix: Layer,
    },
}

struct Block {
    /// h → [u | v | z | self], in the first block behind the layer that gives h.
    project: Chain,
    /// Pair offsets → P; `None` in the literal reading.
    relative: Option<Tensor>,
    score: Tensor,
    shape: GraphBlock,
}

impl Block {
    fn build(
        config: &ExecutorConfig,
        spec: &FeatureSpec,
        (b, first): (usize, ChainBuilder),
        params: &mut ParamBuilder,
    ) -> Result<Self, ParamError> {
        let (f, p, literal) = (config.feature_size, config.pair_hidden, config.kind == ExecutorKind::MagexLiteral);
        let (project, relative) = (format!("block{b}.project"), format!("block{b}.relative"));
        Ok(Self {
            project: first.dense(&project, 2 * p + 2 * f, Activation::Identity, 1.0).build(params)?,
            relative: if literal {
                None
            } else {
                Some(params.tensor(&relative, &[2 * spec.shape.dims, p], Init::Orthogonal(1.0))?)
            },
            score: params.tensor(&format!("block{b}.score"), &[p + 1], Init::Orthogonal(0.5))?,
            shape: GraphBlock {
                agents: spec.shape.agents,
                pair_hidden: p,
                width: f,
                block: b as u32,
                self_path: !literal,
                temperature: config.temperature,
            },
        })
    }
}

/// Paper, figure 2. F = feature size.
pub(super) struct TeamNet {
    observe: Chain,
    team: Team,
    /// Goal Encoder, State Extractor, memory and head. Where the task has encounters, there is an Encounter Encoder, too:
    /// Σ over neighbours of relu(neighbour → F / 2).
    rest: Memory,
    spec: FeatureSpec,
    width: usize,
    pair_hidden: usize,
}

impl TeamNet {
    /// Builds the kind that the configuration names.
    pub(super) fn build(
        config: &ExecutorConfig,
        spec: &FeatureSpec,
        outputs: usize,
        head_gain: f64,
        params: &mut ParamBuilder,
    ) -> Result<Self, ParamError> {
        let f = config.feature_size;
        let p = config.pair_hidden;
        let relu = Activation::Relu;
        let nodes = (spec.node_width(), f);
        let observe = ChainBuilder::new().features("f_o", |features| &features.nodes, nodes, relu, RELU_GAIN);
        let observe = observe.build(params)?;
        let team = match config.kind {
            ExecutorKind::Attention => {
                let inner = HEADS * HEAD_WIDTH;
                Team::Attention {
                    qkv: Layer::build(params, "attention.qkv", (f, 3 * inner), Activation::Identity, 1.0)?,
                    out: Layer::build(params, "attention.out", (inner, f), Activation::Identity, 1.0)?,
                }
            }
            ExecutorKind::Mlp => {
                Team::Concat { mix: Layer::build(params, "concat", (spec.shape.agents * f, f), relu, RELU_GAIN)? }
            }
            _ => {
                let literal = config.kind == ExecutorKind::MagexLiteral;
                let inputs = if literal { f } else { 2 * f };
                let first = |b: usize| match b {
                    0 => ChainBuilder::new().input(inputs).dense("gcn", f, relu, RELU_GAIN),
                    _ => ChainBuilder::new().input(f),
                };
                let blocks = (0..config.graph_blocks).map(|b| Block::build(config, spec, (b, first(b)), params));
                let blocks = blocks.collect::<Result<_, _>>()?;
                Team::Graph { blocks, literal }
            }
        };
        let goals = (spec.goal_width(), f);
        let mut fused =
            ChainBuilder::new().features("f_goal", |features| &features.goals, goals, relu, RELU_GAIN).input(f);
        if spec.neighbours > 0 {
            fused = fused.neighbours("f_near", spec.neighbours, (spec.neighbour_width(), f / 2), RELU_GAIN);
        }
        if config.feature_norm {
            fused = fused.norm("f_state.norm");
        }
        Ok(Self {
            observe,
            team,
            rest: Memory::build(fused.dense("f_state", f, relu, RELU_GAIN), f, (outputs, head_gain), params)?,
            spec: *spec,
            width: f,
            pair_hidden: p,
        })
    }

    /// E_a [R, F].
    fn team_features(&self, input: &Input<'_>) -> CandleResult<Tensor> {
        let features = input.features;
        let n = input.agents;
        let x = self.observe.forward(None, features)?;
        match &self.team {
            Team::Graph { blocks, literal } => {
                let mut h = with_mean_of_others(&x, n)?;
                if *literal {
                    // Mean over all agents, the agent itself included: every node gets the same feature.
                    let share = 1.0 / n as f64;
                    h = ((&x * share)? + (h.narrow(1, self.width, self.width)? * (1.0 - share))?)?;
                }
                let pairs = constant(features.pairs.as_slice(), 2 * self.spec.shape.dims)?;
                let zeros = Tensor::zeros(self.pair_hidden, DType::F32, &Device::Cpu)?;
                for block in blocks {
                    let projected = block.project.forward(Some(&h), features)?;
                    let relative = match &block.relative {
                        Some(w) => linear(&pairs, w, &zeros, Activation::Identity, true)?,
                        None => Tensor::zeros((pairs.dim(0)?, self.pair_hidden), DType::F32, &Device::Cpu)?,
                    };
                    h = graph_block(&projected, &relative, &block.score, block.shape.clone(), input.noise.clone())?;
                }
                Ok(h)
            }
            Team::Attention { qkv, out } => {
                let states = x.dim(0)? / n;
                let inner = HEADS * HEAD_WIDTH;
                let qkv = qkv.forward(&x)?.reshape((states, n, 3, HEADS, HEAD_WIDTH))?;
                let part = |i: usize| -> CandleResult<Tensor> {
                    qkv.narrow(2, i, 1)?.squeeze(2)?.transpose(1, 2)?.contiguous()
                };
                let (q, k, v) = (part(0)?, part(1)?, part(2)?);
                let scale = 1.0 / (HEAD_WIDTH as f64).sqrt();
                let weights = (q.matmul(&k.transpose(2, 3)?.contiguous()?)? * scale)?;
                let mixed = softmax(&weights)?.matmul(&v)?;
                out.forward(&mixed.transpose(1, 2)?.contiguous()?.reshape((states * n, inner))?)
            }
            Team::Concat { mix } => {
                let states = x.dim(0)? / n;
                let team = mix.forward(&x.reshape((states, n * self.width))?)?;
                let copies = team.unsqueeze(1)?.broadcast_as((states, n, self.width))?.contiguous()?;
                copies.reshape((states * n, self.width))
            }
        }
    }
}

impl Network for TeamNet {
    fn forward(&self, input: &Input<'_>) -> CandleResult<Output> {
        self.rest.forward(Some(&self.team_features(input)?), input)
    }
}
