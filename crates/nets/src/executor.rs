//! The action executor (paper, section 4.2). A [`Model`] says which networks a run has and builds its [`Policy`] and value
//! function on them; rollouts call [`Policy::act`], the update calls [`Policy::evaluate`].
//!
//! | kind | team features E_a | goal features | memory |
//! |---|---|---|---|
//! | `magex` | GCN + l_g hard Gumbel-softmax graph blocks, the reading that we recommend | relative | GRU |
//! | `magex-literal` | the paper's formulas to the letter: no self path, absolute positions | absolute | GRU |
//! | `attention` | multi-head attention over all agents (ablation "-Atten") | relative | GRU |
//! | `mlp` | one layer on the concatenated observations (ablation "-MLP"); fixed team size | relative | GRU |
//! | `local` | sum over the k nearest neighbours | relative | none |
//!
//! Where a task has encounters, `magex`, `attention` and `mlp` sum over the k nearest neighbours, too (Encounter Encoder).

mod local;
mod model;
mod policy;
mod team;

use crate::features::{FeatureSpec, Features};
use crate::ops::{Activation, GraphNoise, linear};
use crate::params::{Init, ParamBuilder, ParamError};
use candle_core::{Result as CandleResult, Tensor};
use candle_nn::Module;
use magex_core::config::{ExecutorConfig, ExecutorKind};
use magex_core::task::TaskConfig;

pub use local::LocalNet;
pub use model::{Model, Part};
pub use policy::{Acted, Chooser, Evaluated, Independent, Policy};
pub use team::TeamNet;

/// What a network sees: L steps of C sequences of N agents, rows ordered [L, C, N].
#[derive(Debug)]
pub struct Input<'a> {
    /// L: consecutive joint steps.
    pub steps: usize,
    /// C: episodes side by side.
    pub sequences: usize,
    /// N: agents.
    pub agents: usize,
    /// Features of the L·C·N rows.
    pub features: &'a Features,
    /// [C·N, H] state of the memory that enters the first step; empty for networks without memory.
    pub hidden: Vec<f32>,
    /// Gumbel noise: one key per joint state, L·C of them.
    pub noise: GraphNoise,
}

/// What a network returns.
#[derive(Debug)]
pub struct Output {
    /// [L·C·N, O] action logits or values.
    pub out: Tensor,
    /// [L, C·N, H] states of the memory after each step; `None` for networks without memory.
    pub states: Option<Tensor>,
}

/// A network with O outputs per agent: the logits of a policy whose agents act independently, or a value function (O = 1).
pub trait Network: Send + Sync {
    /// One pass over a batch of sequences.
    fn forward(&self, input: &Input<'_>) -> CandleResult<Output>;
}

/// What features the executor of a run wants. The graph executors see single neighbours where the task has encounters.
pub fn feature_spec(config: &ExecutorConfig, task: &TaskConfig) -> FeatureSpec {
    let local = config.kind == ExecutorKind::Local;
    let literal = config.kind == ExecutorKind::MagexLiteral;
    let neighbours = if local || (task.observation().encounters && !literal) { config.neighbours } else { 0 };
    FeatureSpec::new(task, !literal, neighbours, !local)
}

/// Builds an actor or critic with `outputs` outputs; `head_gain` is the orthogonal gain of the last layer
/// (0.01 for actors, 1 for critics). `agents` matters to `mlp` only.
pub fn build(
    config: &ExecutorConfig,
    spec: &FeatureSpec,
    agents: usize,
    outputs: usize,
    head_gain: f64,
    params: &mut ParamBuilder,
) -> Result<Box<dyn Network>, ParamError> {
    Ok(match config.kind {
        ExecutorKind::Local => Box::new(LocalNet::build(config, spec, outputs, head_gain, params)?),
        _ => Box::new(TeamNet::build(config, spec, agents, outputs, head_gain, params)?),
    })
}

/// A fully connected layer.
pub(crate) struct Layer {
    w: Tensor,
    b: Tensor,
    act: Activation,
    constant_input: bool,
}

impl Layer {
    pub(crate) fn build(
        params: &mut ParamBuilder,
        name: &str,
        (inputs, outputs): (usize, usize),
        act: Activation,
        gain: f64,
    ) -> Result<Self, ParamError> {
        Ok(Self {
            w: params.tensor(&format!("{name}.weight"), &[inputs, outputs], Init::Orthogonal(gain))?,
            b: params.tensor(&format!("{name}.bias"), &[outputs], Init::Constant(0.0))?,
            act,
            constant_input: false,
        })
    }

    /// The same layer for inputs that need no gradient (features).
    pub(crate) fn on_features(self) -> Self {
        Self { constant_input: true, ..self }
    }
}

impl Module for Layer {
    fn forward(&self, x: &Tensor) -> CandleResult<Tensor> {
        linear(x, &self.w, &self.b, self.act, self.constant_input)
    }
}

/// Gain of layers followed by ReLU.
pub(crate) const RELU_GAIN: f64 = std::f64::consts::SQRT_2;
