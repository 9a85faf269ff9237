//! What a task is, as data: size, horizon, spawn, reward, what is assigned to whom and what an agent sees. No physics.
//!
//! A task is one [`TaskName`], one variant of [`TaskSettings`] and one file (`task/<name>.rs`) with a `Definition`;
//! its physics is in `magex-env`. Everything between (networks, actors, learner, commander) reads the answers given here.

mod bounds;
mod definition;
mod drones;
mod external;
mod observation;
mod push_ball;
mod simple_spread;
mod spawn;

use crate::error::{FieldError, check_range};
use crate::metrics_table::{METRICS, Metric, Scope};
use crate::statics::{LANDMARKS, StaticSpec};
use crate::trajectory::Shape;
use crate::{sha256, toml_table};
use serde::{Deserialize, Serialize};
use toml::{Table, Value};

pub use bounds::Bounds;
pub use definition::Definition;
pub use drones::{Downwash, DroneConfig};
pub use external::{CHOICES_MAX, ExternalConfig};
pub use observation::{Frame, Observation};
pub use push_ball::PushBallConfig;
pub use simple_spread::RewardConfig;
pub use spawn::Spawn;

/// Which task.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TaskName {
    /// Simple Spread (paper, section 5.1.1).
    SimpleSpread,
    /// Push Ball (paper, section 5.1.1).
    PushBall,
    /// Quadrotors on a rigid-body engine (paper, section 5.1.2).
    Drones,
    /// An external environment, behind `EnvironmentService`.
    External,
}

impl TaskName {
    /// All tasks.
    pub const ALL: [Self; 4] = [Self::SimpleSpread, Self::PushBall, Self::Drones, Self::External];

    /// The tasks that this program simulates itself.
    pub const SIMULATED: [Self; 3] = [Self::SimpleSpread, Self::PushBall, Self::Drones];

    fn definition(self) -> &'static Definition {
        match self {
            Self::SimpleSpread => &simple_spread::DEFINITION,
            Self::PushBall => &push_ball::DEFINITION,
            Self::Drones => &drones::DEFINITION,
            Self::External => &external::DEFINITION,
        }
    }
}

impl std::fmt::Display for TaskName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.serialize(f)
    }
}

/// What can be assigned, or be assigned to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Group {
    /// The N agents.
    Agents,
    /// The N balls, which follow the agents among the moving bodies.
    Balls,
    /// The N fixed landmarks.
    Landmarks,
}

/// One assignment problem of an episode: every member of one group gets a member of another one of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Stage {
    /// The group that is assigned.
    pub from: Group,
    /// The group that it is assigned to.
    pub to: Group,
}

/// What the numbers of an action mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ActionCode {
    /// One component: 0 none, 1 +x, 2 −x, 3 +y, 4 −y.
    Thrust,
    /// One component per axis: 0 forward (+), 1 stop, 2 backward (−).
    PerAxis,
    /// The environment's own.
    Own,
}

/// What the reward pays for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RewardTarget {
    /// Each agent is paid for its own goals: MAGE-X, and the baselines that get goals.
    #[default]
    Goals,
    /// The team is paid for all targets, whichever agent (or ball) is nearest, and every agent gets the same: the baselines
    /// without goals.
    Team,
}

/// In which order a particle moves and is accelerated in a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Integration {
    /// Velocities first: positions move with the new ones.
    #[default]
    VelocityFirst,
    /// Positions first: they move with the old velocities, as in today's mpe2 and JaxMARL.
    PositionFirst,
}

/// What only one task has, under the key of its section.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum TaskSettings {
    /// `[task.reward]`: Simple Spread.
    #[serde(rename = "reward")]
    SimpleSpread(RewardConfig),
    /// `[task.push_ball]`
    PushBall(PushBallConfig),
    /// `[task.drones]`
    Drones(DroneConfig),
    /// `[task.external]`
    External(ExternalConfig),
}

/// A task, fully determined. Equal tasks have equal fingerprints.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TaskConfig {
    /// Which task.
    pub name: TaskName,
    /// N: agents, and as many landmarks.
    pub agents: usize,
    /// Side of the square map in world units. Default: the paper's, or the density of the paper's largest team.
    pub side: f32,
    /// Steps per episode. Default: the paper's, or as many as the side asks for.
    pub horizon: u32,
    /// Where agents and landmarks start.
    pub spawn: Spawn,
    /// Raw units of the layout files per world unit (layouts only).
    pub layout_scale: f32,
    /// What the reward pays for: each agent's own goals, or the team's coverage of all of them.
    pub reward_target: RewardTarget,
    /// Order of a particle's step (Simple Spread).
    pub integration: Integration,
    /// What only this task has.
    #[serde(flatten)]
    pub settings: TaskSettings,
}

