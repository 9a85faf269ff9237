//! Sizes of Push Ball beside those of [`PushBallConfig`], world units.

use magex_core::task::PushBallConfig;

/// A landmark is covered when a ball's centre is within this distance (ball radius 0.15 + landmark radius 0.15).
pub(crate) const REACHED: f64 = 0.3;

/// Balls start at least this far from each other, and so do landmarks, wherever they fit.
pub(crate) const SPACING: f64 = 2.0 * PushBallConfig::BALL_RADIUS;
