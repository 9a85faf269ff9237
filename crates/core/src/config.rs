//! Configuration of a run: every key, its default and its range. docs/configuration.md lists them with their sources,
//! and a test keeps the two equal.
//!
//! Reading is strict: an unknown key or a value out of range is an error that names the field and the remedy.

mod executor;
mod off_policy;
mod raw;
mod setting;

use crate::error::{FieldError, UnknownName, check_range};
use crate::section::section;
use crate::task::{RewardTarget, Spawn, TaskConfig, TaskName};
use serde::de::IntoDeserializer as _;
use serde::{Deserialize, Serialize};

pub use executor::{ExecutorConfig, ExecutorKind, Observes};
pub use off_policy::{Algorithm, MaserConfig, QmixConfig};
pub use setting::Setting;

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
    /// MAPPO, the learner's algorithm unless `run.algorithm` names another.
    pub mappo: MappoConfig,
    /// QMIX, which MASER builds on.
    pub qmix: QmixConfig,
    /// What MASER adds to QMIX.
    pub maser: MaserConfig,
}

/// Limit of the seed of a run: what TOML's whole numbers hold.
pub const SEED_MAX: u64 = i64::MAX as u64;
/// Limit of the budget of a run.
pub const STEPS_MAX: u64 = 1_000_000_000_000;
/// `run.target_collisions` that asks for nothing.
pub const COLLISIONS_ANY: f32 = 1000.0;
/// `run.target_return` that asks for nothing.
pub const RETURN_ANY: f32 = 1e30;
/// Limit of the episodes of an iteration.
const EPISODES_MAX: u32 = 100_000;