/// `[task]` as it is written: what is missing is derived from the team size.
#[derive(Default, Deserialize)]
#[serde(default)]
struct RawTask {
    name: Option<TaskName>,
    agents: Option<usize>,
    side: Option<f32>,
    horizon: Option<u32>,
    spawn: Option<Spawn>,
    layout_scale: Option<f32>,
    reward_target: RewardTarget,
    integration: Integration,
    /// The task's own section, and whatever else there is.
    #[serde(flatten)]
    sections: Table,
}

/// Limit of the agents of a team.
pub const AGENTS_MAX: usize = 5000;
/// Limit of the joint steps of an episode.
pub const HORIZON_MAX: u32 = 100_000;

/// The ranges of the keys of `[task]`, in words.
fn bounds(key: &str) -> Option<String> {
    match key {
        "agents" => Some(format!("1 to {AGENTS_MAX}")),
        "side" => Some("above 0 to 10000".to_owned()),
        "horizon" => Some(format!("1 to {HORIZON_MAX}")),
        "layout_scale" => Some("0.01 to 100".to_owned()),
        _ => None,
    }
}

/// The problem of an explicit zero where it would have no meaning.
pub(crate) const NOT_ZERO: &str = "0 is not a size; leave it out for the default";

/// Changes whenever the physics, the spawn, the reward or the observation change their meaning: part of the fingerprint.
pub const TASK_SEMANTICS: u32 = 2;

/// Reads the keys of `[task]` and fills in what is missing; ranges are checked by [`TaskConfig::validate`]. Errors name a
/// missing key, an explicit zero, an unknown key or a setting of another task.
pub(crate) fn read(keys: Table) -> Result<TaskConfig, FieldError> {
    let raw: RawTask = toml_table::read("task", keys, bounds)?;
    let missing = |key: &str| {
        let remedy = "missing; a [task] section needs name (simple-spread, push-ball or drones; or external, with \
                      --environment), agents and spawn";
        FieldError::new(format!("task.{key}"), remedy)
    };
    let name = raw.name.ok_or_else(|| missing("name"))?;
    let external = name == TaskName::External;
    if external && raw.spawn.is_some_and(|spawn| spawn != Spawn::Uniform) {
        return Err(FieldError::new("task.spawn", "the environment starts its episodes itself; remove it"));
    }
    if external && !raw.sections.contains_key(name.definition().section) {
        let problem = "missing: start with --environment COMMAND, which describes itself";
        return Err(FieldError::new("task.external", problem));
    }
    let agents = raw.agents.ok_or_else(|| missing("agents"))?;
    let spawn = if external { Spawn::Uniform } else { raw.spawn.ok_or_else(|| missing("spawn"))? };
    for (key, zero) in [
        ("side", raw.side == Some(0.0)),
        ("horizon", raw.horizon == Some(0)),
        ("layout_scale", raw.layout_scale == Some(0.0)),
    ] {
        if zero {
            return Err(FieldError::new(format!("task.{key}"), NOT_ZERO));
        }
    }
    let definition = name.definition();
    let side = raw.side.unwrap_or_else(|| (definition.side)(agents));
    let mut own = Table::new();
    for (key, value) in raw.sections {
        own = own_section(name, &key, value)?;
    }
    if external && raw.horizon.is_none() {
        return Err(FieldError::new("task.horizon", external::NO_HORIZON));
    }
    Ok(TaskConfig {
        name,
        agents,
        side,
        horizon: raw.horizon.unwrap_or_else(|| (definition.horizon)(agents, side)),
        spawn,
        layout_scale: raw.layout_scale.unwrap_or_else(|| (definition.layout_scale)(agents)),
        reward_target: raw.reward_target,
        integration: raw.integration,
        settings: (definition.read_settings)(side, own)?,
    })
}

/// The keys of a section within `[task]` if it is the task's own. A setting that the task does not read would look as if it
/// did something.
fn own_section(name: TaskName, key: &str, value: Value) -> Result<Table, FieldError> {
    let (field, own) = (format!("task.{key}"), name.definition().section);
    match value {
        Value::Table(keys) if key == own => Ok(keys),
        _ if key == own => Err(FieldError::new(field, "must be a section")),
        _ => Err(match TaskName::ALL.into_iter().find(|other| other.definition().section == key) {
            Some(owner) => FieldError::new(field, format!("belongs to {owner}, the task is {name}; remove it")),
            None => FieldError::new(
                field,
                format!(
                    "unknown key; use name, agents, side, horizon, spawn, layout_scale, reward_target, integration or the section {own}"
                ),
            ),
        }),
    }
}

impl TaskConfig {
    /// A task with the paper's sizes for N agents.
    pub fn of(name: TaskName, agents: usize, spawn: Spawn) -> Self {
        let definition = name.definition();
        let side = (definition.side)(agents);
        Self {
            name,
            agents,
            side,
            horizon: (definition.horizon)(agents, side),
            spawn,
            layout_scale: (definition.layout_scale)(agents),
            reward_target: RewardTarget::default(),
            integration: Integration::default(),
            settings: (definition.default_settings)(side),
        }
    }

