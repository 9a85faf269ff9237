//! What the training thread and the connections share, in four parts:
//!
//! | part | content | lock |
//! |---|---|---|
//! | [`work`](crate::serve::work) | the ledger of leases, timing and trace of the open plan, wakeups of both sides | `Rank::Work` |
//! | [`roster`](crate::serve::roster) | connected, missing and evicted actors | `Rank::Roster` |
//! | [`control`](crate::serve::control) | requests to stop, drain and checkpoint; the signals that end streams | `Rank::Control` |
//! | [`status`](crate::serve::status) | what the training thread reported last | `Rank::Status` |
//!
//! Lock order: work, roster, control, status. A thread that holds one of these locks takes only locks further down the table;
//! debug builds check this ([`lock_order`](crate::serve::lock_order)). The board, the events and the metrics lock themselves,
//! last, and call nothing under their locks. No lock is held across an await.
//!
//! Two changes end the training thread's wait although they are not in the ledger: the last actor leaves, and a stop is
//! requested. Both happen within [`Work::wake_after`], under the work lock.

use crate::origin::Conviction;
use crate::run_events::{CollectError, StopReason, describe};
use crate::run_identity::RunIdentity;
use crate::serve::control::Control;
use crate::serve::events::Events;
use crate::serve::judge::Judge;
use crate::serve::ledger::checks::{Check, Sampling};
use crate::serve::ledger::{Ledger, SessionId};
use crate::serve::metrics::{LearnerMetrics, Rejection};
use crate::serve::roster::Roster;
use crate::serve::status::RunStatusCache;
use crate::serve::validate::Limits;
use crate::serve::weights_board::{Weights, WeightsBoard};
use crate::serve::work::{CollectedPlan, Waiting, Work};
use magex_core::ids::ShardKind;
use magex_proto::v1;
use magex_runtime::metrics::Metrics;
use magex_runtime::status;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tonic::Status;

#[derive(Debug)]
pub(crate) struct Shared {
    pub(crate) run: RunIdentity,
    pub(crate) limits: Limits,
    pub(crate) work: Work,
    pub(crate) roster: Roster,
    pub(crate) control: Control,
    pub(crate) status: RunStatusCache,
    pub(crate) board: WeightsBoard,
    pub(crate) events: Arc<Events>,
    pub(crate) metrics: Arc<LearnerMetrics>,
    /// What a scrape reads.
    pub(crate) registry: Arc<Metrics>,
    /// One permit per processor: more concurrent decoders would only hold memory.
    pub(crate) decoders: Semaphore,
    watchers: Arc<Semaphore>,
}

impl Shared {
    pub(crate) fn new(run: RunIdentity, limits: Limits) -> Self {
        // The upper half differs between processes, so the ledger never mistakes a lease of an earlier process for its own.
        Self::numbered(run, limits, magex_runtime::backoff::random_id() << 32, magex_runtime::backoff::random_id())
    }

    /// [`Self::new`] with the number of the first lease, and the key that decides which shards are computed a second time.
    pub(crate) fn numbered(run: RunIdentity, limits: Limits, first_lease: u64, key: u64) -> Self {
        let sampling = Sampling { key, share: limits.recompute };
        let registry = Arc::new(Metrics::new());
        let metrics = Arc::new(LearnerMetrics::new(&registry));
        Self {
            work: Work::new(first_lease, run.lease, sampling, metrics.clone()).hedging(limits.task.pure()),
            roster: Roster::new(limits.max_actors),
            control: Control::new(),
            status: RunStatusCache::new(),
            board: WeightsBoard::default(),
            events: Arc::default(),
            metrics,
            registry,
            decoders: Semaphore::new(magex_runtime::process::processors()),
            watchers: Arc::new(Semaphore::new(limits.max_watchers)),
            limits,
            run,
        }
    }

    pub(crate) fn lease_time(&self) -> Duration {
        self.run.lease
    }

    /// A permit for a stream of weights or events, held until the stream ends.
    pub(crate) fn watcher(&self) -> Result<OwnedSemaphorePermit, Status> {
        self.watchers.clone().try_acquire_owned().map_err(|_| {
            let problem = format!("watchers: the limit of {} streams is reached", self.limits.max_watchers);
            status::resource_exhausted(problem, Duration::from_secs(5))
        })
    }

