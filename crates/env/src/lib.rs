//! The tasks: Simple Spread and Push Ball on a particle engine, drones on a rigid-body engine (paper, section 5.1). Physics,
//! starts, reward, metrics, and the controllers without weights used as yardsticks.
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
pub mod spread;

mod env;
mod matching;
mod push_ball;
mod rules;
mod tasks;

pub use controller::{Classical, Controller};
pub use env::Env;
pub use particles::constants::CONTACT_DISTANCE;
pub use particles::real::Real;
pub use rules::{Rules, Score};
pub use spread::start as spawn;
pub use tasks::{classical, env_from_state, new_env, scripted};
