//! The algorithms: what a batch of trajectories does to the networks. No connection, no clock, no file.

pub mod adam;
pub mod algorithm;
pub mod batch;
pub mod commander_ppo;
pub mod gae;
pub mod learned;
pub mod mappo;
pub mod maser;
pub mod qmix;
pub mod replay;
pub mod rmsprop;
pub mod stats;
pub mod suspect;
