//! Sizes of Push Ball, world units.

use magex_core::task::PushBallConfig;

/// Radius of an agent.
pub const AGENT_RADIUS: f64 = PushBallConfig::AGENT_RADIUS;
/// Radius of a ball.
pub const BALL_RADIUS: f64 = PushBallConfig::BALL_RADIUS;
/// An agent touches a ball when their centres are this close.
pub const PUSH_DISTANCE: f64 = PushBallConfig::PUSH_DISTANCE;
/// A landmark is covered when a ball's centre is within this distance (ball radius 0.15 + landmark radius 0.15).
pub const REACHED: f64 = 0.3;

/// Balls start at least this far from each other, and so do landmarks, wherever they fit.
pub const SPACING: f64 = 2.0 * BALL_RADIUS;
