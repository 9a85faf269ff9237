//! The goal commander as a service: for the actors of a run, and for outside clients with agents and goals.
mod api;
mod assign_service;
mod classical;
pub mod cli;
mod metadata;
mod metrics;
mod mission_service;
mod model_store;
pub mod run_scheduler;
pub mod scheduler;
pub mod service;
mod shard_assign;
pub mod shard_goals;
mod streams;
mod subscription;
mod training_view;
pub mod weights_file;
