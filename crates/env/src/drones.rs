//! Drones: Crazyflie 2.X quadrotors with the dynamics and the controller of gym-pybullet-drones 2.1.0.
//!
//! Units are SI, z is up, quaternions are `[x, y, z, w]` and turn body vectors into world vectors; velocities and
//! angular velocities are in the world frame. Motors 0..3 are front right, rear right, rear left, front left.

pub mod control;
pub mod model;

pub(crate) mod linalg;
pub(crate) mod world;

mod engine;
