//! The observers of a run: what it writes for people and for tools.

pub mod bottleneck;
pub mod means;
pub(crate) mod metrics_file;
pub mod observer;
pub mod records;
pub(crate) mod senders;
pub(crate) mod shard_timing;
pub(crate) mod tensorboard;
