//! The collector whose actors connect over gRPC.

use crate::collector::Collector;
use crate::origin::Origin;
use crate::report::bottleneck::CollectTiming;
use crate::run_events::{CollectError, StopReason};
use crate::serve::judge::{Compute, Judge};
use crate::serve::metrics::Rejection;
use crate::serve::shared::Shared;
use crate::serve::work::CollectedPlan;
use magex_core::ids::{Shard, ShardKind};
use magex_core::trajectory::ShardResult;
use magex_proto::weights::Weights;
use std::collections::BTreeMap;
use std::sync::Arc;

/// The collector whose actors connect over gRPC. Made by [`crate::serve::service::learner_service`].
#[derive(Debug)]
pub struct GrpcCollector {
    pub(crate) shared: Arc<Shared>,
    /// Of the last plan that was collected.
    pub(crate) timing: CollectTiming,
    pub(crate) judge: Judge,
    /// Of the last plan that was collected.
    pub(crate) shards: Vec<Shard>,
    pub(crate) origins: Vec<Origin>,
    /// First iteration that trained on results of a process which no second computation has confirmed. A training result that is
    /// confirmed vouches for all that its process sent before.
    pub(crate) unconfirmed: BTreeMap<u64, u32>,
}

impl GrpcCollector {
    /// Computes shards on this host, where the results of actors differ or there is only one actor.
    pub fn judge(&mut self, compute: Compute) {
        self.judge = Judge::new(compute);
    }

    /// Opens a plan and returns at once; sessions with credit lease its shards from now on.
    pub fn open(&mut self, plan: Vec<Shard>) -> Result<(), CollectError> {
        if let Some(shard) = plan.iter().find(|shard| !self.shared.board.is_kept(shard.version)) {
            return Err(CollectError::Version(shard.version));
        }
        self.shared.work.open(plan)
    }

    /// Blocks until the open plan is complete.
    pub fn wait(&mut self) -> Result<Vec<ShardResult>, CollectError> {
        let ended = self.shared.wait(&mut self.judge);
        self.collected_plan(ended)
    }

    /// [`Self::wait`] without waiting: `None` while the plan is open.
    #[cfg(test)]
    pub(crate) fn poll(&mut self) -> Option<Result<Vec<ShardResult>, CollectError>> {
        let ended = self.shared.poll(&mut self.judge)?;
        Some(self.collected_plan(ended))
    }

    fn collected_plan(&mut self, ended: Result<CollectedPlan, CollectError>) -> Result<Vec<ShardResult>, CollectError> {
        let CollectedPlan { results, origins, timing, ages } = ended.map_err(|error| self.dated(error))?;
        self.timing = timing;
        self.shards = results.iter().map(|result| *result.shard()).collect();
        self.origins = origins;
        self.note();
        let newest = self.shared.board.latest().map_or(0, |weights| weights.version.0);
        let training = results.iter().map(ShardResult::shard).filter(|shard| shard.kind == ShardKind::Train);
        let lags: Vec<f64> = training.map(|shard| f64::from(newest.saturating_sub(shard.version.0))).collect();
        self.shared.metrics.batch(&lags, &ages);
        Ok(results)
    }

    /// Notes what was confirmed, and what trains now and is not.
    fn note(&mut self) {
        let (confirmed, checked): (Vec<(u64, Shard)>, Vec<u64>) = self
            .shared
            .work
            .with_ledger(|ledger| (ledger.checks.take_confirmed(), ledger.checks.processes().collect()));
        // An actor may evaluate well and train badly: evaluations vouch for nothing.
        for (process, shard) in confirmed.into_iter().filter(|(_, shard)| shard.kind == ShardKind::Train) {
            self.unconfirmed.entry(process).and_modify(|since| *since = shard.iteration.0.max(*since));
        }
        let connected = self.shared.roster.connected_processes();
        // A process that is gone and has nothing to be checked cannot be convicted any more.
        self.unconfirmed.retain(|process, _| connected.contains(process) || checked.contains(process));
        for (shard, origin) in self.shards.iter().zip(&self.origins) {
            if shard.kind == ShardKind::Train {
                self.unconfirmed.entry(origin.process).or_insert(shard.iteration.0);
            }
        }
    }

    /// A conviction, with what the process has spoilt.
    fn dated(&mut self, error: CollectError) -> CollectError {
        match error {
            CollectError::Convicted(mut conviction) => {
                conviction.since = self.unconfirmed.remove(&conviction.origin.process);
                CollectError::Convicted(conviction)
            }
            other => other,
        }
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

    fn origins(&self) -> &[Origin] {
        &self.origins
    }

    fn confirm(&mut self, shards: &[Shard]) -> Result<(), CollectError> {
        let now = tokio::time::Instant::now();
        let wanted = self.shards.iter().zip(&self.origins).filter(|(shard, _)| shards.contains(shard));
        self.shared.work.with_ledger(|ledger| {
            wanted.for_each(|(shard, origin)| ledger.checks.begin(shard, origin, None, now));
            ledger.offer();
        });
        let ended = self.shared.wait_for_checks(&mut self.judge);
        ended.map_err(|error| self.dated(error))?;
        self.note();
        Ok(())
    }

    fn reject(&mut self, origin: &Origin, reason: &str) {
        self.shared.evict_now(origin.process, reason, Rejection::Update);
    }

    fn went_back(&mut self, iteration: u32) {
        self.shared.work.with_ledger(|ledger| ledger.checks.clear());
        self.shared.metrics.rolled_back.inc();
        self.unconfirmed.retain(|_, since| *since < iteration);
    }

    fn unconfirmed_since(&self) -> Option<u32> {
        self.unconfirmed.values().min().copied()
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
