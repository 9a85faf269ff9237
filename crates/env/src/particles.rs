//! The particle engine that Simple Spread and Push Ball share: physics, contacts, arrivals, and where episodes start.

pub(crate) mod arrival;
pub(crate) mod batch;
pub(crate) mod cells;
pub mod constants;
pub(crate) mod curves;
pub mod physics;
pub(crate) mod placement;
pub mod real;
pub mod swarm;
