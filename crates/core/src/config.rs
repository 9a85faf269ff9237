//! Configuration of a run: every key, its default and its range. docs/configuration.md lists them with their sources,
//! and a test keeps the two equal.
//!
//! Reading is strict: an unknown key or a value out of range is an error that names the field and the remedy.

mod raw;

use crate::error::{FieldError, UnknownName, check_range};
use crate::task::{Spawn, TaskConfig};
use serde::de::IntoDeserializer as _;
use serde::{Deserialize, Serialize};

/// Why a configuration was refused: it is not TOML, or has a key that does not exist, or a value of the wrong type or out of
/// its range.
#[derive(Debug, thiserror::Error)]
#[error("configuration: {0}")]
pub struct ConfigError(pub String);

// Not a source: the message holds all of it, and reports that follow the sources would say it twice.
impl From<FieldError> for ConfigError {
    fn from(error: FieldError) -> Self {
        Self(error.to_string())
    }
}

/// Everything that decides the numbers of a run, and nothing that does not (addresses, thread counts and folders are
/// options of the commands). Every value is given; [`RunConfig::from_toml`] fills in defaults and checks ranges.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RunConfig {
    /// Budget, target, evaluation, checkpoints.
    pub run: RunSection,
    /// The task.
    pub task: TaskConfig,
    /// Networks of the action executor.
    pub executor: ExecutorConfig,
    /// The goal commander.
    pub commander: CommanderConfig,
    /// What an iteration collects.
    pub collect: CollectConfig,
    /// The learner's algorithm.
    pub mappo: MappoConfig,
}

/// `[run]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RunSection {
    /// Seed of every random stream.
    pub seed: u64,
    /// Budget: joint environment steps to train on.
    pub max_steps: u64,
    /// Stop when two consecutive evaluations reach this greedy success rate; above 1 never stops early.
    pub target_success: f32,
    /// Evaluate every this many iterations.
    pub eval_every: u32,
    /// Greedy episodes per evaluation while training.
    pub eval_episodes: u32,
    /// Episodes of the evaluation that closes the run, greedy and sampled each.
    pub final_episodes: u32,
    /// Write a checkpoint every this many iterations (and at the end, and when stopped).
    pub checkpoint_every: u32,
    /// Checkpoints kept.
    pub keep_checkpoints: u32,
}

impl Default for RunSection {
    fn default() -> Self {
        Self {
            seed: 1,
            max_steps: 20_000,
            target_success: 0.995,
            eval_every: 1,
            eval_episodes: 64,
            final_episodes: 100,
            checkpoint_every: 5,
            keep_checkpoints: 3,
        }
    }
}

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
}

impl std::fmt::Display for ExecutorKind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.serialize(f)
    }
}

impl ExecutorKind {
    /// Whether the weights serve one team size only.
    pub fn fixed_team_size(self) -> bool {
        self == Self::Mlp
    }
}

/// `[executor]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ExecutorConfig {
    /// Architecture.
    pub kind: ExecutorKind,
    /// F: feature size of the graph executors.
    pub feature_size: usize,
    /// l_g: blocks of the Graph Encoder.
    pub graph_blocks: usize,
    /// Hidden units of the pair network f_g.
    pub pair_hidden: usize,
    /// Temperature of the straight-through Gumbel softmax.
    pub temperature: f32,
    /// Layer normalisation of the features that enter the State Extractor.
    pub feature_norm: bool,
    /// Hidden units of `local`.
    pub hidden: usize,
    /// Neighbours of `local`.
    pub neighbours: usize,
}

impl ExecutorConfig {
    /// H: width of the memory, 0 for executors without one.
    pub fn memory(&self) -> usize {
        if self.kind == ExecutorKind::Local { 0 } else { self.feature_size }
    }
}

