//! The drone task as data.

use super::bounds;
use super::definition::{Definition, fits, wrong_task};
use super::{ActionCode, Bounds, Group, Observation, Spawn, Stage, TaskConfig, TaskName, TaskSettings};
use crate::error::FieldError;
use crate::section::section;
use crate::toml_table;
use serde::{Deserialize, Serialize};

/// How a drone's wash presses on the drones below it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Downwash {
    /// The reference law, no stronger than the weight of the drone above.
    #[default]
    Limited,
    /// The reference law, which grows beyond all bounds as the difference in height goes to zero.
    Reference,
    /// None.
    Off,
}

section! {
    /// `[task.drones]`: physics and reward of the drone task.
    /// r = progress · (d − d') + bonus · 1\[d' ≤ 0.15\] − crash · 1\[crashed now\] − proximity · max(0, 1 − d_min / proximity_radius)
    /// − tilt · max(0, 1 − cos(tilt angle) / cos 45°).
    #[derive(Copy)]
    DroneConfig {
        /// Physics and controller steps per second, a multiple of 30 (a command lasts 1/30 s).
        physics_hz: u32 = 120;
        /// Closest that drones, and landmarks, start to one another: nearer, they would start in contact.
        spacing: f32 = 0.3, 0.13..=10.0;
        /// How a drone's wash presses on the drones below it.
        downwash: Downwash = Downwash::Limited;
        /// Paid per metre of way made good.
        progress: f32 = 2.0, 0.0..=1000.0;
        /// Paid on every step within 0.15 of the landmark.
        bonus: f32 = 0.1, 0.0..=1000.0;
        /// Charged once for crashing.
        crash: f32 = 20.0, 0.0..=1000.0;
        /// Charged per step at zero distance from another drone, less with the distance.
        proximity: f32 = 3.0, 0.0..=1000.0;
        /// Distance from which proximity costs nothing, metres.
        proximity_radius: f32 = 0.3;
        /// Charged per step for a tilt of 90°, less with the angle, nothing up to 45°: a drone that is asked for too much tumbles.
        tilt: f32 = 1.0, 0.0..=1000.0;
    }
}

impl DroneConfig {
    /// Target velocity (3), x and y of the body's up axis (2), out of the episode (1).
    pub const AGENT_STATE: usize = 6;
    /// Commands per second.
    pub const COMMANDS_HZ: u32 = 30;
    /// Gain of the attitude controller's rate loop, per second: at one call per physics step it chatters where the gain
    /// exceeds twice the rate.
    const RATE_LOOP: f32 = 196.0;
}

pub(super) const DEFINITION: Definition = Definition {
    title: "Drones",
    section: "drones",
    dims: 3,
    has_balls: false,
    agent_state: DroneConfig::AGENT_STATE,
    crashes: true,
    action_code: ActionCode::PerAxis,
    stages: &[Stage { from: Group::Agents, to: Group::Landmarks }],
    statics: |task| vec![task.landmarks_spec()],
    observation: Observation {
        sensing_radius: 1.5,
        success_radius: 0.15,
        contact_radius: 0.12,
        encounters: true,
        out: Some(DroneConfig::AGENT_STATE - 1),
        ..Observation::SIMPLE_SPREAD
    },
    landmark_radius: 0.03,
    step_seconds: 1.0 / DroneConfig::COMMANDS_HZ as f32,
    side: |_| 3.0,
    horizon: |_, _| 120,
    layout_scale: |_| 1.0,
    default_settings: |_| TaskSettings::Drones(DroneConfig::default()),
    read_settings: |_, section| toml_table::read("task.drones", section, DroneConfig::bounds).map(TaskSettings::Drones),
    // Contacts and the unlimited wash can throw a drone, but not at a hundred times the speed of sound.
    bounds: |task| {
        let velocity = 34_000.0;
        let seconds = task.horizon as f32 / DroneConfig::COMMANDS_HZ as f32;
        Bounds { position: bounds::start(task) + velocity * seconds, velocity, agent_state: 10.0 }
    },
    reward_range: |task, extent| match task.drones() {
        // 1 − cos(tilt angle) / cos 45° is at most 1 + √2.
        Ok(d) => {
            let way = d.progress * extent;
            [-(way + d.crash + d.proximity + d.tilt * (1.0 + std::f32::consts::SQRT_2)), way + d.bonus]
        }
        Err(_) => [f32::MIN, f32::MAX],
    },
    validate,
};

impl TaskConfig {
    /// What only the drones have; an error in any other task.
    pub fn drones(&self) -> Result<&DroneConfig, FieldError> {
        match &self.settings {
            TaskSettings::Drones(settings) => Ok(settings),
            _ => Err(wrong_task(self, TaskName::Drones)),
        }
    }
}

fn validate(task: &TaskConfig) -> Result<(), FieldError> {
    let d = task.drones()?;
    d.check_ranges("task.drones")?;
    if task.spawn != Spawn::Uniform {
        let problem = format!("drones start uniform in the box, not on '{}'; use uniform", task.spawn);
        return Err(FieldError::new("task.spawn", problem));
    }
    if task.layout_scale != 1.0 {
        let problem = format!("{} has no meaning for drones, which have no layouts; remove it", task.layout_scale);
        return Err(FieldError::new("task.layout_scale", problem));
    }
    let slowest = (DroneConfig::RATE_LOOP / 2.0).ceil() as u32;
    if !(120..=1920).contains(&d.physics_hz) || !d.physics_hz.is_multiple_of(DroneConfig::COMMANDS_HZ) {
        let problem = format!(
            "{} must be a multiple of {} in 120..=1920; at {slowest} and less the attitude controller chatters",
            d.physics_hz,
            DroneConfig::COMMANDS_HZ
        );
        return Err(FieldError::new("task.drones.physics_hz", problem));
    }
    if !(d.proximity_radius.is_finite() && d.proximity_radius > 0.0) {
        return Err(FieldError::new(
            "task.drones.proximity_radius",
            format!("{} must be positive", d.proximity_radius),
        ));
    }
    fits(task, "drones", task.agents, d.spacing)
}
