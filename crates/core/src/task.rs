//! What a task is, as data: size, horizon, spawn, reward, what is assigned to whom and what an agent sees. No physics.
//!
//! This is the list of tasks: a new one is a [`TaskName`] with its row in each `match` below, its physics in `magex-env`
//! and a configuration file. Everything between (networks, actors, learner, commander) reads the answers given here.

mod drones;
mod observation;
mod push_ball;
mod spawn;

use crate::metrics_table::METRICS;
use crate::trajectory::Shape;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

pub use drones::{Downwash, DroneConfig};
pub use observation::{Frame, Observation};
pub use push_ball::PushBallConfig;
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
}

impl std::fmt::Display for TaskName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::SimpleSpread => "simple-spread",
            Self::PushBall => "push-ball",
            Self::Drones => "drones",
        })
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

/// One assignment problem of an episode: every member of one group gets a member of another, for itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Stage {
    /// Who is assigned.
    pub from: Group,
    /// To whom.
    pub to: Group,
}

/// What the numbers of an action mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ActionCode {
    /// One component: 0 none, 1 +x, 2 −x, 3 +y, 4 −y.
    Thrust,
    /// One component per axis: 0 forward (+), 1 stop, 2 backward (−).
    PerAxis,
}

/// Coefficients of the executor's reward (paper, eq. 9):
/// r = bonus · 1[d ≤ 0.15] − distance · d / d_ref − collision · #{other agents closer than 0.2}.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RewardConfig {
    /// α: paid on every step on which the agent is within 0.15 of its goal (metric distance).
    pub bonus: f32,
    /// β: charged per unit of d / d_ref.
    pub distance: f32,
    /// γ: charged for every other agent closer than two radii.
    pub collision: f32,
    /// d_ref in world units; 0 means the side of the map.
    pub distance_unit: f32,
}

impl Default for RewardConfig {
    fn default() -> Self {
        Self { bonus: 1.0, distance: 1.0, collision: 1.0, distance_unit: 0.0 }
    }
}

/// A task, fully determined. Equal tasks have equal fingerprints. Written down without the sections of other tasks.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TaskConfig {
    /// Which task.
    pub name: TaskName,
    /// N: agents, and as many landmarks.
    pub agents: usize,
    /// Side of the square map in world units; 0 means the paper's (2, 6, 10 for N = 5, 20, 50) or √(2N), the density of N = 50.
    #[serde(default)]
    pub side: f32,
    /// Steps per episode; 0 means the paper's (60, 100, 120 for N = 5, 20, 50) or 20 + 10 · side, rounded up to tens.
    #[serde(default)]
    pub horizon: u32,
    /// Where agents and landmarks start.
    pub spawn: Spawn,
    /// Raw units of the layout files per world unit (layouts only); 0 means 1.5 for N ≤ 20 and 2 beyond.
    #[serde(default)]
    pub layout_scale: f32,
    /// Reward coefficients of Simple Spread.
    #[serde(default)]
    pub reward: RewardConfig,
    /// What only Push Ball has.
    #[serde(default)]
    pub push_ball: PushBallConfig,
    /// What only the drones have.
    #[serde(default)]
    pub drones: DroneConfig,
}

impl Serialize for TaskConfig {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        #[derive(Serialize)]
        struct Written<'a> {
            name: TaskName,
            agents: usize,
            side: f32,
            horizon: u32,
            spawn: Spawn,
            layout_scale: f32,
            #[serde(skip_serializing_if = "Option::is_none")]
            reward: Option<&'a RewardConfig>,
            #[serde(skip_serializing_if = "Option::is_none")]
            push_ball: Option<&'a PushBallConfig>,
            #[serde(skip_serializing_if = "Option::is_none")]
            drones: Option<&'a DroneConfig>,
        }
        Written {
            name: self.name,
            agents: self.agents,
            side: self.side,
            horizon: self.horizon,
            spawn: self.spawn,
            layout_scale: self.layout_scale,
            reward: (self.name == TaskName::SimpleSpread).then_some(&self.reward),
            push_ball: (self.name == TaskName::PushBall).then_some(&self.push_ball),
            drones: (self.name == TaskName::Drones).then_some(&self.drones),
        }
        .serialize(serializer)
    }
}

