//! magex-learner

pub mod adam;
pub mod batch;
pub mod bench;
pub mod bound;
pub mod checkpoint;
pub mod cli;
pub mod collector;
pub mod commander;
mod events;
#[cfg(test)]
mod fixtures;
pub mod gae;
mod gauges;
pub mod ingest;
pub mod ledger;
pub mod loss;
pub mod mappo;
pub mod metrics;
pub mod page;
pub mod service;
mod session;
mod standing;
mod state;
mod tally;
pub mod tensorboard;
pub mod trainer;
pub mod weights;
