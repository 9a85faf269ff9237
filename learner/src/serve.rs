//! The learner's gRPC service, and the collector through which the training loop uses it.

pub(crate) mod events;
pub mod grpc_collector;
pub mod ledger;
pub(crate) mod metrics;
pub mod service;
pub(crate) mod session;
pub(crate) mod shared;
pub mod validate;
pub mod weights_board;
