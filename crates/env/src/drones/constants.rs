//! Sizes of the drone task, SI units.

/// Drones start, and landmarks hang, at this height, m.
pub const HEIGHT: f32 = 1.5;
/// A landmark is covered when the centre of a drone that has not crashed is within this distance, m.
pub const COVER_RADIUS: f64 = 0.15;
/// A command changes the target velocity of an axis by this per second, m/s².
pub const ACCELERATION: f64 = 5.0;
/// Largest target velocity, m/s.
pub const MOST_SPEED: f64 = 2.0;
