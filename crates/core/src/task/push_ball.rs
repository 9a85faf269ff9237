//! Push Ball as data.

use super::bounds;
use super::definition::{Definition, fits, up_to_tens, wrong_task};
use super::{ActionCode, Frame, Group, Observation, Spawn, Stage, TaskConfig, TaskName, TaskSettings};
use crate::error::FieldError;
use crate::section::section;
use crate::toml_table;

section! {
    /// `[task.push_ball]`: reward and training of Push Ball. With Φ = −(path + 2 · d_bl), path = max(0, d_ab − 0.25) + turn_length · θ ·
    /// min(1, d_bl / 0.3), d_ab the distance agent–ball, d_bl ball–landmark, θ the angle between the two legs:
    /// r = progress · (Φ' − Φ) + bonus · 1\[d_bl ≤ 0.3\] − distance · (d_ab + d_bl).
    ///
    /// The authors' reward is progress = 0, bonus = 1, distance = 1.
    #[derive(Copy)]
    PushBallConfig {
        /// Paid per unit of way made good.
        progress: f32 = 2.0, 0.0..=1000.0;
        /// World units per radian that the ball must be walked around.
        turn_length: f32 = 0.25, 0.0..=1000.0;
        /// Paid on every step on which the ball is within 0.3 of its landmark.
        bonus: f32 = 0.1, 0.0..=1000.0;
        /// Charged per unit of distance left, on every step.
        distance: f32 = 0.0, 0.0..=1000.0;
        /// Share of the training episodes in which agents start exactly in line with their balls, on the landmarks' side: starts
        /// that random positions never show, and fixed layouts do.
        start_in_line_fraction: f32 = 0.3, 0.0..=1.0;
    }
}

impl PushBallConfig {
    /// Radius of an agent.
    pub const AGENT_RADIUS: f64 = 0.1;
    /// Radius of a ball.
    pub const BALL_RADIUS: f64 = 0.15;
    /// An agent touches a ball when their centres are this close.
    pub const PUSH_DISTANCE: f64 = Self::AGENT_RADIUS + Self::BALL_RADIUS;
}

/// Closest that balls, and landmarks, start to one another.
const SPACING: f32 = 0.3;

pub(super) const DEFINITION: Definition = Definition {
    title: "Push Ball",
    section: "push_ball",
    dims: 2,
    has_balls: true,
    agent_state: 0,
    crashes: false,
    action_code: ActionCode::Thrust,
    stages: &[Stage { from: Group::Agents, to: Group::Balls }, Stage { from: Group::Balls, to: Group::Landmarks }],
    statics: |task| vec![task.landmarks_spec()],
    observation: Observation {
        sensing_radius: 1.5,
        success_radius: 0.3,
        frame: Frame::Push,
        ..Observation::SIMPLE_SPREAD
    },
    landmark_radius: 0.15,
    step_seconds: 0.1,
    side: |agents| match agents {
        5 => 4.0,
        20 => 12.0,
        n => (7.2 * n as f32).sqrt(),
    },
    horizon: |agents, side| match agents {
        5 => 100,
        20 => 200,
        _ => up_to_tens(20.0 + 15.0 * side),
    },
    layout_scale: |_| 0.5,
    default_settings: |_| TaskSettings::PushBall(PushBallConfig::default()),
    read_settings: |_, section| {
        toml_table::read("task.push_ball", section, PushBallConfig::bounds).map(TaskSettings::PushBall)
    },
    bounds: |task| bounds::of_particles(task, 2 * task.agents),
    reward_range: |task, extent| match task.push_ball() {
        Ok(p) => {
            // |Φ' − Φ| where 0 ≥ Φ ≥ −(d_ab + turn_length · π + 2 · d_bl).
            let gained = p.progress * (3.0 * extent + p.turn_length * std::f32::consts::PI);
            [-(gained + 2.0 * p.distance * extent), gained + p.bonus]
        }
        Err(_) => [f32::MIN, f32::MAX],
    },
    validate,
};

impl TaskConfig {
    /// What only Push Ball has; an error in any other task.
    pub fn push_ball(&self) -> Result<&PushBallConfig, FieldError> {
        match &self.settings {
            TaskSettings::PushBall(settings) => Ok(settings),
            _ => Err(wrong_task(self, TaskName::PushBall)),
        }
    }
}

fn validate(task: &TaskConfig) -> Result<(), FieldError> {
    let p = task.push_ball()?;
    p.check_ranges("task.push_ball")?;
    // The balls of the authors' layouts, on their longest line, in raw units apart.
    let gap = match task.agents {
        20 => 6.0 / 19.0,
        50 => 12.0 / 49.0,
        // Other sizes are scaled to fit.
        _ => f32::INFINITY,
    };
    if task.spawn != Spawn::Uniform && gap / task.layout_scale < SPACING {
        let problem = format!(
            "{} puts the balls of the layouts {:.2} apart, closer than {SPACING}; use at most {:.2}",
            task.layout_scale,
            gap / task.layout_scale,
            gap / SPACING
        );
        return Err(FieldError::new("task.layout_scale", problem));
    }
    if task.spawn == Spawn::Uniform {
        // Agents keep 0.25 from balls and 0.2 from each other: together they need little more room than twice the balls.
        fits(task, "balls with as many agents", 2 * task.agents, SPACING)?;
    }
    Ok(())
}
