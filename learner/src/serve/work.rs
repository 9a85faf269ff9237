//! The work of the open plan: the ledger, its timing and trace, and the two sides that wait for it: sessions for shards to
//! lease, the training thread for the results.

use crate::report::bottleneck::CollectTiming;
use crate::report::shard_timing::ShardTiming;
use crate::run_events::{CollectError, StopReason};
use crate::serve::ledger::{Lease, Ledger};
use crate::serve::lock_order::{OrderedMutex, Rank};
use crate::serve::metrics::LearnerMetrics;
use magex_core::ids::Shard;
use magex_core::trajectory::ShardResult;
use magex_runtime::trace;
use std::sync::{Arc, Condvar};
use std::time::Instant;
use tokio::sync::watch;
use tracing::Span;

#[derive(Debug)]
pub(crate) struct OpenWork {
    pub(crate) ledger: Ledger,
    pub(crate) timing: ShardTiming,
    trace: Span,
}

#[derive(Debug)]
pub(crate) struct CollectedPlan {
    /// In the order of the plan.
    pub(crate) results: Vec<ShardResult>,
    pub(crate) timing: CollectTiming,
    /// Ages of the training results, seconds.
    pub(crate) ages: Vec<f64>,
}

#[derive(Debug)]
pub(crate) struct Work {
    open: OrderedMutex<OpenWork>,
    /// The training thread waits here for the end of the plan.
    settled: Condvar,
    /// Changes when there are shards to lease.
    lease_wakeups: watch::Sender<u64>,
    metrics: Arc<LearnerMetrics>,
}

impl Work {
    pub(crate) fn new(first_lease: u64, metrics: Arc<LearnerMetrics>) -> Self {
        let open = OpenWork { ledger: Ledger::new(first_lease), timing: ShardTiming::default(), trace: Span::none() };
        Self {
            open: OrderedMutex::new(Rank::Work, open),
            settled: Condvar::new(),
            lease_wakeups: watch::Sender::new(0),
            metrics,
        }
    }

    /// Changes the ledger, updates its metrics, and wakes sessions if shards were queued and the training thread if the plan
    /// ended.
    pub(crate) fn update<T>(&self, change: impl FnOnce(&mut OpenWork) -> T) -> T {
        let mut open = self.open.lock();
        let before = open.ledger.queued();
        let value = change(&mut open);
        let ledger = &open.ledger;
        let (queued, shards) = (ledger.queued(), ledger.counters());
        let settled = ledger.is_complete() || ledger.given_up().is_some();
        self.metrics.ledger(&shards, &ledger.episodes(), queued);
        open.timing.leases_outstanding(shards.outstanding, Instant::now());
        drop(open);
        if settled {
            self.settled.notify_all();
        }
        if queued > before {
            self.lease_wakeups.send_modify(|generation| *generation = generation.wrapping_add(1));
        }
        value
    }

    pub(crate) fn with_ledger<T>(&self, change: impl FnOnce(&mut Ledger) -> T) -> T {
        self.update(|open| change(&mut open.ledger))
    }

    pub(crate) fn inspect<T>(&self, read: impl FnOnce(&Ledger) -> T) -> T {
        read(&self.open.lock().ledger)
    }

    /// Notified after every change that queued shards.
    pub(crate) fn lease_wakeups(&self) -> watch::Receiver<u64> {
        self.lease_wakeups.subscribe()
    }

    /// Opens a plan within the current span.
    pub(crate) fn open(&self, plan: Vec<Shard>) -> Result<(), CollectError> {
        self.update(|open| {
            open.trace = Span::current();
            open.ledger.open(plan)?;
            open.timing.start();
            Ok(())
        })
    }

    /// The span of a lease, within that of its iteration.
    pub(crate) fn lease_span(&self, lease: &Lease, actor: &str) -> Span {
        let (iteration, index) = (lease.shard.iteration.0, lease.shard.index);
        let parent = self.open.lock().trace.clone();
        tracing::info_span!(target: trace::TARGET, parent: &parent, "lease", iteration, index, actor)
    }

    /// Blocks until the open plan is complete or given up, or `stop` returns a reason. `stop` runs under the work lock; what
    /// it reads must change within [`Self::wake_after`].
    pub(crate) fn wait(&self, stop: impl Fn() -> Option<StopReason>) -> Result<CollectedPlan, CollectError> {
        let mut open = self.open.lock();
        let end = loop {
            if let Some(results) = open.ledger.take() {
                let (timing, ages) = open.timing.finish(Instant::now());
                break Ok(CollectedPlan { results, timing, ages });
            }
            if let Some((shard, reason)) = open.ledger.given_up().cloned() {
                break Err(CollectError::Shard { shard, reason });
            }
            if let Some(reason) = stop() {
                break Err(CollectError::Stopped(reason));
            }
            if open.ledger.progress().1 == 0 {
                return Err(CollectError::NoPlan);
            }
            open = open.wait(&self.settled);
        };
        if end.is_err() {
            open.ledger.abandon();
        }
        // The span of the iteration ends, and is exported, when its last holder drops it.
        open.trace = Span::none();
        end
    }

    /// Runs `change` under the work lock and wakes the training thread, which therefore cannot miss it between its check and
    /// its wait.
    pub(crate) fn wake_after(&self, change: impl FnOnce()) {
        let open = self.open.lock();
        change();
        drop(open);
        self.settled.notify_all();
    }
}
