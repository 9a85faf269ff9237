//! Configuration of a run: every key, its default and its range. docs/configuration.md lists them with their sources,
//! and a test keeps the two equal.
//!
//! Reading is strict: an unknown key or a value out of range is an error that names the field and the remedy.

use crate::task::{Spawn, TaskConfig};
use serde::{Deserialize, Serialize};

/// Why a configuration was refused.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// Not TOML, an unknown key, or a value of the wrong type.
    #[error("configuration: {0}")]
    Syntax(String),
    /// A value out of its range; the message names the field and the remedy.
    #[error("configuration: {0}")]
    Range(String),
}

/// Everything that decides the numbers of a run, and nothing that does not (addresses, thread counts and folders are
/// options of the commands).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// Budget, target, evaluation, checkpoints.
    #[serde(default)]
    pub run: RunSection,
    /// The task.
    #[serde(default = "default_task")]
    pub task: TaskConfig,
    /// Networks of the action executor.
    #[serde(default)]
    pub executor: ExecutorConfig,
    /// The goal commander.
    #[serde(default)]
    pub commander: CommanderConfig,
    /// What an iteration collects.
    #[serde(default)]
    pub collect: CollectConfig,
    /// The learner's algorithm.
    #[serde(default)]
    pub mappo: MappoConfig,
}

fn default_task() -> TaskConfig {
    TaskConfig::simple_spread(50, Spawn::Lines(None))
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
        f.write_str(match self {
            Self::Magex => "magex",
            Self::MagexLiteral => "magex-literal",
            Self::Attention => "attention",
            Self::Mlp => "mlp",
            Self::Local => "local",
        })
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
pub enum CommanderKind {
    /// Permutation-equivariant pairwise scorer with sequential masked sampling.
    Pairwise,
    /// The paper's Goal Scheduler: one score per goal, ranked, handed to agents in canonical order.
    Ranking,
    /// Exact assignment (the paper's "Hungarian").
    Exact,
    /// Random assignment (the paper's ablation "w. RG").
    Random,
}

impl CommanderKind {
    /// Whether the commander has weights that PPO trains.
    pub fn learned(self) -> bool {
        matches!(self, Self::Pairwise | Self::Ranking)
    }

    /// Whether the weights serve one team size only.
    pub fn fixed_team_size(self) -> bool {
        self == Self::Ranking
    }
}

impl std::fmt::Display for CommanderKind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Pairwise => "pairwise",
            Self::Ranking => "ranking",
            Self::Exact => "exact",
            Self::Random => "random",
        })
    }
}

impl std::str::FromStr for CommanderKind {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "pairwise" => Ok(Self::Pairwise),
            "ranking" => Ok(Self::Ranking),
            "exact" => Ok(Self::Exact),
            "random" => Ok(Self::Random),
            _ => Err(format!("unknown scheduler '{text}'; use pairwise, ranking, exact or random")),
        }
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
    pub kind: CommanderKind,
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
            kind: CommanderKind::Pairwise,
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
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CollectConfig {
    /// Episodes per iteration; 0 means about 200 agents' worth: 40 for N = 5, 12 for N = 20, 4 from N = 50 on.
    pub episodes_per_iteration: u32,
    /// S: shards that an iteration's episodes are cut into; must divide `episodes_per_iteration`.
    pub shards_per_iteration: u32,
}

impl Default for CollectConfig {
    fn default() -> Self {
        Self { episodes_per_iteration: 0, shards_per_iteration: 4 }
    }
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
            task: default_task(),
            executor: ExecutorConfig::default(),
            commander: CommanderConfig::default(),
            collect: CollectConfig { episodes_per_iteration: 4, ..CollectConfig::default() },
            mappo: MappoConfig::default(),
        }
    }
}

impl RunConfig {
    /// Reads TOML; missing keys take their defaults; unknown keys and values out of range are errors.
    pub fn from_toml(text: &str) -> Result<Self, ConfigError> {
        let config: Self = toml::from_str(text).map_err(|e| ConfigError::Syntax(e.to_string().trim().to_owned()))?;
        config.resolved()
    }

