//! What a run writes for people and for tools.

pub mod bottleneck;
pub mod means;
pub mod metrics_file;
pub(crate) mod shard_timing;
pub mod tensorboard;