    /// Blocks until the open plan ends. A drain lets the iteration finish while actors are connected; a shutdown does not.
    pub(crate) fn wait(&self, judge: &mut Judge) -> Result<CollectedPlan, CollectError> {
        self.work.wait(&mut TrainingThread { shared: self, judge })
    }

    /// [`Self::wait`] without waiting: `None` while the plan is open.
    #[cfg(test)]
    pub(crate) fn poll(&self, judge: &mut Judge) -> Option<Result<CollectedPlan, CollectError>> {
        self.work.poll(&mut TrainingThread { shared: self, judge })
    }

    /// Blocks until every second computation has ended.
    pub(crate) fn wait_for_checks(&self, judge: &mut Judge) -> Result<(), CollectError> {
        self.work.wait_for_checks(&mut TrainingThread { shared: self, judge })
    }

    /// Evicts an actor and discards what it computed.
    pub(crate) fn evict_now(&self, process: u64, reason: &str, why: Rejection) {
        self.metrics.rejected(why);
        self.roster.evict_now(process, reason);
        self.work.with_ledger(|ledger| ledger.checks.forget(process));
    }

    /// Asks the training thread to stop. A shutdown overrides a drain.
    pub(crate) fn stop(&self, reason: StopReason) {
        self.work.wake_after(|| self.control.request_stop(reason));
        self.control.stop_signal.cancel();
    }

    /// [`Self::stop`] at once, and ends every stream.
    pub(crate) fn close(&self) {
        self.stop(StopReason::Shutdown);
        self.control.closing.cancel();
    }

    /// Returns the leases of a session to the queue and removes it from the roster. The number of leases it held.
    pub(crate) fn remove_session(&self, session: SessionId) -> usize {
        let lost = self.work.with_ledger(|ledger| ledger.drop_actor(session));
        self.work.wake_after(|| self.roster.remove_session(session));
        lost
    }

    pub(crate) fn publish(&self, weights: Arc<Weights>) {
        self.metrics.weights_version.set(f64::from(weights.version.0));
        self.metrics.weights_bytes.set(weights.bytes.len() as f64);
        self.status.published(weights.version);
        self.board.publish(weights);
    }

    /// How long no shard has been done although actors hold some, and which, if that is much longer than usual.
    pub(crate) fn stalled(&self) -> Option<(Duration, String)> {
        let since = self.status.since_progress();
        let sessions = self.roster.sessions();
        self.work.inspect(|ledger| {
            let overdue = 2 * ledger.stalled(ShardKind::Train).max(ledger.stalled(ShardKind::Eval));
            if ledger.progress().1 == 0 || ledger.all_done() || since < overdue {
                return None;
            }
            let holders = sessions.iter().filter_map(|(session, actor)| {
                let oldest = ledger.oldest_of(*session)?;
                Some(format!("{} ({:.0} s)", actor.status.actor_id, oldest.since.elapsed().as_secs_f64()))
            });
            let holders: Vec<String> = holders.collect();
            (!holders.is_empty()).then(|| (since, holders.join(", ")))
        })
    }

    pub(crate) fn refresh_gauges(&self) {
        self.roster.refresh(&self.metrics);
        let now = tokio::time::Instant::now();
        self.metrics.oldest_lease.reset();
        self.metrics.hand_backs.reset();
        for (session, actor) in self.roster.sessions() {
            let name = [actor.status.actor_id.as_str()];
            let oldest = self.work.inspect(|ledger| ledger.oldest_of(session));
            let age = oldest.map_or(0.0, |oldest| now.saturating_duration_since(oldest.since).as_secs_f64());
            self.metrics.oldest_lease.with_label_values(&name).set(age);
            self.metrics.hand_backs.with_label_values(&name).set(actor.hand_backs.into());
        }
        let waiting = !self.status.finished();
        self.metrics.since_progress.set(if waiting { self.status.since_progress().as_secs_f64() } else { 0.0 });
        self.metrics.queue("events", self.events.len());
    }

