//! Push Ball as data.

use super::{Frame, Observation, Spawn, TaskConfig, coefficients};
use serde::{Deserialize, Serialize};

/// `[task.push_ball]`: reward and training of Push Ball. With Φ = −(path + 2 · d_bl), path = max(0, d_ab − 0.25) + turn_length · θ ·
/// min(1, d_bl / 0.3), d_ab the distance agent–ball, d_bl ball–landmark, θ the angle between the two legs:
/// r = progress · (Φ' − Φ) + bonus · 1\[d_bl ≤ 0.3\] − distance · (d_ab + d_bl).
///
/// The authors' reward is progress = 0, bonus = 1, distance = 1.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PushBallConfig {
    /// Paid per unit of way made good.
    pub progress: f32,
    /// World units per radian that the ball must be walked around.
    pub turn_length: f32,
    /// Paid on every step on which the ball is within 0.3 of its landmark.
    pub bonus: f32,
    /// Charged per unit of distance left, on every step.
    pub distance: f32,
    /// Share of the training episodes in which agents start exactly in line with their balls, on the landmarks' side: starts
    /// that random positions never show, and fixed layouts do.
    pub start_in_line_fraction: f32,
}

impl PushBallConfig {
    /// Radius of an agent.
    pub const AGENT_RADIUS: f64 = 0.1;
    /// Radius of a ball.
    pub const BALL_RADIUS: f64 = 0.15;
    /// An agent touches a ball when their centres are this close.
    pub const PUSH_DISTANCE: f64 = Self::AGENT_RADIUS + Self::BALL_RADIUS;
}

impl Default for PushBallConfig {
    fn default() -> Self {
        Self { progress: 2.0, turn_length: 0.25, bonus: 0.1, distance: 0.0, start_in_line_fraction: 0.3 }
    }
}

/// Closest that balls, and landmarks, start to one another.
const SPACING: f32 = 0.3;

pub(super) fn observation() -> Observation {
    Observation { sensing_radius: 1.5, success_radius: 0.3, frame: Frame::Push, ..Observation::default() }
}

pub(super) fn validate(task: &TaskConfig) -> Result<(), String> {
    let p = &task.push_ball;
    coefficients(
        "task.push_ball",
        &[("progress", p.progress), ("turn_length", p.turn_length), ("bonus", p.bonus), ("distance", p.distance)],
    )?;
    if !(0.0..=1.0).contains(&p.start_in_line_fraction) {
        return Err(format!("task.push_ball.start_in_line_fraction: {} is outside 0..=1", p.start_in_line_fraction));
    }
    // The balls of the authors' layouts, on their longest line, in raw units apart.
    let gap = match task.agents {
        20 => 6.0 / 19.0,
        50 => 12.0 / 49.0,
        // Other sizes are scaled to fit.
        _ => f32::INFINITY,
    };
    if task.spawn != Spawn::Uniform && gap / task.layout_scale < SPACING {
        return Err(format!(
            "task.layout_scale: {} puts the balls of the layouts {:.2} apart, closer than {SPACING}; use at most {:.2}",
            task.layout_scale,
            gap / task.layout_scale,
            gap / SPACING
        ));
    }
    if task.spawn == Spawn::Uniform {
        // Agents keep 0.25 from balls and 0.2 from each other: together they need little more room than twice the balls.
        task.check_room("balls with as many agents", 2 * task.agents, SPACING)?;
    }
    Ok(())
}