/// Changes whenever the physics, the spawn, the reward or the observation change their meaning: part of the fingerprint.
pub const TASK_SEMANTICS: u32 = 2;

impl TaskConfig {
    /// Simple Spread with the paper's sizes for N agents.
    pub fn simple_spread(agents: usize, spawn: Spawn) -> Self {
        Self::of(TaskName::SimpleSpread, agents, spawn)
    }

    /// A task with the paper's sizes for N agents.
    pub fn of(name: TaskName, agents: usize, spawn: Spawn) -> Self {
        Self {
            name,
            agents,
            side: 0.0,
            horizon: 0,
            spawn,
            layout_scale: 0.0,
            reward: RewardConfig::default(),
            push_ball: PushBallConfig::default(),
            drones: DroneConfig::default(),
        }
        .resolved()
    }

    /// The same task with every "0 means default" replaced by its value.
    pub fn resolved(mut self) -> Self {
        let n = self.agents as f32;
        let tens = |steps: f32| (steps / 10.0).ceil() as u32 * 10;
        if self.side == 0.0 {
            self.side = match (self.name, self.agents) {
                (TaskName::SimpleSpread, 5) => 2.0,
                (TaskName::SimpleSpread, 20) => 6.0,
                (TaskName::SimpleSpread, 50) => 10.0,
                (TaskName::SimpleSpread, _) => (2.0 * n).sqrt(),
                (TaskName::PushBall, 5) => 4.0,
                (TaskName::PushBall, 20) => 12.0,
                (TaskName::PushBall, _) => (7.2 * n).sqrt(),
                (TaskName::Drones, _) => 3.0,
            };
        }
        if self.horizon == 0 {
            self.horizon = match (self.name, self.agents) {
                (TaskName::SimpleSpread, 5) => 60,
                (TaskName::SimpleSpread, 20) => 100,
                (TaskName::SimpleSpread, 50) => 120,
                (TaskName::SimpleSpread, _) => tens(20.0 + 10.0 * self.side),
                (TaskName::PushBall, 5) => 100,
                (TaskName::PushBall, 20) => 200,
                (TaskName::PushBall, _) => tens(20.0 + 15.0 * self.side),
                (TaskName::Drones, _) => 120,
            };
        }
        if self.layout_scale == 0.0 {
            self.layout_scale = match self.name {
                TaskName::PushBall => 0.5,
                TaskName::Drones => 1.0,
                _ if self.agents <= 20 => 1.5,
                _ => 2.0,
            };
        }
        if self.reward.distance_unit == 0.0 {
            self.reward.distance_unit = self.side;
        }
        self
    }

    /// D: space dimensions of positions.
    pub fn dims(&self) -> usize {
        match self.name {
            TaskName::SimpleSpread | TaskName::PushBall => 2,
            TaskName::Drones => 3,
        }
    }

    /// Moving bodies that are not agents.
    pub fn balls(&self) -> usize {
        if self.name == TaskName::PushBall { self.agents } else { 0 }
    }

    /// X: further numbers of an agent's state that an agent sees and the wire carries.
    pub fn agent_state(&self) -> usize {
        if self.name == TaskName::Drones { DroneConfig::AGENT_STATE } else { 0 }
    }

    /// Choices of each action component.
    pub fn action_heads(&self) -> Vec<usize> {
        match self.action_code() {
            ActionCode::Thrust => vec![5],
            ActionCode::PerAxis => vec![3; self.dims()],
        }
    }

    /// What the numbers of an action mean.
    pub fn action_code(&self) -> ActionCode {
        match self.name {
            TaskName::SimpleSpread | TaskName::PushBall => ActionCode::Thrust,
            TaskName::Drones => ActionCode::PerAxis,
        }
    }

