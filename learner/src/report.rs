//! The observers of a run: what it writes for people and for tools.

pub mod bottleneck;
mod live_page;
pub mod means;
pub mod metrics_file;
pub mod observer;
pub(crate) mod shard_timing;
pub mod tensorboard;
