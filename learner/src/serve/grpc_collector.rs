//! The collector whose actors connect over gRPC.

use crate::collector::Collector;
use crate::report::bottleneck::CollectTiming;
use crate::run_events::{CollectError, StopReason};
use crate::serve::shared::Shared;
use crate::serve::work::CollectedPlan;
use magex_core::ids::{Shard, ShardKind};
use magex_core::trajectory::ShardResult;
use magex_proto::weights::Weights;
use std::sync::Arc;

/// The collector whose actors connect over gRPC. Made by [`crate::serve::service::learner_service`].
#[derive(Debug)]
pub struct GrpcCollector {
    pub(crate) shared: Arc<Shared>,
    /// Of the last plan that was collected.
    pub(crate) timing: CollectTiming,
}

impl GrpcCollector {
    /// Opens a plan and returns at once; sessions with credit lease its shards from now on.
    pub fn open(&mut self, plan: Vec<Shard>) -> Result<(), CollectError> {
        if let Some(shard) = plan.iter().find(|shard| !self.shared.board.is_kept(shard.version)) {
            return Err(CollectError::Version(shard.version));
        }
        self.shared.work.open(plan)
    }

    /// Blocks until the open plan is complete.
    pub fn wait(&mut self) -> Result<Vec<ShardResult>, CollectError> {
        let CollectedPlan { results, timing, ages } = self.shared.wait()?;
        self.timing = timing;
        let newest = self.shared.board.latest().map_or(0, |weights| weights.version.0);
        let training = results.iter().map(ShardResult::shard).filter(|shard| shard.kind == ShardKind::Train);
        let lags: Vec<f64> = training.map(|shard| f64::from(newest.saturating_sub(shard.version.0))).collect();
        self.shared.metrics.batch(&lags, &ages);
        Ok(results)
    }
}

impl Collector for GrpcCollector {
    fn publish(&mut self, weights: &Arc<Weights>) -> Result<(), CollectError> {
        let own = &self.shared.run.run_id;
        if weights.run_id != *own {
            return Err(CollectError::OtherRun(weights.run_id.clone(), own.clone()));
        }
        self.shared.publish(weights.clone());
        Ok(())
    }

    fn collect(&mut self, plan: Vec<Shard>) -> Result<Vec<ShardResult>, CollectError> {
        self.open(plan)?;
        self.wait()
    }

    fn stop_requested(&self) -> Option<StopReason> {
        self.shared.control.stop_requested()
    }

    fn checkpoint_requested(&mut self) -> bool {
        self.shared.control.take_checkpoint_request()
    }

    fn collected(&self) -> Option<CollectTiming> {
        Some(self.timing)
    }
}
