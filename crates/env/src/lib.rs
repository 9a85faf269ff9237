//! The particle tasks Simple Spread and Push Ball (paper, section 5.1.1): physics, spawn, reward, metrics, the scripted
//! controllers used as yardsticks.
//!
//! An [`Env`] is a batch of B independent episodes stepped together, one world per SIMD lane. An episode is a pure
//! function of its task, its random stream, its goals and its actions: it gives the same bits alone, in any batch and
//! on any machine.
//!
//! No networks, no threads, no clock. `magex-verify` checks all of it against recordings of the authors' simulator.

pub mod drones;
pub mod layouts;
pub mod physics;
pub mod push_ball;
pub mod scripted;
pub mod spawn;

mod arrival;
mod batch;
mod cells;
mod env;
mod error;
mod matching;
mod real;
mod spread;
mod swarm;

pub use drones::{Drones, scripted_drones};
pub use env::{Env, Score, View, new_env};
pub use error::EnvError;
pub use push_ball::PushBall;
pub use real::Real;
pub use spread::{CONTACT_DISTANCE, COVER_RADIUS, Spread};
