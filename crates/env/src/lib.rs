//! The tasks: Simple Spread and Push Ball on a particle engine, drones on a rigid-body engine (paper, section 5.1). Physics,
//! starts, reward, metrics, and the scripted controllers used as yardsticks.
//!
//! An [`Env`] is a batch of B independent episodes stepped together, particle worlds one per SIMD lane. An episode is a pure
//! function of its task, its random stream, its goals and its actions: it gives the same bits alone, in any batch and
//! on any machine.
//!
//! No networks, no threads, no clock. `magex-verify` checks all of it against recordings of the authors' simulators.

#![allow(
    clippy::needless_range_loop,
    reason = "kernels index several arrays by one counter; iterators hide which elements meet"
)]

pub mod controller;
pub mod drones;
pub mod particles;
pub mod push_ball;
pub mod shell;
pub mod spread;

mod env;
mod error;
mod matching;
mod tasks;

pub use controller::Controller;
pub use drones::Drones;
pub use env::Env;
pub use error::EnvError;
pub use particles::constants::CONTACT_DISTANCE;
pub use particles::real::Real;
pub use push_ball::PushBall;
pub use spread::{COVER_RADIUS, Spread, layouts, start as spawn};
pub use tasks::{new_env, scripted};
