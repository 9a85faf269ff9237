//! What the training thread and the connections share.

use crate::collector::{CollectError, RunEvent, StopReason};
use crate::events::Events;
use crate::ingest::Limits;
use crate::ledger::{GivenUp, Ledger, PlanError, SessionId};
use crate::service::RunIdentity;
use crate::weights::{Board, Weights};
use magex_core::ids::{Shard, ShardKind};
use magex_core::trajectory::ShardResult;
use magex_proto::v1;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

/// A panic of another thread leaves our plain data usable.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// An actor as its connection sees it.
#[derive(Debug, Clone)]
pub(crate) struct ActorEntry {
    pub(crate) actor_id: String,
    pub(crate) incarnation: u64,
    pub(crate) address: String,
    pub(crate) threads: u32,
    pub(crate) shards_done: u64,
    pub(crate) last_seen: Instant,
    /// Ends the connection: the same process has connected again.
    pub(crate) replaced: CancellationToken,
}

#[derive(Debug, Default)]
struct Progress {
    iterations: u32,
    joint_env_steps: u64,
    success: Option<f32>,
    reward: Option<f32>,
    metrics_json: String,
    finished: bool,
}

#[derive(Debug)]
pub(crate) struct Shared {
    pub(crate) run: RunIdentity,
    pub(crate) limits: Limits,
    pub(crate) board: Board,
    pub(crate) events: Arc<Events>,
    pub(crate) actors: Mutex<BTreeMap<SessionId, ActorEntry>>,
    /// Ends every stream.
    pub(crate) closing: CancellationToken,
    started: Instant,
    sessions: AtomicU64,
    ledger: Mutex<Ledger>,
    /// The training thread waits here for the last shard, or for the end.
    settled: Condvar,
    /// Changes when there is work to hand out.
    work: watch::Sender<u64>,
    stop: Mutex<Option<StopReason>>,
    checkpoint: AtomicBool,
    progress: Mutex<Progress>,
}

impl Shared {
    pub(crate) fn new(run: RunIdentity, limits: Limits) -> Self {
        // The upper half differs between processes: the ledger never takes a lease of an earlier process for its own.
        let first_lease = magex_runtime::backoff::incarnation() << 32;
        Self {
            run,
            limits,
            board: Board::new(),
            events: Arc::new(Events::new()),
            actors: Mutex::default(),
            closing: CancellationToken::new(),
            started: Instant::now(),
            sessions: AtomicU64::new(0),
            ledger: Mutex::new(Ledger::new(first_lease)),
            settled: Condvar::new(),
            work: watch::Sender::new(0),
            stop: Mutex::default(),
            checkpoint: AtomicBool::new(false),
            progress: Mutex::default(),
        }
    }

    /// A number that no other connection has.
    pub(crate) fn next_session(&self) -> u64 {
        self.sessions.fetch_add(1, Ordering::Relaxed)
    }

    pub(crate) fn lease_time(&self) -> Duration {
        self.run.lease
    }

    /// Changes the ledger, and wakes whom the change concerns: actors when there is work, the trainer when it is done.
    pub(crate) fn with_ledger<T>(&self, change: impl FnOnce(&mut Ledger) -> T) -> T {
        let mut ledger = lock(&self.ledger);
        let before = ledger.queued();
        let value = change(&mut ledger);
        let more_work = ledger.queued() > before;
        let settled = ledger.is_complete() || ledger.given_up().is_some();
        drop(ledger);
        if settled {
            self.settled.notify_all();
        }
        if more_work {
            self.work.send_modify(|generation| *generation = generation.wrapping_add(1));
        }
        value
    }

    pub(crate) fn work(&self) -> watch::Receiver<u64> {
        self.work.subscribe()
    }

    pub(crate) fn open(&self, plan: Vec<Shard>) -> Result<(), PlanError> {
        self.with_ledger(|ledger| ledger.open(plan))
    }

