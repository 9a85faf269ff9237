//! The algorithms: what a batch of trajectories does to the networks. No connection, no clock, no file.

pub mod adam;
pub mod batch;
pub mod commander_ppo;
pub mod gae;
pub mod learned;
pub mod mappo;
pub mod stats;
