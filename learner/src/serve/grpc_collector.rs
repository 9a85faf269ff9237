//! The collector whose actors connect over gRPC.

use crate::collector::Collector;
use crate::report::bottleneck::Collected;
use crate::report::metrics_file::IterationMetrics;
use crate::run_events::{CollectError, IterationReport, RunEvent, StopReason};
use crate::serve::shared::Shared;
use magex_core::ids::{Shard, ShardKind};
use magex_core::metrics_table::{REWARD, SUCCESS_RATE};
use magex_core::trajectory::ShardResult;
use magex_proto::weights::Weights;
use magex_runtime::sync::lock;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// The collector whose actors connect over gRPC. Made by [`crate::serve::service::learner_service`].
#[derive(Debug)]
pub struct GrpcCollector {
    shared: Arc<Shared>,
    collected: Collected,
}

impl GrpcCollector {
    pub(crate) fn new(shared: Arc<Shared>) -> Self {
        Self { shared, collected: Collected::default() }
    }

    /// Hands out a plan and returns at once; actors that wait for work get it now.
    pub fn open(&mut self, plan: Vec<Shard>) -> Result<(), CollectError> {
        if let Some(shard) = plan.iter().find(|shard| !self.shared.board.is_kept(shard.version)) {
            return Err(CollectError::Version(shard.version));
        }
        self.shared.open(plan)?;
        Ok(())
    }

    /// Blocks until the open plan is done.
    pub fn wait(&mut self) -> Result<Vec<ShardResult>, CollectError> {
        let results = self.shared.wait()?;
        let (collected, ages) = lock(&self.shared.tally).close(Instant::now());
        self.collected = collected;
        let newest = self.shared.board.latest().map_or(0, |weights| weights.version.0);
        let training = results.iter().map(ShardResult::shard).filter(|shard| shard.kind == ShardKind::Train);
        let lags: Vec<f64> = training.map(|shard| f64::from(newest.saturating_sub(shard.version.0))).collect();
        self.shared.gauges.batch(&lags, &ages);
        Ok(results)
    }
}

impl Collector for GrpcCollector {
    fn publish(&mut self, weights: &Arc<Weights>) -> Result<(), CollectError> {
        if weights.run_id != self.shared.run.run_id {
            let own = &self.shared.run.run_id;
            return Err(CollectError::Other(format!("weights of run '{}' published to run '{own}'", weights.run_id)));
        }
        self.shared.publish(weights.clone());
        Ok(())
    }

    fn collect(&mut self, plan: Vec<Shard>) -> Result<Vec<ShardResult>, CollectError> {
        self.open(plan)?;
        self.wait()
    }

    fn event(&mut self, event: RunEvent) {
        self.shared.record(event);
    }

    fn resumed(&mut self, before: &IterationReport) {
        self.shared.reported(before);
    }

    fn stop_requested(&self) -> Option<StopReason> {
        self.shared.stop_requested()
    }

    fn checkpoint_requested(&mut self) -> bool {
        self.shared.take_checkpoint_request()
    }

    fn collected(&self) -> Option<Collected> {
        Some(self.collected)
    }

    fn measured(&mut self, metrics: &IterationMetrics) {
        self.shared.gauges.iteration(metrics);
        let (bound, timing) = (&metrics.timing.bound, &metrics.timing);
        tracing::info!(
            iteration = metrics.iteration,
            joint_env_steps = metrics.joint_env_steps,
            success_rate = metrics.episodes.get(SUCCESS_RATE),
            reward = metrics.episodes.get(REWARD),
            bound_by = bound.by.name(),
            actor_s = bound.actor_s,
            learner_s = bound.learner_s,
            network_s = bound.network_s,
            collect_s = timing.collect_s,
            "iteration"
        );
    }

    fn checkpointed(&mut self, took: Duration, written: Option<&Path>) {
        self.shared.gauges.checkpoint(took, written.map(size_of));
    }
}

/// Bytes of the files in a folder.
fn size_of(folder: &Path) -> u64 {
    let entries = std::fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok);
    entries.filter_map(|entry| entry.metadata().ok()).map(|meta| meta.len()).sum()
}
