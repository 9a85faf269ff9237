//! The trainer's view of the actors: it publishes weights and collects the results of plans.

use crate::origin::Origin;
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

    /// Collects the results of all shards of a plan, in the order of the plan. [`CollectError::Stopped`]: a stop was requested,
    /// [`CollectError::Convicted`]: an actor is proven to compute wrong results; in both cases nothing is returned.
    fn collect(&mut self, plan: Vec<Shard>) -> Result<Vec<ShardResult>, CollectError>;

    /// Where the results of the last plan come from, in the order of the plan; empty if this process computed them.
    fn origins(&self) -> &[Origin] {
        &[]
    }

    /// Has these shards of the last plan computed a second time, and waits until that and every other second computation has
    /// ended.
    ///
    /// # Errors
    /// Those of [`Self::collect`].
    fn confirm(&mut self, _shards: &[Shard]) -> Result<(), CollectError> {
        Ok(())
    }

    /// The result of this origin cannot be trained on: counts it as rejected and evicts its actor.
    fn reject(&mut self, _origin: &Origin, _reason: &str) {}

    /// The run went back to a checkpoint of this number of iterations: what came after it did not happen.
    fn went_back(&mut self, _iteration: u32) {}

    /// The first iteration that may still turn out to have trained on a wrong result.
    fn unconfirmed_since(&self) -> Option<u32> {
        None
    }

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