    /// The assignment problems of an episode, in order. The k-th goal of an agent is found by following the first k + 1 of
    /// them from the agent.
    pub fn stages(&self) -> &'static [Stage] {
        match self.name {
            TaskName::SimpleSpread | TaskName::Drones => &[Stage { from: Group::Agents, to: Group::Landmarks }],
            TaskName::PushBall => {
                &[Stage { from: Group::Agents, to: Group::Balls }, Stage { from: Group::Balls, to: Group::Landmarks }]
            }
        }
    }

    /// What an agent sees.
    pub fn observation(&self) -> Observation {
        match self.name {
            TaskName::SimpleSpread => Observation::default(),
            TaskName::PushBall => push_ball::observation(),
            TaskName::Drones => drones::observation(),
        }
    }

    /// Sizes of the arrays of a shard of so many episodes.
    pub fn shape(&self, episodes: usize) -> Shape {
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
        }
    }

    /// Checks ranges; `Err` names the field and the remedy.
    pub fn validate(&self) -> Result<(), String> {
        if !(1..=5000).contains(&self.agents) {
            return Err(format!("task.agents: {} is outside 1..=5000", self.agents));
        }
        if !(self.side.is_finite() && self.side > 0.0 && self.side <= 10_000.0) {
            return Err(format!("task.side: {} must be a positive length up to 10000", self.side));
        }
        if !(1..=100_000).contains(&self.horizon) {
            return Err(format!("task.horizon: {} is outside 1..=100000", self.horizon));
        }
        if !(self.layout_scale.is_finite() && (0.01..=100.0).contains(&self.layout_scale)) {
            return Err(format!("task.layout_scale: {} is outside 0.01..=100", self.layout_scale));
        }
        self.refuse_settings_of_other_tasks()?;
        match self.name {
            TaskName::SimpleSpread => {
                let r = &self.reward;
                coefficients(
                    "task.reward",
                    &[("bonus", r.bonus), ("distance", r.distance), ("collision", r.collision)],
                )?;
                if !(r.distance_unit.is_finite() && r.distance_unit > 0.0) {
                    return Err(format!("task.reward.distance_unit: {} must be positive", r.distance_unit));
                }
                if self.spawn == Spawn::Uniform {
                    self.check_room("agents", self.agents, 0.2)?;
                }
                Ok(())
            }
            TaskName::PushBall => push_ball::validate(self),
            TaskName::Drones => drones::validate(self),
        }
    }

    /// Random sequential placement of discs jams near 0.547 of the area; half of that is quick to sample.
    fn check_room(&self, what: &str, count: usize, spacing: f32) -> Result<(), String> {
        let discs = count as f32 * std::f32::consts::PI * (spacing / 2.0).powi(2);
        if discs > 0.27 * self.side * self.side {
            return Err(format!(
                "task.side: {count} {what} do not fit a side of {} at a spacing of {spacing}; use a side of at least {:.2}",
                self.side,
                (discs / 0.27).sqrt()
            ));
        }
        Ok(())
    }

    /// A setting that this task does not read would look as if it did something.
    fn refuse_settings_of_other_tasks(&self) -> Result<(), String> {
        // The unit of distance follows the side by itself.
        let reward = RewardConfig { distance_unit: self.reward.distance_unit, ..RewardConfig::default() };
        for (section, owner, untouched) in [
            ("task.reward", TaskName::SimpleSpread, self.reward == reward),
            ("task.push_ball", TaskName::PushBall, self.push_ball == PushBallConfig::default()),
            ("task.drones", TaskName::Drones, self.drones == DroneConfig::default()),
        ] {
            if owner != self.name && !untouched {
                return Err(format!("{section}: belongs to {owner}, the task is {}; remove it", self.name));
            }
        }
        Ok(())
    }

    /// SHA-256 of everything that decides what an episode is: both sides of a connection must agree on it.
    pub fn fingerprint(&self) -> String {
        // An episode's metrics travel as numbers in the order of this process's table.
        let metrics: Vec<&str> = METRICS.iter().map(|metric| metric.name).collect();
        let text = serde_json::to_string(&(TASK_SEMANTICS, metrics, self)).unwrap_or_default();
        Sha256::digest(text.as_bytes()).iter().map(|byte| format!("{byte:02x}")).collect()
    }
}

