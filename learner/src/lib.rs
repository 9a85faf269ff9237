//! magex-learner

pub mod adam;
pub mod batch;
pub mod bench;
pub mod checkpoint;
pub mod cli;
pub mod collector;
pub mod commander;
mod events;
#[cfg(test)]
mod fixtures;
pub mod gae;
pub mod ingest;
pub mod ledger;
pub mod loss;
pub mod mappo;
pub mod metrics;
pub mod service;
mod session;
mod state;
pub mod trainer;
pub mod weights;
