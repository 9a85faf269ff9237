//! Simple Spread (paper, section 5.1.1) as data.

use super::bounds;
use super::definition::{Definition, fits, up_to_tens, wrong_task};
use super::{ActionCode, Group, Observation, Spawn, Stage, TaskConfig, TaskName, TaskSettings};
use crate::error::FieldError;
use crate::section::section;
use crate::toml_table;

section! {
    /// `[task.reward]`: coefficients of the reward (paper, eq. 5):
    /// r = bonus · 1[d ≤ 0.15] − distance · d / d_ref − collision · #{other agents closer than 0.2}.
    #[derive(Copy)]
    RewardConfig {
        /// α: paid on every step on which the agent is within 0.15 of its goal (metric distance).
        bonus: f32 = 1.0, 0.0..=1000.0;
        /// β: charged per unit of d / d_ref.
        distance: f32 = 1.0, 0.0..=1000.0;
        /// γ: charged for every other agent closer than two radii.
        collision: f32 = 1.0, 0.0..=1000.0;
        /// d_ref in world units. Default: the side of the map.
        distance_unit: f32 = 1.0;
    }
}

pub(super) const DEFINITION: Definition = Definition {
    title: "Simple Spread",
    section: "reward",
    dims: 2,
    has_balls: false,
    agent_state: 0,
    crashes: false,
    action_code: ActionCode::Thrust,
    stages: &[Stage { from: Group::Agents, to: Group::Landmarks }],
    statics: |task| vec![task.landmarks_spec()],
    observation: Observation::SIMPLE_SPREAD,
    landmark_radius: 0.05,
    step_seconds: 0.1,
    side: |agents| match agents {
        5 => 2.0,
        20 => 6.0,
        50 => 10.0,
        n => (2.0 * n as f32).sqrt(),
    },
    horizon: |agents, side| match agents {
        5 => 60,
        20 => 100,
        50 => 120,
        _ => up_to_tens(20.0 + 10.0 * side),
    },
    layout_scale: |agents| if agents <= 20 { 1.5 } else { 2.0 },
    default_settings: |side| {
        TaskSettings::SimpleSpread(RewardConfig { distance_unit: side, ..RewardConfig::default() })
    },
    read_settings: |side, mut section| {
        let given = section.contains_key("distance_unit");
        section.entry("distance_unit").or_insert_with(|| f64::from(side).into());
        let reward: RewardConfig = toml_table::read("task.reward", section, RewardConfig::bounds)?;
        if given && reward.distance_unit == 0.0 {
            return Err(FieldError::new("task.reward.distance_unit", super::NOT_ZERO));
        }
        Ok(TaskSettings::SimpleSpread(reward))
    },
    bounds: |task| bounds::of_particles(task, task.agents),
    reward_range: |task, extent| match task.reward() {
        Ok(r) => [-(r.distance / r.distance_unit * extent + r.collision * task.agents as f32), r.bonus],
        Err(_) => [f32::MIN, f32::MAX],
    },
    validate,
};

fn validate(task: &TaskConfig) -> Result<(), FieldError> {
    let r = task.reward()?;
    r.check_ranges("task.reward")?;
    if !(r.distance_unit.is_finite() && r.distance_unit > 0.0) {
        return Err(FieldError::new("task.reward.distance_unit", format!("{} must be positive", r.distance_unit)));
    }
    if task.spawn == Spawn::Uniform { fits(task, "agents", task.agents, 0.2) } else { Ok(()) }
}

impl TaskConfig {
    /// Simple Spread with the paper's sizes for N agents.
    pub fn simple_spread(agents: usize, spawn: Spawn) -> Self {
        Self::of(TaskName::SimpleSpread, agents, spawn)
    }

    /// What only Simple Spread has; an error in any other task.
    pub fn reward(&self) -> Result<&RewardConfig, FieldError> {
        match &self.settings {
            TaskSettings::SimpleSpread(reward) => Ok(reward),
            _ => Err(wrong_task(self, TaskName::SimpleSpread)),
        }
    }
}

/// A unit of distance that was the side of the map stays the side of the map.
pub(super) fn follow_side(settings: &mut TaskSettings, from: f32, to: f32) {
    if let TaskSettings::SimpleSpread(reward) = settings
        && reward.distance_unit == from
    {
        reward.distance_unit = to;
    }
}