    /// Blocks until the open plan is done, given up, or the process is told to stop.
    pub(crate) fn wait(&self) -> Result<Vec<ShardResult>, CollectError> {
        let mut ledger = lock(&self.ledger);
        loop {
            if let Some(results) = ledger.take() {
                return Ok(results);
            }
            if let Some(GivenUp { shard, reason }) = ledger.given_up().cloned() {
                ledger.abandon();
                return Err(CollectError::Shard { shard, reason });
            }
            // A drain lets the iteration finish; a shutdown does not.
            if self.stop_requested() == Some(StopReason::Shutdown) {
                ledger.abandon();
                return Err(CollectError::Stopped(StopReason::Shutdown));
            }
            if ledger.progress().1 == 0 {
                return Err(CollectError::Other("no plan is open".to_owned()));
            }
            ledger = self.settled.wait(ledger).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Asks the trainer to stop. A shutdown wins over a drain.
    pub(crate) fn stop(&self, reason: StopReason) {
        {
            // Under the ledger's lock, so that the trainer cannot miss it between looking and waiting.
            let _ledger = lock(&self.ledger);
            let mut stop = lock(&self.stop);
            if stop.is_none() || reason == StopReason::Shutdown {
                *stop = Some(reason);
            }
        }
        self.settled.notify_all();
    }

    pub(crate) fn stop_requested(&self) -> Option<StopReason> {
        lock(&self.stop).clone()
    }

    pub(crate) fn request_checkpoint(&self) {
        self.checkpoint.store(true, Ordering::Release);
    }

    pub(crate) fn take_checkpoint_request(&self) -> bool {
        self.checkpoint.swap(false, Ordering::AcqRel)
    }

    pub(crate) fn record(&self, event: RunEvent) {
        {
            let mut progress = lock(&self.progress);
            match &event {
                RunEvent::Iteration(report) => {
                    progress.iterations = report.iteration.0 + 1;
                    progress.joint_env_steps = report.joint_env_steps;
                    progress.success = report.success.or(progress.success);
                    progress.reward = report.reward.or(progress.reward);
                    progress.metrics_json.clone_from(&report.metrics_json);
                }
                RunEvent::Finished { .. } => progress.finished = true,
                RunEvent::Log(_) | RunEvent::Checkpoint { .. } => {}
            }
        }
        self.events.push(event);
    }

    /// Makes weights known. Iteration k uses version k: so many iterations are done, in this process or before it.
    pub(crate) fn publish(&self, weights: Arc<Weights>) {
        lock(&self.progress).iterations = weights.version.0;
        self.board.publish(weights);
    }

    pub(crate) fn finished(&self) -> bool {
        lock(&self.progress).finished
    }

    /// The iteration that is being worked on.
    pub(crate) fn current_iteration(&self) -> u32 {
        lock(&self.progress).iterations
    }

    fn state(&self, actors: usize, ledger: &Ledger) -> v1::RunState {
        let (done, total) = ledger.progress();
        if self.finished() {
            v1::RunState::Finished
        } else if self.stop_requested().is_some() {
            v1::RunState::Draining
        } else if total > 0 && done < total {
            if actors == 0 {
                v1::RunState::WaitingForActors
            } else if ledger.plan().all(|shard| shard.kind == ShardKind::Eval) {
                v1::RunState::Evaluating
            } else {
                v1::RunState::Collecting
            }
        } else {
            v1::RunState::Training
        }
    }

    pub(crate) fn status(&self) -> v1::RunStatus {
        let latest = self.board.latest();
        let actors = lock(&self.actors).clone();
        let ledger = lock(&self.ledger);
        let state = self.state(actors.len(), &ledger);
        let (done, total) = ledger.progress();
        let counters = ledger.counters();
        let rows = actors.iter().map(|(&session, actor)| v1::ActorStatus {
            actor_id: actor.actor_id.clone(),
            address: actor.address.clone(),
            leases: ledger.leases_of(session) as u32,
            shards_done: actor.shards_done,
            last_seen_ms: actor.last_seen.elapsed().as_millis() as u64,
            threads: actor.threads,
        });
        let actors = rows.collect();
        drop(ledger);
        let progress = lock(&self.progress);
        v1::RunStatus {
            run_id: self.run.run_id.0.clone(),
            name: self.run.name.clone(),
            state: state.into(),
            iteration: progress.iterations,
            joint_env_steps: progress.joint_env_steps,
            success: progress.success,
            reward: progress.reward,
            metrics_json: progress.metrics_json.clone(),
            actors,
            ledger: Some(v1::LedgerStatus {
                leased: counters.leased,
                trained: counters.trained,
                duplicate: counters.duplicate,
                expired: counters.expired,
                rejected: counters.rejected,
                failed: counters.failed,
                outstanding: counters.outstanding,
            }),
            shards_done: done as u32,
            shards_total: total as u32,
            weights_version: latest.as_ref().map_or(0, |weights| weights.version.0),
            weights_sha256: latest.map_or_else(String::new, |weights| weights.sha256.clone()),
            task_fingerprint: self.run.task_fingerprint.clone(),
            uptime_seconds: self.started.elapsed().as_secs_f64(),
        }
    }
}
