//! The executor of a run: MAGE-X and its ablations, or a baseline.

use crate::error::FieldError;
use crate::section::section;
use serde::{Deserialize, Serialize};

/// Architecture of the executor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ExecutorKind {
    /// MAGE-X, the reading that we recommend.
    Magex,
    /// MAGE-X, the paper's formulas to the letter.
    MagexLiteral,
    /// Ablation -Atten.
    Attention,
    /// Ablation -MLP.
    Mlp,
    /// k nearest neighbours, no graph, no memory.
    Local,
    /// Baselines MAPPO and IPPO: an MLP or a GRU on the agent's own flat observation vector.
    Flat,
    /// Baseline MAT: a transformer that decodes the actions agent by agent.
    Mat,
    /// Baseline MAT-Dec: the same encoder, and all agents act at once.
    MatDec,
    /// Baseline DICG: an attention graph and two layers of graph convolution.
    Dicg,
}

impl std::fmt::Display for ExecutorKind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.serialize(f)
    }
}

impl ExecutorKind {
    /// Whether the weights serve one team size only.
    pub fn fixed_team_size(self) -> bool {
        self == Self::Mlp || self.flat()
    }

    /// Whether it sees the flat observation vector, as the baselines do.
    pub fn flat(self) -> bool {
        matches!(self, Self::Flat | Self::Mat | Self::MatDec | Self::Dicg)
    }
}

/// What the flat observation vector says about where to go.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Observes {
    /// All landmarks (and balls), and no goal: the classical observation.
    Landmarks,
    /// The agent's own goals, as the commander assigned them.
    Goals,
}

section! {
    /// `[executor]`
    ExecutorConfig {
        /// Architecture.
        kind: ExecutorKind = ExecutorKind::Magex;
        /// F: feature size of the graph executors.
        feature_size: usize = 32, 16..=512;
        /// l_g: blocks of the Graph Encoder.
        graph_blocks: usize = 2, 1..=8;
        /// Hidden units of the pair network f_g.
        pair_hidden: usize = 16, 1..=256;
        /// Temperature of the straight-through Gumbel softmax.
        temperature: f32 = 1.0, 0.05..=20.0;
        /// Layer normalisation of the features that enter the State Extractor.
        feature_norm: bool = true;
        /// Hidden units of `local` and of the baselines.
        hidden: usize = 64, 8..=1024;
        /// Neighbours of `local`.
        neighbours: usize = 6, 1..=64;
        /// What the observation vector of the baselines says about where to go.
        observes: Observes = Observes::Landmarks;
        /// Whether landmarks, balls and agents stand in the observation vector in the order of their distance, not of their index.
        nearest_first: bool = false;
        /// Whether the observation vector of the baselines ends with the agent's index, one-hot.
        agent_index: bool = true;
        /// Whether `flat` has a memory (GRU).
        recurrent: bool = false;
        /// Whether the critic of `flat` and `dicg` sees the state of the whole team (MAPPO) or the agent's observation alone (IPPO).
        centralised_critic: bool = true;
        /// Blocks of encoder and decoder of `mat` and `mat-dec`.
        attention_blocks: usize = 1, 1..=8;
        /// Heads of each attention of `mat` and `mat-dec`; must divide `hidden`.
        attention_heads: usize = 1, 1..=16;
        /// Whether the graph convolutions of `dicg` keep their random initial weights, as in its authors' code.
        frozen_graph: bool = false;
    }
}

impl ExecutorConfig {
    /// H: width of the memory, 0 for executors without one.
    pub fn memory(&self) -> usize {
        use ExecutorKind::{Attention, Dicg, Flat, Local, Magex, MagexLiteral, Mat, MatDec, Mlp};
        match self.kind {
            Magex | MagexLiteral | Attention | Mlp => self.feature_size,
            Flat if self.recurrent => self.hidden,
            Local | Flat | Mat | MatDec | Dicg => 0,
        }
    }

    /// Checks what depends on the kind: an option that does nothing would look as if it did something.
    pub(super) fn check_kind(&self) -> Result<(), FieldError> {
        use ExecutorKind::{Dicg, Flat, Mat, MatDec};
        let (default, kind) = (Self::default(), self.kind);
        let owners: [(&str, bool, &[ExecutorKind]); 8] = [
            ("observes", self.observes != default.observes, &[Flat, Mat, MatDec, Dicg]),
            ("nearest_first", self.nearest_first != default.nearest_first, &[Flat, Mat, MatDec, Dicg]),
            ("agent_index", self.agent_index != default.agent_index, &[Flat, Mat, MatDec, Dicg]),
            ("recurrent", self.recurrent != default.recurrent, &[Flat]),
            ("centralised_critic", self.centralised_critic != default.centralised_critic, &[Flat, Dicg]),
            ("attention_blocks", self.attention_blocks != default.attention_blocks, &[Mat, MatDec]),
            ("attention_heads", self.attention_heads != default.attention_heads, &[Mat, MatDec]),
            ("frozen_graph", self.frozen_graph != default.frozen_graph, &[Dicg]),
        ];
        if let Some((key, _, owners)) = owners.into_iter().find(|(_, set, owners)| *set && !owners.contains(&kind)) {
            let owners: Vec<String> = owners.iter().map(ExecutorKind::to_string).collect();
            let problem = format!("belongs to {}; the executor is {kind}; remove it", owners.join(", "));
            return Err(FieldError::new(format!("executor.{key}"), problem));
        }
        let (hidden, heads) = (self.hidden, self.attention_heads);
        if self.memory() > 0 && kind == Flat && !hidden.is_multiple_of(16) {
            let problem = format!("{hidden} must be a multiple of 16 for a recurrent executor");
            return Err(FieldError::new("executor.hidden", problem));
        }
        if matches!(kind, Mat | MatDec) && !hidden.is_multiple_of(heads) {
            let problem = format!("{heads} must divide executor.hidden = {hidden}");
            return Err(FieldError::new("executor.attention_heads", problem));
        }
        Ok(())
    }
}