impl Default for ExecutorConfig {
    fn default() -> Self {
        Self {
            kind: ExecutorKind::Magex,
            feature_size: 32,
            graph_blocks: 2,
            pair_hidden: 16,
            temperature: 1.0,
            feature_norm: true,
            hidden: 64,
            neighbours: 6,
        }
    }
}

/// Goal scheduler.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CommanderPolicy {
    /// Permutation-equivariant pairwise scorer with sequential masked sampling.
    Pairwise,
    /// The paper's Goal Scheduler: one score per goal, ranked, handed to agents in canonical order.
    Ranking,
    /// Exact assignment (the paper's "Hungarian").
    Exact,
    /// Random assignment (the paper's ablation "w. RG").
    Random,
}

impl CommanderPolicy {
    /// Whether the commander has weights that PPO trains.
    pub fn learned(self) -> bool {
        matches!(self, Self::Pairwise | Self::Ranking)
    }

    /// Whether the weights serve one team size only.
    pub fn fixed_team_size(self) -> bool {
        self == Self::Ranking
    }
}

impl std::fmt::Display for CommanderPolicy {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.serialize(f)
    }
}

impl std::str::FromStr for CommanderPolicy {
    type Err = UnknownName;
    fn from_str(text: &str) -> Result<Self, UnknownName> {
        let choices = "pairwise, ranking, exact or random";
        Self::deserialize(text.into_deserializer()).map_err(|_: serde::de::value::Error| UnknownName {
            what: "scheduler",
            name: text.to_owned(),
            choices,
        })
    }
}

/// Order in which the ranking scheduler sees agents and goals, and hands out goals.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CanonicalOrder {
    /// By the first coordinate.
    X,
    /// By the angle around the centre of all positions.
    Angle,
    /// Along a Hilbert curve.
    Hilbert,
}

/// `[commander]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CommanderConfig {
    /// Goal scheduler.
    pub kind: CommanderPolicy,
    /// Hidden units per layer of the scheduler's network.
    pub hidden: usize,
    /// Canonical order of the `ranking` scheduler.
    pub order: CanonicalOrder,
    /// Share of the training episodes whose goals are a random matching, whatever the scheduler: agents meet more often.
    pub random_assignment_fraction: f32,
    /// Adam's step size.
    pub learning_rate: f64,
    /// PPO epochs over the iteration's episodes.
    pub epochs: usize,
    /// Episodes per minibatch.
    pub minibatch: usize,
    /// ε of the clipped surrogate, per pick.
    pub clip: f32,
    /// Weight of the entropy of the picks.
    pub entropy: f32,
    /// Global-norm limit of the gradient.
    pub max_grad_norm: f32,
}

impl Default for CommanderConfig {
    fn default() -> Self {
        Self {
            kind: CommanderPolicy::Pairwise,
            hidden: 32,
            order: CanonicalOrder::Angle,
            random_assignment_fraction: 0.0,
            learning_rate: 1e-3,
            epochs: 3,
            minibatch: 64,
            clip: 0.2,
            entropy: 0.0,
            max_grad_norm: 10.0,
        }
    }
}

/// `[collect]`
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CollectConfig {
    /// Episodes per iteration. Default: about 200 agents' worth, 40 for N = 5, 12 for N = 20, 4 from N = 50 on.
    pub episodes_per_iteration: u32,
    /// S: shards that an iteration's episodes are cut into; must divide `episodes_per_iteration`.
    pub shards_per_iteration: u32,
}

