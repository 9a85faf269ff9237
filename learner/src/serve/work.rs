//! The work of the open plan: the ledger, its timing and trace, and the two sides that wait for it: sessions for shards to
//! lease, the training thread for the results.

use crate::origin::{Conviction, Origin};
use crate::report::bottleneck::CollectTiming;
use crate::report::shard_timing::ShardTiming;
use crate::run_events::{CollectError, StopReason};
use crate::serve::ledger::checks::{Check, Sampling};
use crate::serve::ledger::{Lease, Ledger};
use crate::serve::lock_order::{OrderedMutex, Rank};
use crate::serve::metrics::LearnerMetrics;
use magex_core::ids::Shard;
use magex_core::trajectory::ShardResult;
use magex_runtime::trace;
use std::sync::{Arc, Condvar};
use std::time::{Duration, Instant};
use tokio::sync::Notify;
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
    /// In the same order.
    pub(crate) origins: Vec<Origin>,
    pub(crate) timing: CollectTiming,
    /// Ages of the training results, seconds.
    pub(crate) ages: Vec<f64>,
}

/// How often the training thread looks whether a check waits in vain.
const CHECK_PERIOD: Duration = Duration::from_millis(250);

/// What ends the wait of the training thread beside the plan. Called under the work lock, but for [`Self::decide`].
pub(crate) trait Waiting {
    /// Why the wait ends before the plan.
    fn stop(&self) -> Option<StopReason>;

    /// The processes of the connected actors.
    fn connected(&self) -> Vec<u64>;

    /// Computes a shard on this host and closes its check; an actor whose result differs is evicted.
    fn decide(&mut self, check: &Check) -> Result<Option<Box<Conviction>>, CollectError>;
}

#[derive(Debug)]
pub(crate) struct Work {
    open: OrderedMutex<OpenWork>,
    /// The training thread waits here for the end of the plan.
    settled: Condvar,
    /// Wakes sessions, in the order in which they began to wait, when there are shards to lease.
    lease_wakeups: Arc<Notify>,
    metrics: Arc<LearnerMetrics>,
}

impl Work {
    pub(crate) fn new(first_lease: u64, lease: Duration, sampling: Sampling, metrics: Arc<LearnerMetrics>) -> Self {
        let ledger = Ledger::new(first_lease, lease, sampling);
        let open = OpenWork { ledger, timing: ShardTiming::default(), trace: Span::none() };
        Self {
            open: OrderedMutex::new(Rank::Work, open),
            settled: Condvar::new(),
            lease_wakeups: Arc::default(),
            metrics,
        }
    }

    /// Whether the shard of a late lease is leased once more: only if it is pure.
    pub(crate) fn hedging(self, pure: bool) -> Self {
        self.with_ledger(|ledger| ledger.hedges = pure);
        self
    }

    /// Changes the ledger, updates its metrics, and wakes sessions if shards were queued and the training thread if the plan
    /// ended.
    pub(crate) fn update<T>(&self, change: impl FnOnce(&mut OpenWork) -> T) -> T {
        let mut open = self.open.lock();
        let before = open.ledger.offers();
        let value = change(&mut open);
        let ledger = &open.ledger;
        let (offers, shards) = (ledger.offers(), ledger.counters());
        // A check that is open may need the training thread, which decides it.
        let settled = ledger.is_complete() || ledger.given_up().is_some() || !ledger.checks.is_empty();
        self.metrics.ledger(&shards, &ledger.episodes(), ledger.queued(), &ledger.checks.totals);
        open.timing.leases_outstanding(shards.outstanding, Instant::now());
        drop(open);
        if settled {
            self.settled.notify_all();
        }
        if offers > before {
            self.lease_wakeups.notify_waiters();
        }
        value
    }

    pub(crate) fn with_ledger<T>(&self, change: impl FnOnce(&mut Ledger) -> T) -> T {
        self.update(|open| change(&mut open.ledger))
    }

    pub(crate) fn inspect<T>(&self, read: impl FnOnce(&Ledger) -> T) -> T {
        read(&self.open.lock().ledger)
    }

