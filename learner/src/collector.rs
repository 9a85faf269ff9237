//! The trainer's view of the actors: publish weights, hand out a plan, get its results.

use crate::report::bottleneck::Collected;
use crate::report::metrics_file::IterationMetrics;
use crate::run_events::{CollectError, IterationReport, RunEvent, StopReason};
use magex_core::ids::Shard;
use magex_core::trajectory::ShardResult;
use magex_proto::weights::Weights;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

/// Gets plans done. Called from the training thread, which it blocks.
pub trait Collector: Send {
    /// Makes a version of the weights known to all actors and commanders. Comes before every plan that names it.
    fn publish(&mut self, weights: &Arc<Weights>) -> Result<(), CollectError>;

    /// Gets every shard of a plan done, on whichever actors there are. The results are in the order of the plan.
    fn collect(&mut self, plan: Vec<Shard>) -> Result<Vec<ShardResult>, CollectError>;

    /// Tells whoever watches the run what happened.
    fn event(&mut self, event: RunEvent);

    /// Whether the trainer should write a checkpoint and return after the current iteration.
    fn stop_requested(&self) -> Option<StopReason>;

    /// Whether somebody asked for a checkpoint since the last call.
    fn checkpoint_requested(&mut self) -> bool {
        false
    }

    /// Where the time of the last plan's shards went; `None` if there is no network that it could have gone to.
    fn collected(&self) -> Option<Collected> {
        None
    }

    /// Takes note of how the run stood when it was resumed.
    fn resumed(&mut self, _before: &IterationReport) {}

    /// Takes note of what an iteration was like, for whoever operates the run.
    fn measured(&mut self, _metrics: &IterationMetrics) {}

    /// Takes note of a checkpoint that was written to this folder, or could not be.
    fn checkpointed(&mut self, _took: Duration, _written: Option<&Path>) {}
}