    /// Fills in what "0 means default" stands for, and checks every range.
    pub fn resolved(mut self) -> Result<Self, ConfigError> {
        self.task = self.task.resolved();
        if self.collect.episodes_per_iteration == 0 {
            self.collect.episodes_per_iteration = self.derived_episodes();
        }
        self.validate()?;
        Ok(self)
    }

    /// The effective configuration, every key with its value.
    pub fn to_toml(&self) -> Result<String, ConfigError> {
        toml::to_string(self).map_err(|e| ConfigError::Syntax(e.to_string()))
    }

    /// What `collect.episodes_per_iteration = 0` stands for: about 200 agents' worth, a multiple of the shards.
    pub fn derived_episodes(&self) -> u32 {
        let wanted = (200 / self.task.agents.max(1) as u32).clamp(4, 64);
        wanted.next_multiple_of(self.collect.shards_per_iteration.max(1))
    }

    /// Joint environment steps of one iteration.
    pub fn steps_per_iteration(&self) -> u64 {
        u64::from(self.collect.episodes_per_iteration) * u64::from(self.task.horizon)
    }

    /// Whole iterations that the budget pays for (at least one).
    pub fn max_iterations(&self) -> u32 {
        u32::try_from((self.run.max_steps / self.steps_per_iteration().max(1)).max(1)).unwrap_or(u32::MAX)
    }

    fn validate(&self) -> Result<(), ConfigError> {
        let range = ConfigError::Range;
        self.task.validate().map_err(range)?;
        let (r, e, c, k, m) = (&self.run, &self.executor, &self.commander, &self.collect, &self.mappo);
        within("run.seed", r.seed as f64, 0.0, i64::MAX as f64)?;
        within("run.max_steps", r.max_steps as f64, 1.0, 1e12)?;
        within("run.target_success", r.target_success.into(), 0.0, 2.0)?;
        within("run.eval_every", r.eval_every.into(), 1.0, 1e6)?;
        within("run.eval_episodes", r.eval_episodes.into(), 1.0, 1e5)?;
        within("run.final_episodes", r.final_episodes.into(), 1.0, 1e5)?;
        within("run.checkpoint_every", r.checkpoint_every.into(), 1.0, 1e6)?;
        within("run.keep_checkpoints", r.keep_checkpoints.into(), 2.0, 1e3)?;
        within("executor.feature_size", e.feature_size as f64, 16.0, 512.0)?;
        if e.feature_size % 16 != 0 {
            return Err(range(format!("executor.feature_size: {} must be a multiple of 16", e.feature_size)));
        }
        within("executor.graph_blocks", e.graph_blocks as f64, 1.0, 8.0)?;
        within("executor.pair_hidden", e.pair_hidden as f64, 1.0, 256.0)?;
        within("executor.temperature", e.temperature.into(), 0.05, 20.0)?;
        within("executor.hidden", e.hidden as f64, 8.0, 1024.0)?;
        within("executor.neighbours", e.neighbours as f64, 1.0, 64.0)?;
        within("commander.hidden", c.hidden as f64, 4.0, 1024.0)?;
        within("commander.random_assignment_fraction", c.random_assignment_fraction.into(), 0.0, 1.0)?;
        within("commander.learning_rate", c.learning_rate, 0.0, 1.0)?;
        within("commander.epochs", c.epochs as f64, 1.0, 100.0)?;
        within("commander.minibatch", c.minibatch as f64, 1.0, 1e6)?;
        within("commander.clip", c.clip.into(), 0.001, 10.0)?;
        within("commander.entropy", c.entropy.into(), 0.0, 10.0)?;
        within("commander.max_grad_norm", c.max_grad_norm.into(), 1e-6, 1e9)?;
        within("collect.episodes_per_iteration", k.episodes_per_iteration.into(), 1.0, 1e5)?;
        within("collect.shards_per_iteration", k.shards_per_iteration.into(), 1.0, k.episodes_per_iteration.into())?;
        if k.episodes_per_iteration % k.shards_per_iteration != 0 {
            return Err(range(format!(
                "collect.shards_per_iteration: {} must divide collect.episodes_per_iteration = {}",
                k.shards_per_iteration, k.episodes_per_iteration
            )));
        }
        within("mappo.gamma", m.gamma.into(), 0.0, 1.0)?;
        within("mappo.gae_lambda", m.gae_lambda.into(), 0.0, 1.0)?;
        within("mappo.epochs", m.epochs.into(), 1.0, 1000.0)?;
        within("mappo.minibatch_size", m.minibatch_size as f64, 1.0, 1e8)?;
        within("mappo.chunk_length", m.chunk_length as f64, 1.0, self.task.horizon.into())?;
        if e.memory() > 0 && !(self.task.horizon as usize).is_multiple_of(m.chunk_length) {
            return Err(range(format!(
                "mappo.chunk_length: {} must divide task.horizon = {}, or chunks would cross episodes",
                m.chunk_length, self.task.horizon
            )));
        }
        within("mappo.gradient_slices", m.gradient_slices as f64, 1.0, 64.0)?;
        within("mappo.clip_epsilon", m.clip_epsilon.into(), 0.001, 10.0)?;
        within("mappo.entropy_coef", m.entropy_coef.into(), 0.0, 10.0)?;
        within("mappo.huber_delta", m.huber_delta.into(), 1e-3, 1e6)?;
        within("mappo.actor_learning_rate", m.actor_learning_rate, 0.0, 1.0)?;
        within("mappo.critic_learning_rate", m.critic_learning_rate, 0.0, 1.0)?;
        within("mappo.adam_epsilon", m.adam_epsilon, 1e-12, 1.0)?;
        within("mappo.max_grad_norm", m.max_grad_norm.into(), 1e-6, 1e9)
    }
}