/// `[mappo]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MappoConfig {
    /// γ.
    pub gamma: f32,
    /// λ of generalised advantage estimation.
    pub gae_lambda: f32,
    /// Passes over an iteration's data.
    pub epochs: u32,
    /// Agent samples per minibatch (rounded to whole joint states or chunks).
    pub minibatch_size: usize,
    /// L: steps of a chunk through which the memory is differentiated; must divide the horizon.
    pub chunk_length: usize,
    /// Parts of a minibatch whose gradients are summed in a fixed order; computed by as many threads as there are.
    pub gradient_slices: usize,
    /// ε of the clipped surrogate and of the clipped value.
    pub clip_epsilon: f32,
    /// Weight of the entropy.
    pub entropy_coef: f32,
    /// δ of the Huber value loss, in normalised units.
    pub huber_delta: f32,
    /// Normalise value targets by running statistics (ValueNorm).
    pub value_norm: bool,
    /// Bootstrap the value of the true last state: the horizon is a time limit, not an end.
    pub bootstrap_at_horizon: bool,
    /// Adam's step size of the actor.
    pub actor_learning_rate: f64,
    /// Adam's step size of the critic.
    pub critic_learning_rate: f64,
    /// Lower both step sizes linearly to zero over the budget.
    pub linear_decay: bool,
    /// Adam's ε.
    pub adam_epsilon: f64,
    /// Global-norm limit of each network's gradient.
    pub max_grad_norm: f32,
}

impl Default for MappoConfig {
    fn default() -> Self {
        Self {
            gamma: 0.99,
            gae_lambda: 0.95,
            epochs: 5,
            minibatch_size: 2048,
            chunk_length: 10,
            gradient_slices: 4,
            clip_epsilon: 0.2,
            entropy_coef: 0.01,
            huber_delta: 10.0,
            value_norm: true,
            bootstrap_at_horizon: true,
            actor_learning_rate: 7e-4,
            critic_learning_rate: 7e-4,
            linear_decay: false,
            adam_epsilon: 1e-5,
            max_grad_norm: 10.0,
        }
    }
}

impl Default for RunConfig {
    /// Simple Spread with 50 agents, MAGE-X.
    fn default() -> Self {
        Self {
            run: RunSection::default(),
            task: TaskConfig::simple_spread(50, Spawn::Lines(None)),
            executor: ExecutorConfig::default(),
            commander: CommanderConfig::default(),
            collect: CollectConfig { episodes_per_iteration: 4, shards_per_iteration: 4 },
            mappo: MappoConfig::default(),
        }
    }
}

impl RunConfig {
    /// Reads TOML; missing keys take their defaults; unknown keys and values out of range are errors.
    pub fn from_toml(text: &str) -> Result<Self, ConfigError> {
        raw::read(text)?.validated()
    }

    /// The same configuration if every value is in its range.
    pub fn validated(self) -> Result<Self, ConfigError> {
        self.check_ranges()?;
        Ok(self)
    }

    /// The effective configuration, every key with its value.
    pub fn to_toml(&self) -> Result<String, ConfigError> {
        toml::to_string(self).map_err(|e| ConfigError(e.to_string()))
    }

    /// Episodes per iteration unless they are chosen: about 200 agents' worth, a multiple of the shards.
    pub fn derived_episodes(&self) -> u32 {
        derived_episodes(self.task.agents, self.collect.shards_per_iteration)
    }

    /// Joint environment steps of one iteration.
    pub fn steps_per_iteration(&self) -> u64 {
        u64::from(self.collect.episodes_per_iteration) * u64::from(self.task.horizon)
    }

    /// Whole iterations that the budget pays for (at least one).
    pub fn max_iterations(&self) -> u32 {
        u32::try_from((self.run.max_steps / self.steps_per_iteration().max(1)).max(1)).unwrap_or(u32::MAX)
    }

