//! What a task is, as data: size, horizon, spawn, reward. No physics.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// Which task. The list grows with `magex-env`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TaskName {
    /// Simple Spread (paper, section 5.1.1).
    SimpleSpread,
}

/// Where agents and landmarks start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Spawn {
    /// Uniform in the box, with a minimum spacing.
    Uniform,
    /// Random positions on the lines of the paper's four layouts (fig. 3b), one layout drawn per episode, or a fixed one.
    Lines(Option<u8>),
    /// The fixed points of the authors' files, one layout drawn per episode, or a fixed one.
    Authors(Option<u8>),
}

impl TryFrom<String> for Spawn {
    type Error = String;
    fn try_from(text: String) -> Result<Self, String> {
        let unknown = || {
            format!("task.spawn: unknown spawn mode '{text}'; use uniform, lines, lines-0..3, authors or authors-0..3")
        };
        let layout = |suffix: &str| match suffix {
            "" => Ok(None),
            "-0" => Ok(Some(0)),
            "-1" => Ok(Some(1)),
            "-2" => Ok(Some(2)),
            "-3" => Ok(Some(3)),
            _ => Err(unknown()),
        };
        if text == "uniform" {
            Ok(Self::Uniform)
        } else if let Some(rest) = text.strip_prefix("lines") {
            layout(rest).map(Self::Lines)
        } else if let Some(rest) = text.strip_prefix("authors") {
            layout(rest).map(Self::Authors)
        } else {
            Err(unknown())
        }
    }
}

impl std::str::FromStr for Spawn {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        Self::try_from(text.to_owned())
    }
}

impl From<Spawn> for String {
    fn from(spawn: Spawn) -> Self {
        let suffix = |layout: Option<u8>| layout.map(|k| format!("-{k}")).unwrap_or_default();
        match spawn {
            Spawn::Uniform => "uniform".into(),
            Spawn::Lines(layout) => format!("lines{}", suffix(layout)),
            Spawn::Authors(layout) => format!("authors{}", suffix(layout)),
        }
    }
}

impl std::fmt::Display for Spawn {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&String::from(*self))
    }
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

/// A task, fully determined. Equal tasks have equal fingerprints.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
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
    /// Reward coefficients.
    #[serde(default)]
    pub reward: RewardConfig,
}

/// Changes whenever the physics, the spawn or the reward change their meaning: part of the fingerprint.
pub const TASK_SEMANTICS: u32 = 1;

impl TaskConfig {
    /// Simple Spread with the paper's sizes for N agents.
    pub fn simple_spread(agents: usize, spawn: Spawn) -> Self {
        Self {
            name: TaskName::SimpleSpread,
            agents,
            side: 0.0,
            horizon: 0,
            spawn,
            layout_scale: 0.0,
            reward: RewardConfig::default(),
        }
        .resolved()
    }

    /// The same task with every "0 means default" replaced by its value.
    pub fn resolved(mut self) -> Self {
        if self.side == 0.0 {
            self.side = match self.agents {
                5 => 2.0,
                20 => 6.0,
                50 => 10.0,
                n => (2.0 * n as f32).sqrt(),
            };
        }
        if self.horizon == 0 {
            self.horizon = match self.agents {
                5 => 60,
                20 => 100,
                50 => 120,
                _ => ((20.0 + 10.0 * self.side) / 10.0).ceil() as u32 * 10,
            };
        }
        if self.layout_scale == 0.0 {
            self.layout_scale = if self.agents <= 20 { 1.5 } else { 2.0 };
        }
        if self.reward.distance_unit == 0.0 {
            self.reward.distance_unit = self.side;
        }
        self
    }

    /// Space dimensions of positions.
    pub fn dims(&self) -> usize {
        match self.name {
            TaskName::SimpleSpread => 2,
        }
    }

    /// Choices of each action component.
    pub fn action_heads(&self) -> Vec<usize> {
        match self.name {
            TaskName::SimpleSpread => vec![5],
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
        if !(self.layout_scale.is_finite() && self.layout_scale > 0.0) {
            return Err(format!("task.layout_scale: {} must be positive", self.layout_scale));
        }
        let r = &self.reward;
        for (name, value) in [("bonus", r.bonus), ("distance", r.distance), ("collision", r.collision)] {
            if !(value.is_finite() && (0.0..=1000.0).contains(&value)) {
                return Err(format!("task.reward.{name}: {value} is outside 0..=1000"));
            }
        }
        if !(r.distance_unit.is_finite() && r.distance_unit > 0.0) {
            return Err(format!("task.reward.distance_unit: {} must be positive", r.distance_unit));
        }
        if self.spawn == Spawn::Uniform {
            // Random sequential placement of discs jams near 0.547 of the area; half of that is quick to sample.
            let discs = self.agents as f32 * std::f32::consts::PI * 0.1 * 0.1;
            if discs > 0.27 * self.side * self.side {
                return Err(format!(
                    "task.side: {} agents do not fit a side of {} without overlap; use a side of at least {:.2}",
                    self.agents,
                    self.side,
                    (discs / 0.27).sqrt()
                ));
            }
        }
        Ok(())
    }

    /// SHA-256 of everything that decides what an episode is: both sides of a connection must agree on it.
    pub fn fingerprint(&self) -> String {
        let text = serde_json::to_string(&(TASK_SEMANTICS, self)).unwrap_or_default();
        Sha256::digest(text.as_bytes()).iter().map(|byte| format!("{byte:02x}")).collect()
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