section! {
    /// `[run]`
    RunSection {
        /// What the learner does with the episodes.
        algorithm: Algorithm = Algorithm::Mappo;
        /// Seed of every random stream.
        seed: u64 = 1, 0..=SEED_MAX;
        /// Budget: joint environment steps to train on.
        max_steps: u64 = 20_000, 1..=STEPS_MAX;
        /// Stop when two consecutive evaluations reach this greedy success rate; above 1 never stops early.
        target_success: f32 = 0.995, 0.0..=2.0;
        /// Stop only if the training episodes of the same weights reach this success rate, too (sampled actions); 0 asks for none.
        target_sampled_success: f32 = 0.0, 0.0..=1.0;
        /// Stop only if the greedy evaluation has at most this many collisions per agent and step; 1000 allows any.
        target_collisions: f32 = COLLISIONS_ANY, 0.0..=COLLISIONS_ANY;
        /// External environments: stop when two consecutive evaluations reach this greedy return of an episode; 1e30 never stops
        /// early.
        target_return: f32 = RETURN_ANY, -1e30..=RETURN_ANY;
        /// Evaluate every this many iterations.
        eval_every: u32 = 1, 1..=1_000_000;
        /// Greedy episodes per evaluation while training.
        eval_episodes: u32 = 64, 1..=100_000;
        /// Episodes of the evaluation that closes the run, greedy and sampled each.
        final_episodes: u32 = 100, 1..=100_000;
        /// Write a checkpoint every this many iterations (and at the end, and when stopped).
        checkpoint_every: u32 = 5, 1..=1_000_000;
        /// Checkpoints kept.
        keep_checkpoints: u32 = 3, 2..=1000;
        /// SHA-256 of the weights that the run begins from (`--from`); empty if it begins anew.
        initial_weights: String = String::new();
        /// Whether the run begins with the optimiser's state of these weights, too (`--keep-optimiser`).
        initial_optimiser: bool = false;
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
    /// The shortest longest way; among those the smallest sum.
    Makespan,
    /// The cheapest remaining pair of agent and goal, repeatedly.
    Greedy,
    /// Random assignment (the paper's ablation "w. RG").
    Random,
}

impl CommanderPolicy {
    /// Whether the commander has weights that PPO trains.
    pub fn learned(self) -> bool {
        matches!(self, Self::Pairwise | Self::Ranking)
    }

    /// Whether it sums powers of distances.
    pub fn knows_power(self) -> bool {
        matches!(self, Self::Exact | Self::Makespan)
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
        let choices = "pairwise, ranking, exact, makespan, greedy or random";
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

/// What the learned scheduler's PPO is rewarded for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CommanderObjective {
    /// R_c = 1 − C_c / C_h of the decision (paper, eq. 4): known before the episode is played.
    Distance,
    /// The last arrival and the collisions that were measured in the episode.
    Arrival,
}

section! {
    /// `[commander]`
    CommanderConfig {
        /// Goal scheduler.
        kind: CommanderPolicy = CommanderPolicy::Pairwise;
        /// Exponent of the distances that the `exact` and `makespan` schedulers sum, and that `pairwise` with the objective
        /// `arrival` compares; 1 for the others.
        power: f64 = 1.0, 1.0..=16.0;
        /// Hidden units per layer of the scheduler's network.
        hidden: usize = 32, 4..=1024;
        /// Canonical order of the `ranking` scheduler.
        order: CanonicalOrder = CanonicalOrder::Angle;
        /// Share of the training episodes whose goals are a random matching, whatever the scheduler: agents meet more often.
        random_assignment_fraction: f32 = 0.0, 0.0..=1.0;
        /// What the learned kinds are rewarded for.
        objective: CommanderObjective = CommanderObjective::Distance;
        /// Price of one collision per agent and step, as a share of the horizon, when the objective is the arrival.
        collision_cost: f32 = 1.0, 0.0..=1000.0;
        /// Adam's step size.
        learning_rate: f64 = 1e-3, 0.0..=1.0;
        /// PPO epochs over the iteration's episodes.
        epochs: usize = 3, 1..=100;
        /// Episodes per minibatch.
        minibatch: usize = 64, 1..=1_000_000;
        /// ε of the clipped surrogate, per pick.
        clip: f32 = 0.2, 0.001..=10.0;
        /// Weight of the entropy of the picks.
        entropy: f32 = 0.0, 0.0..=10.0;
        /// Global-norm limit of the gradient.
        max_grad_norm: f32 = 10.0, 1e-6..=1e9;
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

section! {
    /// `[mappo]`
    MappoConfig {
        /// γ.
        gamma: f32 = 0.99, 0.0..=1.0;
        /// λ of generalised advantage estimation.
        gae_lambda: f32 = 0.95, 0.0..=1.0;
        /// Passes over an iteration's data.
        epochs: u32 = 5, 1..=1000;
        /// Agent samples per minibatch (rounded to whole joint states or chunks).
        minibatch_size: usize = 2048, 1..=100_000_000;
        /// L: steps of a chunk through which the memory is differentiated; must divide the horizon.
        chunk_length: usize = 10;
        /// Parts of a minibatch whose gradients are summed in a fixed order; computed by as many threads as there are.
        gradient_slices: usize = 4, 1..=64;
        /// ε of the clipped surrogate and of the clipped value.
        clip_epsilon: f32 = 0.2, 0.001..=10.0;
        /// Weight of the entropy.
        entropy_coef: f32 = 0.01, 0.0..=10.0;
        /// δ of the Huber value loss, in normalised units.
        huber_delta: f32 = 10.0, 1e-3..=1e6;
        /// Normalise value targets by running statistics (ValueNorm).
        value_norm: bool = true;
        /// Bootstrap the value of the true last state: the horizon is a time limit, not an end.
        bootstrap_at_horizon: bool = true;
        /// Adam's step size of the actor.
        actor_learning_rate: f64 = 7e-4, 0.0..=1.0;
        /// Adam's step size of the critic.
        critic_learning_rate: f64 = 7e-4, 0.0..=1.0;
        /// Lower both step sizes linearly to zero over the budget.
        linear_decay: bool = false;
        /// Adam's ε.
        adam_epsilon: f64 = 1e-5, 1e-12..=1.0;
        /// Global-norm limit of each network's gradient.
        max_grad_norm: f32 = 10.0, 1e-6..=1e9;
        /// Whether the importance ratio is that of the joint action of the team (DICG) or of each agent's own.
        joint_ratio: bool = false;
    }
}

impl Default for RunConfig {
    /// The first run: Simple Spread with 50 agents, MAGE-X, until the policy is worth keeping, sampled as well as greedy. Rewards of
    /// the next ten steps decide (γ = 0.9), because agents then learn sooner not to collide (docs/results.md, "The first run"). It
    /// is deploy/configs/spread-50.toml.
    fn default() -> Self {
        Self {
            run: RunSection {
                target_success: 0.999,
                target_sampled_success: 0.96,
                target_collisions: 0.04,
                ..RunSection::default()
            },
            task: TaskConfig::simple_spread(50, Spawn::Lines(None)),
            executor: ExecutorConfig::default(),
            commander: CommanderConfig::default(),
            collect: CollectConfig { episodes_per_iteration: 4, shards_per_iteration: 4 },
            mappo: MappoConfig {
                gamma: 0.9,
                gae_lambda: 0.9,
                entropy_coef: 0.0,
                actor_learning_rate: 1e-3,
                critic_learning_rate: 1e-3,
                ..MappoConfig::default()
            },
            qmix: QmixConfig::default(),
            maser: MaserConfig::default(),
        }
    }
}

impl RunConfig {
    /// Reads TOML; missing keys take their defaults, or the values of the first run ([`RunConfig::default`]) if there is no
    /// `[task]`; unknown keys and values out of range are errors.
    pub fn from_toml(text: &str) -> Result<Self, ConfigError> {
        Self::from_toml_with(text, &[])
    }

    /// [`Self::from_toml`] with some keys changed: what the file derives from a key, it derives from the changed one. A later
    /// setting of the same key wins.
    ///
    /// # Errors
    /// Those of a file that has these keys.
    pub fn from_toml_with(text: &str, settings: &[Setting]) -> Result<Self, ConfigError> {
        raw::read(text, settings)?.validated()
    }

    /// Reads what another format than TOML holds, such as the JSON of an earlier build: keys that it does not have take their
    /// defaults, as in a file.
    pub fn from_keys(keys: &impl Serialize) -> Result<Self, ConfigError> {
        let table = toml::Table::try_from(keys).map_err(|error| ConfigError(error.to_string()))?;
        Self::from_toml(&table.to_string())
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
        let wanted = match self.task.name {
            // About 4,096 agent samples.
            TaskName::External => 4096 / (self.task.agents as u32 * self.task.horizon).max(1),
            _ => 200 / self.task.agents.max(1) as u32,
        };
        let wanted = wanted.clamp(4, 64);
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

    fn check_ranges(&self) -> Result<(), FieldError> {
        self.task.validate()?;
        self.run.check_ranges("run")?;
        let parent = &self.run.initial_weights;
        if !parent.is_empty() && (parent.len() != 64 || !parent.bytes().all(|byte| byte.is_ascii_hexdigit())) {
            let problem = "not a SHA-256 (64 hexadecimal digits); --from RUN writes this key";
            return Err(FieldError::new("run.initial_weights", problem));
        }
        self.executor.check_ranges("executor")?;
        self.executor.check_kind()?;
        self.check_external()?;
        let simulated = self.task.name != TaskName::External;
        let paid_for_goals = simulated && self.task.reward_target == RewardTarget::Goals;
        if self.executor.kind.flat() && self.executor.observes == Observes::Landmarks && paid_for_goals {
            let problem = "\"goals\" pays each agent for a goal that executor.observes = \"landmarks\" does not show it; use \
                           \"team\", or observe goals";
            return Err(FieldError::new("task.reward_target", problem));
        }
        self.commander.check_ranges("commander")?;
        let CommanderConfig { kind, power, objective, collision_cost, .. } = self.commander;
        if objective != CommanderObjective::Distance && !kind.learned() {
            let problem =
                format!("the {kind} scheduler does not learn; remove it, or use commander.kind = \"pairwise\"");
            return Err(FieldError::new("commander.objective", problem));
        }
        if objective == CommanderObjective::Distance && collision_cost != CommanderConfig::default().collision_cost {
            let problem = "counts only with commander.objective = \"arrival\"; remove it, or set that";
            return Err(FieldError::new("commander.collision_cost", problem));
        }
        // The objective of the distance would lead the pairwise scheduler back to the power 1.
        let arriving = kind == CommanderPolicy::Pairwise && objective == CommanderObjective::Arrival;
        if power != 1.0 && !kind.knows_power() && !arriving {
            let problem = format!(
                "{power}, but the {kind} scheduler has no power; use 1, commander.kind = \"exact\" or \"makespan\", or \
                 \"pairwise\" with commander.objective = \"arrival\""
            );
            return Err(FieldError::new("commander.power", problem));
        }
        self.mappo.check_ranges("mappo")?;
        let (features, chunk, horizon) =
            (self.executor.feature_size, self.mappo.chunk_length, self.task.horizon as usize);
        if features % 16 != 0 {
            let problem = format!("{features} must be a multiple of 16");
            return Err(FieldError::new("executor.feature_size", problem));
        }
        let CollectConfig { episodes_per_iteration: episodes, shards_per_iteration: shards } = self.collect;
        check_range("collect.episodes_per_iteration", episodes, 1, EPISODES_MAX)?;
        check_range("collect.shards_per_iteration", shards, 1, episodes)?;
        if episodes % shards != 0 {
            let problem = format!("{shards} must divide collect.episodes_per_iteration = {episodes}");
            return Err(FieldError::new("collect.shards_per_iteration", problem));
        }
        self.qmix.check_ranges("qmix")?;
        self.maser.check_ranges("maser")?;
        self.check_algorithm()?;
        if self.run.algorithm != Algorithm::Mappo {
            return Ok(());
        }
        check_range("mappo.chunk_length", chunk, 1, horizon)?;
        if self.executor.memory() > 0 && !horizon.is_multiple_of(chunk) {
            let problem = format!("{chunk} must divide task.horizon = {horizon}, or chunks would cross episodes");
            return Err(FieldError::new("mappo.chunk_length", problem));
        }
        Ok(())
    }

    /// Checks what an external environment cannot be combined with.
    fn check_external(&self) -> Result<(), FieldError> {
        if self.task.name != TaskName::External {
            if self.run.target_return != RETURN_ANY {
                let problem = format!("belongs to external environments; the task is {}; remove it", self.task.name);
                return Err(FieldError::new("run.target_return", problem));
            }
            return Ok(());
        }
        let wrong = |key: &str, problem: &str| Err(FieldError::new(key, problem));
        if self.run.algorithm != Algorithm::Mappo {
            return wrong(
                "run.algorithm",
                "an external environment is trained by \"mappo\" (or IPPO: executor.centralised_critic)",
            );
        }
        if self.executor.kind != ExecutorKind::Flat {
            return wrong("executor.kind", "an external environment gives observation vectors: use \"flat\"");
        }
        if self.executor.observes != Observes::Landmarks || self.executor.nearest_first {
            return wrong("executor", "observes and nearest_first belong to the simulated tasks; remove them");
        }
        if self.commander.kind.learned() || self.commander.power != 1.0 {
            return wrong("commander", "an external environment has no goals to assign; remove this section");
        }
        if self.mappo.joint_ratio {
            return wrong("mappo.joint_ratio", "agents of an external environment may leave it; use false");
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