    fn check_ranges(&self) -> Result<(), FieldError> {
        self.task.validate()?;
        let (r, e, c, k, m) = (&self.run, &self.executor, &self.commander, &self.collect, &self.mappo);
        check_range("run.seed", r.seed, 0, i64::MAX as u64)?;
        check_range("run.max_steps", r.max_steps, 1, 1_000_000_000_000)?;
        check_range("run.target_success", r.target_success, 0.0, 2.0)?;
        check_range("run.eval_every", r.eval_every, 1, 1_000_000)?;
        check_range("run.eval_episodes", r.eval_episodes, 1, 100_000)?;
        check_range("run.final_episodes", r.final_episodes, 1, 100_000)?;
        check_range("run.checkpoint_every", r.checkpoint_every, 1, 1_000_000)?;
        check_range("run.keep_checkpoints", r.keep_checkpoints, 2, 1000)?;
        check_range("executor.feature_size", e.feature_size, 16, 512)?;
        if e.feature_size % 16 != 0 {
            let problem = format!("{} must be a multiple of 16", e.feature_size);
            return Err(FieldError::new("executor.feature_size", problem));
        }
        check_range("executor.graph_blocks", e.graph_blocks, 1, 8)?;
        check_range("executor.pair_hidden", e.pair_hidden, 1, 256)?;
        check_range("executor.temperature", e.temperature, 0.05, 20.0)?;
        check_range("executor.hidden", e.hidden, 8, 1024)?;
        check_range("executor.neighbours", e.neighbours, 1, 64)?;
        check_range("commander.hidden", c.hidden, 4, 1024)?;
        check_range("commander.random_assignment_fraction", c.random_assignment_fraction, 0.0, 1.0)?;
        check_range("commander.learning_rate", c.learning_rate, 0.0, 1.0)?;
        check_range("commander.epochs", c.epochs, 1, 100)?;
        check_range("commander.minibatch", c.minibatch, 1, 1_000_000)?;
        check_range("commander.clip", c.clip, 0.001, 10.0)?;
        check_range("commander.entropy", c.entropy, 0.0, 10.0)?;
        check_range("commander.max_grad_norm", c.max_grad_norm, 1e-6, 1e9)?;
        check_range("collect.episodes_per_iteration", k.episodes_per_iteration, 1, 100_000)?;
        check_range("collect.shards_per_iteration", k.shards_per_iteration, 1, k.episodes_per_iteration)?;
        if k.episodes_per_iteration % k.shards_per_iteration != 0 {
            let problem = format!(
                "{} must divide collect.episodes_per_iteration = {}",
                k.shards_per_iteration, k.episodes_per_iteration
            );
            return Err(FieldError::new("collect.shards_per_iteration", problem));
        }
        check_range("mappo.gamma", m.gamma, 0.0, 1.0)?;
        check_range("mappo.gae_lambda", m.gae_lambda, 0.0, 1.0)?;
        check_range("mappo.epochs", m.epochs, 1, 1000)?;
        check_range("mappo.minibatch_size", m.minibatch_size, 1, 100_000_000)?;
        check_range("mappo.chunk_length", m.chunk_length, 1, self.task.horizon as usize)?;
        if e.memory() > 0 && !(self.task.horizon as usize).is_multiple_of(m.chunk_length) {
            let problem = format!(
                "{} must divide task.horizon = {}, or chunks would cross episodes",
                m.chunk_length, self.task.horizon
            );
            return Err(FieldError::new("mappo.chunk_length", problem));
        }
        check_range("mappo.gradient_slices", m.gradient_slices, 1, 64)?;
        check_range("mappo.clip_epsilon", m.clip_epsilon, 0.001, 10.0)?;
        check_range("mappo.entropy_coef", m.entropy_coef, 0.0, 10.0)?;
        check_range("mappo.huber_delta", m.huber_delta, 1e-3, 1e6)?;
        check_range("mappo.actor_learning_rate", m.actor_learning_rate, 0.0, 1.0)?;
        check_range("mappo.critic_learning_rate", m.critic_learning_rate, 0.0, 1.0)?;
        check_range("mappo.adam_epsilon", m.adam_epsilon, 1e-12, 1.0)?;
        check_range("mappo.max_grad_norm", m.max_grad_norm, 1e-6, 1e9)
    }
}

/// See [`RunConfig::derived_episodes`].
fn derived_episodes(agents: usize, shards: u32) -> u32 {
    let wanted = (200 / agents.max(1) as u32).clamp(4, 64);
    wanted.next_multiple_of(shards.max(1))
}

#[cfg(test)]
mod tests;
