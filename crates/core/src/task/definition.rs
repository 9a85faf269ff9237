//! What a task has to say about itself: one value per task, from which everything else is derived.

use super::{ActionCode, Bounds, Observation, Stage, TaskConfig, TaskName, TaskSettings};
use crate::error::FieldError;
use crate::statics::StaticSpec;

/// A task. Its file (`task/<name>.rs`) holds this value, the task's own settings and their validation.
pub struct Definition {
    /// Name for people.
    pub title: &'static str,
    /// Key of the task's own settings: `[task.<section>]`.
    pub(super) section: &'static str,
    /// D: space dimensions of positions.
    pub(super) dims: usize,
    /// Whether there is a ball for every agent among the moving bodies.
    pub(super) has_balls: bool,
    /// X: further numbers of an agent's state.
    pub(super) agent_state: usize,
    /// Whether agents can crash and then are out of the episode.
    pub crashes: bool,
    pub(super) action_code: ActionCode,
    /// Assignment problems of an episode, in order.
    pub(super) stages: &'static [Stage],
    pub(super) statics: fn(&TaskConfig) -> Vec<StaticSpec>,
    pub(super) observation: Observation,
    /// Radius that a landmark is drawn with, world units.
    pub landmark_radius: f32,
    /// Seconds per joint step.
    pub step_seconds: f32,
    /// Default side of the map for N agents, world units.
    pub(super) side: fn(usize) -> f32,
    /// Default steps per episode for N agents and a side.
    pub(super) horizon: fn(usize, f32) -> u32,
    /// Default raw units of the layouts per world unit for N agents.
    pub(super) layout_scale: fn(usize) -> f32,
    /// The task's own settings for a side.
    pub(super) default_settings: fn(f32) -> TaskSettings,
    /// The same with the keys of `[task.<section>]`.
    pub(super) read_settings: fn(f32, toml::Table) -> Result<TaskSettings, FieldError>,
    /// What the states of an episode can be.
    pub(super) bounds: fn(&TaskConfig) -> Bounds,
    /// Smallest and largest reward of an agent in a step, for a largest distance between any two points.
    pub(super) reward_range: fn(&TaskConfig, f32) -> [f32; 2],
    /// Checks the ranges of what the task does not share with others.
    pub(super) validate: fn(&TaskConfig) -> Result<(), FieldError>,
}

pub(super) fn up_to_tens(steps: f32) -> u32 {
    (steps / 10.0).ceil() as u32 * 10
}

/// A task whose settings are those of another one.
pub(super) fn wrong_task(task: &TaskConfig, wanted: TaskName) -> FieldError {
    FieldError::new("task.name", format!("{} is not {wanted}", task.name))
}

/// Random sequential placement of discs jams near 0.547 of the area; half of that is quick to sample.
pub(super) fn fits(task: &TaskConfig, what: &str, count: usize, spacing: f32) -> Result<(), FieldError> {
    let discs = count as f32 * std::f32::consts::PI * (spacing / 2.0).powi(2);
    if discs > 0.27 * task.side * task.side {
        let problem = format!(
            "{count} {what} do not fit a side of {} at a spacing of {spacing}; use a side of at least {:.2}",
            task.side,
            (discs / 0.27).sqrt()
        );
        return Err(FieldError::new("task.side", problem));
    }
    Ok(())
}
