//! The learner's gRPC service, the collector through which the training loop uses it, and its observer of the run.
//!
//! `shared` describes the four parts of the shared state and their lock order.

pub(crate) mod control;
pub(crate) mod events;
pub mod grpc_collector;
pub mod judge;
pub(crate) mod ledger;
pub(crate) mod lock_order;
pub(crate) mod metrics;
pub mod observer;
mod patience;
pub(crate) mod roster;
pub mod service;
pub(crate) mod session;
pub(crate) mod shared;
#[cfg(test)]
mod simulation;
pub(crate) mod status;
pub mod validate;
pub mod weights_board;
pub(crate) mod work;
