//! The action executor (paper, section 4.2). A [`Model`] says which networks a run has and builds its [`Policy`] and value
//! function on them; rollouts call [`Act::act`], the update calls [`Policy::evaluate`]. QMIX has a [`QNetwork`] and a [`Mixer`] instead.
//!
//! | kind | team features E_a | goal features | memory |
//! |---|---|---|---|
//! | `magex` | GCN + l_g hard Gumbel-softmax graph blocks, the reading that we recommend | relative | GRU |
//! | `magex-literal` | the paper's formulas to the letter: no self path, absolute positions | absolute | GRU |
//! | `attention` | multi-head attention over all agents (ablation "-Atten") | relative | GRU |
//! | `mlp` | one layer on the concatenated observations (ablation "-MLP"); fixed team size | relative | GRU |
//! | `local` | sum over the k nearest neighbours | relative | none |
//!
//! The baselines see the flat observation vector instead of these features:
//!
//! | kind | policy | critic | memory |
//! |---|---|---|---|
//! | `flat` | MAPPO, IPPO: two hidden layers of the agent's own vector | the same, on vector and state of the team or vector alone | none or GRU |
//! | `mat` | MAT: transformer, actions decoded agent by agent | on the same encoder | none |
//! | `mat-dec` | MAT-Dec: the encoder, all agents at once | on the same encoder | none |
//! | `dicg` | DICG: attention graph, two graph convolutions | that of `flat` | none |
//!
//! Where a task has encounters, `magex`, `attention` and `mlp` sum over the k nearest neighbours, too (Encounter Encoder).

mod dicg;
mod flat;
mod local;
mod mat;
mod memory;
mod mixer;
mod model;
mod policy;
mod q_network;
mod team;

use crate::features::{FeatureSpec, Features, FlatSpec};
use crate::ops::{Activation, GraphNoise, linear};
use crate::params::{Init, ParamBuilder, ParamError};
use candle_core::{Result as CandleResult, Tensor};
use candle_nn::Module;
use dicg::DicgNet;
use flat::FlatNet;
use local::LocalNet;
use magex_core::config::{ExecutorConfig, ExecutorKind};
use magex_core::task::TaskConfig;
use std::sync::Arc;
use team::TeamNet;

pub use mixer::{Distance, Mixer};
pub use model::{Model, Part};
pub use policy::{Act, Chooser, Evaluated, Independent, Policy, Taken};
pub use q_network::{QNetwork, one_hot};

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
    pub features: &'a Arc<Features>,
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
    if config.kind.flat() {
        let states = config.centralised_critic && matches!(config.kind, ExecutorKind::Flat | ExecutorKind::Dicg);
        let ExecutorConfig { observes, nearest_first, agent_index, .. } = *config;
        let flat = Some(FlatSpec { observes, nearest_first, agent_index, states });
        // In the world's axes, as the baselines' authors have it.
        return FeatureSpec { flat, ..FeatureSpec::new(task, false, 0, false) };
    }
    let local = config.kind == ExecutorKind::Local;
    let literal = config.kind == ExecutorKind::MagexLiteral;
    let neighbours = if local || (task.observation().encounters && !literal) { config.neighbours } else { 0 };
    FeatureSpec::new(task, !literal, neighbours, !local)
}

/// An actor or a critic with `outputs` outputs; `head_gain` is the orthogonal gain of the last layer (0.01 for actors, 1 for
/// critics). Critics of baselines may be `centralised`.
pub fn build(
    config: &ExecutorConfig,
    spec: &FeatureSpec,
    (outputs, head_gain): (usize, f64),
    critic: bool,
    params: &mut ParamBuilder,
) -> Result<Box<dyn Network>, ParamError> {
    use ExecutorKind::{Attention, Dicg, Flat, Local, Magex, MagexLiteral, Mat, MatDec, Mlp};
    let head = (outputs, head_gain);
    Ok(match config.kind {
        Local => Box::new(LocalNet::build(config, spec, outputs, head_gain, params)?),
        Magex | MagexLiteral | Attention | Mlp => Box::new(TeamNet::build(config, spec, outputs, head_gain, params)?),
        Dicg if !critic => Box::new(DicgNet::build(config, spec, head, params)?),
        Flat | Dicg => Box::new(FlatNet::build(config, spec, head, critic && config.centralised_critic, params)?),
        // Its policy and its value function are one network.
        Mat | MatDec => return Err(ParamError::Mismatch("MAT is built as a whole".to_owned())),
    })
}

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

    /// A layer whose weights and biases are uniform within ± 1/√inputs at the start, as PyTorch draws them.
    pub(crate) fn uniform(
        params: &mut ParamBuilder,
        name: &str,
        (inputs, outputs): (usize, usize),
        act: Activation,
    ) -> Result<Self, ParamError> {
        let init = Init::Uniform(1.0 / (inputs as f64).sqrt());
        Ok(Self {
            w: params.tensor(&format!("{name}.weight"), &[inputs, outputs], init)?,
            b: params.tensor(&format!("{name}.bias"), &[outputs], init)?,
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

/// Gain of layers followed by tanh.
pub(crate) const TANH_GAIN: f64 = 5.0 / 3.0;
/// Gain of layers followed by ReLU.
pub(crate) const RELU_GAIN: f64 = std::f64::consts::SQRT_2;