fn within(field: &str, value: f64, low: f64, high: f64) -> Result<(), ConfigError> {
    if value.is_finite() && (low..=high).contains(&value) {
        Ok(())
    } else {
        Err(ConfigError::Range(format!("{field}: {value} is outside {low}..={high}")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_empty_file_is_the_default_run() {
        let config = RunConfig::from_toml("").unwrap();
        assert_eq!(config, RunConfig::default());
        assert_eq!(RunConfig::from_toml(&config.to_toml().unwrap()).unwrap(), config);
    }

    #[test]
    fn unknown_keys_and_bad_values_are_named() {
        for (text, name) in [
            ("[mappo]\ngama = 0.9", "gama"),
            ("[executer]\nkind = 'local'", "executer"),
            ("[mappo]\ngamma = 1.5", "mappo.gamma"),
            ("[collect]\nepisodes_per_iteration = 9\nshards_per_iteration = 4", "collect.shards_per_iteration"),
            ("[mappo]\nchunk_length = 7", "mappo.chunk_length"),
            ("[executor]\nfeature_size = 20", "executor.feature_size"),
            ("[run]\nmax_steps = 0", "run.max_steps"),
            ("[task]\nname = 'simple-spread'\nagents = 0\nspawn = 'lines'", "task.agents"),
            ("[task]\nname = 'simple-spread'\nagents = 5\nspawn = 'ring'", "ring"),
            ("[commander]\nkind = 'best'", "best"),
        ] {
            let error = RunConfig::from_toml(text).unwrap_err().to_string();
            assert!(error.contains(name), "{text}: {error}");
        }
    }

    #[test]
    fn a_partial_task_takes_the_paper_sizes() {
        let config = RunConfig::from_toml("[task]\nname = 'simple-spread'\nagents = 5\nspawn = 'uniform'").unwrap();
        assert_eq!((config.task.side, config.task.horizon), (2.0, 60));
    }
}