    /// Notified after every change that offers something to lease.
    pub(crate) fn lease_wakeups(&self) -> Arc<Notify> {
        self.lease_wakeups.clone()
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

    /// Blocks until the open plan is complete or given up, an actor is convicted, or [`Waiting::stop`] returns a reason. What
    /// `waiting` reads must change within [`Self::wake_after`].
    pub(crate) fn wait(&self, waiting: &mut dyn Waiting) -> Result<CollectedPlan, CollectError> {
        let end = self.wait_for(waiting, take);
        let mut open = self.open.lock();
        if end.is_err() {
            open.ledger.abandon();
        }
        // The span of the iteration ends, and is exported, when its last holder drops it.
        open.trace = Span::none();
        end
    }

    /// Blocks until every check has ended.
    pub(crate) fn wait_for_checks(&self, waiting: &mut dyn Waiting) -> Result<(), CollectError> {
        self.wait_for(waiting, |open| open.ledger.checks.is_empty().then_some(()))
    }

    fn wait_for<T>(
        &self,
        waiting: &mut dyn Waiting,
        done: impl Fn(&mut OpenWork) -> Option<T>,
    ) -> Result<T, CollectError> {
        let mut open = self.open.lock();
        loop {
            match look(&mut open, waiting, &done) {
                Look::Ended(end) => return end,
                Look::Case(check) => {
                    drop(open);
                    if let Some(conviction) = waiting.decide(&check)? {
                        return Err(CollectError::Convicted(conviction));
                    }
                    open = self.open.lock();
                }
                // Only checks have a time limit.
                Look::Open if open.ledger.checks.is_empty() => open = open.wait(&self.settled),
                Look::Open => open = open.wait_timeout(&self.settled, CHECK_PERIOD),
            }
        }
    }

    /// [`Self::wait`] without waiting: `None` while the plan is open.
    #[cfg(test)]
    pub(crate) fn poll(&self, waiting: &mut dyn Waiting) -> Option<Result<CollectedPlan, CollectError>> {
        let mut open = self.open.lock();
        let end = match look(&mut open, waiting, take) {
            Look::Open => return None,
            Look::Ended(end) => end,
            Look::Case(check) => {
                drop(open);
                let decided = waiting.decide(&check).transpose()?;
                open = self.open.lock();
                decided.and_then(|conviction| Err(CollectError::Convicted(conviction)))
            }
        };
        if end.is_err() {
            open.ledger.abandon();
        }
        Some(end)
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

/// What the training thread finds when it looks.
enum Look<T> {
    Ended(Result<T, CollectError>),
    /// A check that only this host can decide.
    Case(Check),
    Open,
}

fn look<T>(open: &mut OpenWork, waiting: &dyn Waiting, done: impl Fn(&mut OpenWork) -> Option<T>) -> Look<T> {
    let ledger = &open.ledger;
    // As long as shards are out, the actors have time for checks, too.
    let idle = ledger.all_done() || ledger.progress().1 == 0;
    let limit = |shard: &Shard| idle.then(|| ledger.late(shard.kind));
    if let Some(check) = ledger.checks.case(&waiting.connected(), limit, tokio::time::Instant::now()) {
        return Look::Case(check);
    }
    if let Some(value) = done(open) {
        return Look::Ended(Ok(value));
    }
    if let Some((shard, reason)) = open.ledger.given_up().cloned() {
        return Look::Ended(Err(CollectError::Shard { shard, reason }));
    }
    if let Some(reason) = waiting.stop() {
        return Look::Ended(Err(CollectError::Stopped(reason)));
    }
    if open.ledger.progress().1 == 0 && open.ledger.checks.is_empty() {
        return Look::Ended(Err(CollectError::NoPlan));
    }
    Look::Open
}

/// The results of a complete plan.
fn take(open: &mut OpenWork) -> Option<CollectedPlan> {
    let (results, origins) = open.ledger.take()?.into_iter().unzip();
    let (timing, ages) = open.timing.finish(Instant::now());
    Some(CollectedPlan { results, origins, timing, ages })
}