    /// The answer of `GetRun`.
    pub(crate) fn run_status(&self) -> v1::RunStatus {
        let latest = self.board.latest();
        let sessions = self.roster.sessions();
        // One lock for the state, the counters and the leases, so that they agree with each other.
        self.work.inspect(|ledger| {
            let (done, total) = ledger.progress();
            let rows = sessions.into_iter().map(|(session, actor)| v1::ActorStatus {
                leases: ledger.leases_of(session) as u32,
                last_seen_ms: actor.last_seen.elapsed().as_millis() as u64,
                oldest_lease_seconds: ledger
                    .oldest_of(session)
                    .map_or(0.0, |oldest| oldest.since.elapsed().as_secs_f64()),
                hand_backs: actor.hand_backs,
                ..actor.status
            });
            let actors: Vec<v1::ActorStatus> = rows.collect();
            v1::RunStatus {
                run_id: self.run.run_id.0.clone(),
                name: self.run.name.clone(),
                task_fingerprint: self.run.task_fingerprint.clone(),
                state: self.run_state(actors.len(), ledger).into(),
                actors,
                ledger: Some(ledger.counters()),
                episodes: Some(ledger.episodes()),
                shards_done: done as u32,
                shards_total: total as u32,
                weights_version: latest.as_ref().map_or(0, |weights| weights.version.0),
                weights_sha256: latest.as_ref().map_or_else(String::new, |weights| weights.sha256.clone()),
                ..self.status.reported()
            }
        })
    }

    fn run_state(&self, actors: usize, ledger: &Ledger) -> v1::RunState {
        let (done, total) = ledger.progress();
        if self.status.finished() {
            v1::RunState::Finished
        } else if self.control.stop_requested().is_some() {
            v1::RunState::Draining
        } else if done >= total {
            v1::RunState::Training
        } else if actors == 0 {
            v1::RunState::WaitingForActors
        } else if ledger.plan().all(|shard| shard.kind == ShardKind::Eval) {
            v1::RunState::Evaluating
        } else {
            v1::RunState::Collecting
        }
    }
}

/// What the training thread needs while it waits.
struct TrainingThread<'a> {
    shared: &'a Shared,
    judge: &'a mut Judge,
}

impl Waiting for TrainingThread<'_> {
    fn stop(&self) -> Option<StopReason> {
        let stop = self.shared.control.stop_requested();
        stop.filter(|reason| *reason == StopReason::Shutdown || self.shared.roster.is_empty())
    }

    fn connected(&self) -> Vec<u64> {
        self.shared.roster.connected_processes()
    }

    fn decide(&mut self, check: &Check) -> Result<Option<Box<Conviction>>, CollectError> {
        let Check { shard, first, second, .. } = check;
        let computed = match self.shared.board.kept(shard.version) {
            Some(weights) => self.judge.digest(&self.shared.run.run_id, shard, &weights),
            None => Err(format!("weights version {} is gone", shard.version)),
        };
        let digest = match (computed, second) {
            (Ok(digest), _) => Some(digest),
            (Err(reason), None) => {
                tracing::debug!(reason, shard = describe(shard), actor = &*first.actor, "a result is not confirmed");
                None
            }
            (Err(reason), Some(second)) => {
                let (first, second) = (first.actor.to_string(), second.actor.to_string());
                return Err(CollectError::Undecided { shard: *shard, first, second, reason });
            }
        };
        let wrong = self.shared.work.with_ledger(|ledger| ledger.checks.decide(shard, digest.as_deref()));
        let mut conviction = None;
        for origin in wrong {
            let reason = format!("{}: another computation of it gives another result", describe(shard));
            tracing::error!(
                actor = &*origin.actor,
                process = origin.process,
                shard = describe(shard),
                sent = origin.digest,
                right = digest.as_deref(),
                "an actor computes wrong results; it is evicted, and what it computed is discarded"
            );
            self.shared.evict_now(origin.process, &reason, Rejection::Recomputed);
            let digest = digest.clone().unwrap_or_default();
            conviction.get_or_insert_with(|| Box::new(Conviction { origin, shard: *shard, digest, since: None }));
        }
        Ok(conviction)
    }
}
