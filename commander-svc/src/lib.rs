//! The goal commander as a service: for the actors of a run, and for external clients with agents and goals.
//!
//! [`service`] builds and serves it; `api` implements the gRPC contract. A call of an external client goes to `assign_service`
//! or `mission_service`. A step of an external
//! client's agents goes to `policy_service`. A shard of an actor goes to `shard_assign`, which asks the scheduler of its run ([`scheduler`],
//! [`run_scheduler`], [`shard_goals`]). `model_store` holds the weights of the learner (`subscription`) or of a file
//! ([`weights_file`]).

mod api;
mod assign_service;
mod call_budget;
mod cancel;
pub mod cli;
mod error;
mod metrics;
mod mission_service;
mod model_store;
mod policy_service;
pub mod run_scheduler;
pub mod scheduler;
pub mod service;
mod shard_assign;
pub mod shard_goals;
mod streams;
mod subscription;
mod training_view;
pub mod weights_file;
