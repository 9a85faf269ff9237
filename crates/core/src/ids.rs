//! The names of things: newtypes, so that a version is never taken for an iteration.

use serde::{Deserialize, Serialize};
use std::fmt;

/// Number of a training iteration, from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Iteration(pub u32);

/// Version of the weights: iteration k uses version k and produces version k + 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct WeightsVersion(pub u32);

/// Identity of a run: drawn once when the run folder is created, kept across resumes.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct RunId(pub String);

impl fmt::Display for Iteration {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0)
    }
}
impl fmt::Display for WeightsVersion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0)
    }
}
impl fmt::Display for RunId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// How actions and goals are chosen.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mode {
    /// Sampled from the policy; the graph's Gumbel noise is on (training, "sampled" evaluation).
    Sampled,
    /// The most likely action, goal and edges.
    #[default]
    Greedy,
}

/// What a shard is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ShardKind {
    /// Episodes to train on: the trajectory comes back.
    Train,
    /// Episodes that only measure: their metrics come back.
    Eval,
}

/// A unit of work. Its result is a pure function of these fields, the run's seed and task, and the weights they name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Shard {
    /// Training or evaluation.
    pub kind: ShardKind,
    /// Iteration that asked for it.
    pub iteration: Iteration,
    /// Index within the iteration's shards of this kind.
    pub index: u32,
    /// B: episodes rolled out together.
    pub episodes: u32,
    /// Index of the first episode, so that an evaluation set does not depend on how it was cut.
    pub first_episode: u32,
    /// Weights of executor and commander.
    pub version: WeightsVersion,
    /// How actions and goals are chosen.
    pub mode: Mode,
    /// Evaluation set (0 while training, 1.. after), so that sets never share spawns.
    pub eval_set: u32,
    /// Record the states of the first episode (evaluation only).
    pub record: bool,
}
