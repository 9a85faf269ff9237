//! The drone task as data.

use super::{Observation, Spawn, TaskConfig, coefficients};
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

/// `[task.drones]`: physics and reward of the drone task.
/// r = progress · (d − d') + bonus · 1\[d' ≤ 0.15\] − crash · 1\[crashed now\] − proximity · max(0, 1 − d_min / proximity_radius)
/// − tilt · max(0, 1 − cos(tilt angle) / cos 45°).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DroneConfig {
    /// Physics and controller steps per second, a multiple of 30 (a command lasts 1/30 s).
    pub physics_hz: u32,
    /// Closest that drones, and landmarks, start to one another.
    pub spacing: f32,
    /// How a drone's wash presses on the drones below it.
    pub downwash: Downwash,
    /// Paid per metre of way made good.
    pub progress: f32,
    /// Paid on every step within 0.15 of the landmark.
    pub bonus: f32,
    /// Charged once for crashing.
    pub crash: f32,
    /// Charged per step at zero distance from another drone, less with the distance.
    pub proximity: f32,
    /// Distance from which proximity costs nothing, metres.
    pub proximity_radius: f32,
    /// Charged per step for a tilt of 90°, less with the angle, nothing up to 45°: a drone that is asked for too much tumbles.
    pub tilt: f32,
}

impl Default for DroneConfig {
    fn default() -> Self {
        Self {
            physics_hz: 120,
            spacing: 0.3,
            downwash: Downwash::Limited,
            progress: 2.0,
            bonus: 0.1,
            crash: 20.0,
            proximity: 3.0,
            proximity_radius: 0.3,
            tilt: 1.0,
        }
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

pub(super) fn observation() -> Observation {
    Observation {
        sensing_radius: 1.5,
        success_radius: 0.15,
        contact_radius: 0.12,
        encounters: true,
        out: Some(DroneConfig::AGENT_STATE - 1),
        ..Observation::default()
    }
}

pub(super) fn validate(task: &TaskConfig) -> Result<(), String> {
    let d = &task.drones;
    coefficients(
        "task.drones",
        &[
            ("progress", d.progress),
            ("bonus", d.bonus),
            ("crash", d.crash),
            ("proximity", d.proximity),
            ("tilt", d.tilt),
        ],
    )?;
    if task.spawn != Spawn::Uniform {
        return Err(format!("task.spawn: drones start uniform in the box, not on '{}'; use uniform", task.spawn));
    }
    if task.layout_scale != 1.0 {
        return Err(format!(
            "task.layout_scale: {} has no meaning for drones, who have no layouts; remove it",
            task.layout_scale
        ));
    }
    let slowest = (DroneConfig::RATE_LOOP / 2.0).ceil() as u32;
    if !(120..=1920).contains(&d.physics_hz) || !d.physics_hz.is_multiple_of(DroneConfig::COMMANDS_HZ) {
        return Err(format!(
            "task.drones.physics_hz: {} must be a multiple of {} in 120..=1920; at {slowest} and less the attitude controller \
             chatters",
            d.physics_hz,
            DroneConfig::COMMANDS_HZ
        ));
    }
    // Closer than a collision radius each, drones would start in contact.
    if !(d.spacing.is_finite() && (0.13..=10.0).contains(&d.spacing)) {
        return Err(format!("task.drones.spacing: {} is outside 0.13..=10", d.spacing));
    }
    if !(d.proximity_radius.is_finite() && d.proximity_radius > 0.0) {
        return Err(format!("task.drones.proximity_radius: {} must be positive", d.proximity_radius));
    }
    task.check_room("drones", task.agents, d.spacing)
}