    /// The same task for another team size: side, horizon and layout follow it, everything else stays.
    #[must_use]
    pub fn resized(mut self, agents: usize) -> Self {
        if self.agents != agents {
            let Self { side, horizon, layout_scale, .. } = Self::of(self.name, agents, self.spawn);
            simple_spread::follow_side(&mut self.settings, self.side, side);
            (self.agents, self.side, self.horizon, self.layout_scale) = (agents, side, horizon, layout_scale);
        }
        self
    }

    /// What the task says about itself, whatever its size.
    pub fn definition(&self) -> &'static Definition {
        self.name.definition()
    }

    /// D: space dimensions of positions.
    pub fn dims(&self) -> usize {
        self.definition().dims
    }

    /// Moving bodies that are not agents.
    pub fn balls(&self) -> usize {
        if self.definition().has_balls { self.agents } else { 0 }
    }

    /// X: further numbers of an agent's state that an agent sees and the wire carries.
    pub fn agent_state(&self) -> usize {
        self.external().map_or(self.definition().agent_state, |external| external.observation_width)
    }

    /// Choices of each action component.
    pub fn action_heads(&self) -> Vec<usize> {
        match self.action_code() {
            ActionCode::Thrust => vec![5],
            ActionCode::PerAxis => vec![3; self.dims()],
            ActionCode::Own => self.external().map_or_else(|_| Vec::new(), |external| external.choices.clone()),
        }
    }

    /// What the numbers of an action mean.
    pub fn action_code(&self) -> ActionCode {
        self.definition().action_code
    }

    /// The assignment problems of an episode, in order. The k-th goal of an agent is found by following the first k + 1 of
    /// them from the agent.
    pub fn stages(&self) -> &'static [Stage] {
        self.definition().stages
    }

    /// The static arrays of an episode, in the order in which they travel.
    pub fn statics(&self) -> Vec<StaticSpec> {
        (self.definition().statics)(self)
    }

    /// Landmarks [N, D].
    fn landmarks_spec(&self) -> StaticSpec {
        StaticSpec { name: LANDMARKS, shape: vec![self.agents, self.dims()] }
    }

    /// What an agent sees.
    pub fn observation(&self) -> Observation {
        self.definition().observation
    }

    /// Sizes of the arrays of a shard of B = `episodes` episodes.
    pub fn shape(&self, episodes: usize) -> Shape {
        let external = self.external().ok();
        Shape {
            steps: self.horizon as usize,
            episodes,
            agents: self.agents,
            bodies: self.agents + self.balls(),
            landmarks: self.agents,
            dims: self.dims(),
            agent_state: self.agent_state(),
            goals_per_agent: self.stages().len(),
            action_components: self.action_heads().len(),
            world_state: external.map_or(0, |external| external.state_width),
            moves: external.map_or(0, ExternalConfig::moves),
            masks: external.filter(|external| external.masks).map_or(0, |external| external.choices.iter().sum()),
            marks: usize::from(external.is_some()),
        }
    }

    /// Checks ranges; an error names the field and the remedy.
    pub fn validate(&self) -> Result<(), FieldError> {
        check_range("task.agents", self.agents, 1, AGENTS_MAX)?;
        if !(self.side.is_finite() && self.side > 0.0 && self.side <= 10_000.0) {
            return Err(FieldError::new("task.side", format!("{} must be a positive length up to 10000", self.side)));
        }
        check_range("task.horizon", self.horizon, 1, HORIZON_MAX)?;
        check_range("task.layout_scale", self.layout_scale, 0.01, 100.0)?;
        if self.integration != Integration::default() && self.name != TaskName::SimpleSpread {
            let problem = format!("position-first belongs to simple-spread; the task is {}; remove it", self.name);
            return Err(FieldError::new("task.integration", problem));
        }
        (self.definition().validate)(self)
    }

    /// SHA-256 of everything that decides what an episode is: both sides of a connection must agree on it.
    pub fn fingerprint(&self) -> String {
        // An episode's metrics travel as numbers in the order of this process's table.
        let metrics: Vec<&str> = METRICS.iter().map(|metric| metric.name).collect();
        sha256::hex(serde_json::to_string(&(TASK_SEMANTICS, metrics, self)).unwrap_or_default().as_bytes())
    }
}

/// Here rather than in the table, so that the table knows no task.
impl Metric {
    /// Whether a task has it.
    pub fn applies(&self, task: &TaskConfig) -> bool {
        match self.scope {
            Scope::EveryTask => true,
            Scope::Landmarks => task.name != TaskName::External,
            Scope::Success => task.external().map_or(true, |external| external.successes),
            Scope::External => task.name == TaskName::External,
            Scope::Crashes => task.definition().crashes,
            Scope::SecondStage => task.stages().len() > 1,
        }
    }
}

#[cfg(test)]
mod tests;
