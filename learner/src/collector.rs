//! The trainer's view of the actors: it publishes weights and collects the results of plans.

use crate::report::bottleneck::CollectTiming;
use crate::run_events::{CollectError, StopReason};
use magex_core::ids::Shard;
use magex_core::trajectory::ShardResult;
use magex_proto::weights::Weights;
use std::sync::Arc;

/// Collects the results of plans. Called from the training thread, which it blocks.
pub trait Collector: Send {
    /// Publishes a version of the weights to all actors and commanders. Precedes every plan that names it.
    fn publish(&mut self, weights: &Arc<Weights>) -> Result<(), CollectError>;

    /// Collects the results of all shards of a plan, in the order of the plan. [`CollectError::Stopped`]: a stop was requested, and
    /// nothing is returned.
    fn collect(&mut self, plan: Vec<Shard>) -> Result<Vec<ShardResult>, CollectError>;

    /// Whether the trainer should write a checkpoint and return after the current iteration.
    fn stop_requested(&self) -> Option<StopReason>;

    /// Whether a checkpoint was requested since the last call.
    fn checkpoint_requested(&mut self) -> bool {
        false
    }

    /// Where the time of the last plan's shards went; `None` without a network that could have taken some of it.
    fn collected(&self) -> Option<CollectTiming> {
        None
    }
}