/// Ranges of reward coefficients.
fn coefficients(section: &str, values: &[(&str, f32)]) -> Result<(), String> {
    match values.iter().find(|(_, value)| !(value.is_finite() && (0.0..=1000.0).contains(value))) {
        Some((name, value)) => Err(format!("{section}.{name}: {value} is outside 0..=1000")),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_paper_sizes_are_the_defaults() {
        for (n, side, horizon) in [(5, 2.0, 60), (20, 6.0, 100), (50, 10.0, 120)] {
            let task = TaskConfig::simple_spread(n, Spawn::Uniform);
            assert_eq!((task.side, task.horizon), (side, horizon));
            task.validate().unwrap();
        }
        assert_eq!(TaskConfig::simple_spread(200, Spawn::Uniform).horizon, 220);
    }

    #[test]
    fn every_task_has_the_sizes_of_the_paper_and_refuses_the_settings_of_others() {
        let sizes = |name, agents| {
            let task = TaskConfig::of(name, agents, Spawn::Uniform);
            task.validate().unwrap();
            (task.side, task.horizon)
        };
        assert_eq!([sizes(TaskName::PushBall, 5), sizes(TaskName::PushBall, 20)], [(4.0, 100), (12.0, 200)]);
        assert_eq!([sizes(TaskName::Drones, 2), sizes(TaskName::Drones, 4)], [(3.0, 120), (3.0, 120)]);
        for name in [TaskName::SimpleSpread, TaskName::PushBall, TaskName::Drones] {
            let task = TaskConfig::of(name, 4, Spawn::Uniform);
            let back: TaskConfig = serde_json::from_str(&serde_json::to_string(&task).unwrap()).unwrap();
            assert_eq!(back.resolved(), task);
            assert_eq!(task.shape(3).goals_per_agent, task.stages().len());
            let mut other = task.clone();
            (other.reward.bonus, other.push_ball.turn_length, other.drones.bonus) = (0.5, 0.5, 0.5);
            let error = other.validate().unwrap_err();
            assert!(error.contains("belongs to") && error.contains(&name.to_string()), "{error}");
        }
    }

    #[test]
    fn drones_that_do_not_fit_or_cannot_be_controlled_are_refused_with_the_remedy() {
        let refused = |change: fn(&mut TaskConfig), words: &str| {
            let mut task = TaskConfig::of(TaskName::Drones, 4, Spawn::Uniform);
            change(&mut task);
            let error = task.validate().unwrap_err();
            assert!(error.contains(words), "{error}");
        };
        refused(|t| t.agents = 60, "use a side of at least");
        refused(|t| t.side = 0.5, "use a side of at least");
        refused(|t| t.drones.spacing = 0.1, "task.drones.spacing");
        refused(|t| t.drones.physics_hz = 90, "attitude controller");
        refused(|t| t.drones.physics_hz = 130, "multiple of 30");
        refused(|t| t.spawn = Spawn::Lines(None), "use uniform");
        refused(|t| t.drones.crash = -1.0, "task.drones.crash");
    }

    #[test]
    fn spawn_names_round_trip_and_unknown_ones_are_named() {
        for name in ["uniform", "lines", "lines-3", "authors", "authors-0"] {
            assert_eq!(String::from(name.parse::<Spawn>().unwrap()), name);
        }
        for name in ["ring", "lines-4", "", "lines3"] {
            assert!(name.parse::<Spawn>().unwrap_err().contains("task.spawn"), "{name}");
        }
    }

    #[test]
    fn the_fingerprint_sees_every_field() {
        let base = TaskConfig::simple_spread(20, Spawn::Lines(None));
        let mut other = base.clone();
        other.reward.collision = 0.5;
        assert_ne!(base.fingerprint(), other.fingerprint());
        assert_eq!(base.fingerprint(), base.clone().fingerprint());
    }

    #[test]
    fn a_box_that_is_too_small_is_refused_with_a_remedy() {
        let mut task = TaskConfig::simple_spread(50, Spawn::Uniform);
        task.side = 1.0;
        assert!(task.validate().unwrap_err().contains("use a side of at least"));
    }
}
