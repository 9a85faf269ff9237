//! Sizes of Push Ball, world units.

/// Radius of an agent.
pub const AGENT_RADIUS: f64 = 0.1;
/// Radius of a ball.
pub const BALL_RADIUS: f64 = 0.15;
/// An agent touches a ball when their centres are this close.
pub const PUSH_DISTANCE: f64 = AGENT_RADIUS + BALL_RADIUS;
/// A landmark is covered when a ball's centre is within this distance (ball radius 0.15 + landmark radius 0.15).
pub const REACHED: f64 = 0.3;

/// Balls start at least this far from each other, and so do landmarks, wherever they fit.
pub const SPACING: f64 = 2.0 * BALL_RADIUS;
