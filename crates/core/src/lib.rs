//! What every part of MAGE-X agrees on and nothing else: the configuration of a run, the description of a task,
//! the names of things (iterations, shards, versions) and the keyed random streams.
//!
//! The learner knows a task only by its [`task::TaskConfig`]; the physics lives in `magex-env`.

pub mod about;
pub mod config;
pub mod error;
pub mod ids;
pub mod joint_state;
pub mod keys;
pub mod metrics_table;
pub mod rng;
pub mod sha256;
pub mod statics;
pub mod task;
pub mod trajectory;

mod section;
mod toml_table;
