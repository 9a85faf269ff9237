//! What the training thread and the connections share.

use crate::report::shard_timing::Tally;
use crate::run_events::{CollectError, IterationReport, RunEvent, StopReason};
use crate::run_identity::RunIdentity;
use crate::serve::events::Events;
use crate::serve::ledger::{Counters, GivenUp, Ledger, PlanError, SessionId};
use crate::serve::metrics::LearnerGauges;
use crate::serve::validate::Limits;
use crate::serve::weights_board::{Board, Weights};
use magex_core::ids::{Shard, ShardKind, WeightsVersion};
use magex_core::trajectory::ShardResult;
use magex_proto::v1;
use magex_runtime::metrics::Metrics;
use magex_runtime::status;
use magex_runtime::sync::lock;
use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::mpsc::WeakSender;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};
use tokio_util::sync::CancellationToken;
use tonic::Status;
use tracing::Span;

/// A lost actor is expected back for so long.
const MISSED: Duration = Duration::from_secs(600);
/// Lost actors that are remembered.
const MOST_MISSED: usize = 1024;
/// Processes that are remembered as sent away.
const SENT_AWAY: usize = 1024;

/// An actor as its connection sees it.
#[derive(Debug, Clone)]
pub(crate) struct ActorEntry {
    pub(crate) actor_id: String,
    pub(crate) incarnation: u64,
    pub(crate) address: String,
    pub(crate) threads: u32,
    pub(crate) shards_done: u64,
    /// Of the latest result.
    pub(crate) weights_version: Option<WeightsVersion>,
    pub(crate) last_seen: Instant,
    /// Ends the connection: the same process has connected again.
    pub(crate) replaced: CancellationToken,
    /// The queue of what it is to be told.
    pub(crate) outbound: WeakSender<Result<v1::RolloutResponse, Status>>,
}

impl ActorEntry {
    /// Messages that wait to be sent to it.
    fn waiting(&self) -> usize {
        self.outbound.upgrade().map_or(0, |queue| queue.max_capacity() - queue.capacity())
    }
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

impl Progress {
    fn take(&mut self, report: &IterationReport) {
        self.iterations = report.iteration.0;
        self.joint_env_steps = report.joint_env_steps;
        self.success = report.success.or(self.success);
        self.reward = report.reward.or(self.reward);
        self.metrics_json.clone_from(&report.metrics_json);
    }
}

#[derive(Debug)]
pub(crate) struct Shared {
    pub(crate) run: RunIdentity,
    pub(crate) limits: Limits,
    pub(crate) board: Board,
    pub(crate) events: Arc<Events>,
    pub(crate) actors: Mutex<BTreeMap<SessionId, ActorEntry>>,
    /// Actors that are gone, by name, and since when.
    missed: Mutex<BTreeMap<String, Instant>>,
    pub(crate) metrics: Arc<Metrics>,
    pub(crate) gauges: LearnerGauges,
    pub(crate) tally: Mutex<Tally>,
    /// The span of the iteration that is being collected.
    pub(crate) trace: Mutex<Span>,
    /// Ends every stream.
    pub(crate) closing: CancellationToken,
    /// The run is complete: there is nothing left to lease.
    pub(crate) complete: CancellationToken,
    /// A place for every thread that decodes a result: more than processors would only hold memory.
    pub(crate) decoders: Semaphore,
    /// A place for everyone who watches weights or events.
    watchers: Arc<Semaphore>,
    /// Processes that were sent away. Whoever starts anew has another number.
    sent_away: Mutex<VecDeque<u64>>,
    /// Held while it is decided who goes and who stays.
    leaving: Mutex<()>,
    started: Instant,
    sessions: AtomicU64,
    ledger: Mutex<Ledger>,
    /// The training thread waits here for the last shard, or for the end.
    settled: Condvar,
    /// Changes when there is work to hand out.
    work: watch::Sender<u64>,
    stop: Mutex<Option<StopReason>>,
    /// Cancelled with the first reason to stop.
    told: CancellationToken,
    checkpoint: AtomicBool,
    progress: Mutex<Progress>,
}

impl Shared {
    pub(crate) fn new(run: RunIdentity, limits: Limits) -> Self {
        // The upper half differs between processes: the ledger never takes a lease of an earlier process for its own.
        let first_lease = magex_runtime::backoff::incarnation() << 32;
        let metrics = Arc::new(Metrics::new());
        let gauges = LearnerGauges::new(&metrics);
        let watchers = Arc::new(Semaphore::new(limits.max_watchers));
        Self {
            run,
            limits,
            board: Board::new(),
            events: Arc::new(Events::new()),
            actors: Mutex::default(),
            missed: Mutex::default(),
            metrics,
            gauges,
            tally: Mutex::default(),
            trace: Mutex::new(Span::none()),
            closing: CancellationToken::new(),
            complete: CancellationToken::new(),
            decoders: Semaphore::new(magex_runtime::process::processors()),
            watchers,
            sent_away: Mutex::default(),
            leaving: Mutex::default(),
            started: Instant::now(),
            sessions: AtomicU64::new(0),
            ledger: Mutex::new(Ledger::new(first_lease)),
            settled: Condvar::new(),
            work: watch::Sender::new(0),
            stop: Mutex::default(),
            told: CancellationToken::new(),
            checkpoint: AtomicBool::new(false),
            progress: Mutex::default(),
        }
    }

    /// A number that no other connection has.
    pub(crate) fn next_session(&self) -> u64 {
        self.sessions.fetch_add(1, Ordering::Relaxed)
    }

    /// A place for a watcher, held as long as its stream.
    pub(crate) fn watcher(&self) -> Result<OwnedSemaphorePermit, Status> {
        self.watchers.clone().try_acquire_owned().map_err(|_| {
            let limit = self.limits.max_watchers;
            status::resource_exhausted(format!("watchers: all {limit} places are taken"), Duration::from_secs(5))
        })
    }

    /// The processes of the actors that are here, without those that were told to go.
    pub(crate) fn present(&self) -> Vec<u64> {
        let actors = lock(&self.actors);
        let sent_away = lock(&self.sent_away);
        actors.values().map(|actor| actor.incarnation).filter(|process| !sent_away.contains(process)).collect()
    }

    /// Keeps a process away whose results are not usable, or that has none.
    pub(crate) fn send_away(&self, incarnation: u64) {
        let mut sent_away = lock(&self.sent_away);
        sent_away.push_back(incarnation);
        if sent_away.len() > SENT_AWAY {
            sent_away.pop_front();
        }
    }

    /// [`Self::send_away`], unless nobody else is here. Whoever is told to go counts no more from that moment on, not only
    /// from when its connection has ended: of several that are as useless as each other, one stays.
    pub(crate) fn send_away_if_others_stay(&self, incarnation: u64) -> bool {
        let _one_at_a_time = lock(&self.leaving);
        let others = self.present().iter().any(|process| *process != incarnation);
        if others {
            self.send_away(incarnation);
        }
        others
    }

    pub(crate) fn was_sent_away(&self, incarnation: u64) -> bool {
        lock(&self.sent_away).contains(&incarnation)
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
        let shards = ledger.counters();
        self.gauges.ledger(&shards, &ledger.episodes(), ledger.queued());
        lock(&self.tally).held(shards.outstanding, Instant::now());
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
        *lock(&self.trace) = Span::current();
        self.with_ledger(|ledger| {
            ledger.open(plan)?;
            lock(&self.tally).open();
            Ok(())
        })
    }

    /// Notes that an actor is gone, unless it is here on another connection.
    pub(crate) fn miss(&self, name: &str) {
        if lock(&self.actors).values().any(|actor| actor.actor_id == name) {
            return;
        }
        let mut missed = lock(&self.missed);
        if missed.len() < MOST_MISSED {
            missed.insert(name.to_owned(), Instant::now());
        }
    }

    /// Notes that an actor is here.
    pub(crate) fn found(&self, name: &str) {
        lock(&self.missed).remove(name);
    }

    /// Sets the metrics that are only known by looking.
    pub(crate) fn look(&self) {
        let (live, threads, waiting) = {
            let actors = lock(&self.actors);
            let sum = |f: fn(&ActorEntry) -> usize| actors.values().map(f).sum::<usize>();
            (actors.len(), sum(|a| a.threads as usize), sum(ActorEntry::waiting))
        };
        let missed = {
            let mut missed = lock(&self.missed);
            missed.retain(|_, since| since.elapsed() < MISSED);
            missed.len()
        };
        self.gauges.actors_live.set(live as f64);
        self.gauges.actors_expected.set((live + missed) as f64);
        self.gauges.actor_threads.set(threads as f64);
        self.gauges.queue("actors", waiting);
        self.gauges.queue("events", self.events.len());
    }

    /// Blocks until the open plan is done, given up, or the process is told to stop.
    pub(crate) fn wait(&self) -> Result<Vec<ShardResult>, CollectError> {
        let mut ledger = lock(&self.ledger);
        loop {
            if let Some(results) = ledger.take() {
                self.end_trace();
                return Ok(results);
            }
            if let Some(GivenUp { shard, reason }) = ledger.given_up().cloned() {
                ledger.abandon();
                self.end_trace();
                return Err(CollectError::Shard { shard, reason });
            }
            // A drain lets the iteration finish if there is anybody to finish it; a shutdown does not.
            let stop = self.stop_requested();
            if let Some(reason) = stop.filter(|r| *r == StopReason::Shutdown || lock(&self.actors).is_empty()) {
                ledger.abandon();
                self.end_trace();
                return Err(CollectError::Stopped(reason));
            }
            if ledger.progress().1 == 0 {
                return Err(CollectError::Other("no plan is open".to_owned()));
            }
            ledger = self.settled.wait(ledger).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Lets go of the iteration's span, which ends, and is exported, with the last that holds it.
    fn end_trace(&self) {
        *lock(&self.trace) = Span::none();
    }

    /// Takes an actor off the list, and wakes the trainer, which may wait in vain from now on.
    pub(crate) fn left(&self, session: SessionId) {
        {
            // Under the ledger's lock, so that the trainer cannot miss it between looking and waiting.
            let _ledger = lock(&self.ledger);
            lock(&self.actors).remove(&session);
        }
        self.settled.notify_all();
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
        self.told.cancel();
    }

    /// Somebody asked the learner to stop.
    pub(crate) fn told(&self) -> &CancellationToken {
        &self.told
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
        let finished = matches!(event, RunEvent::Finished { .. });
        {
            let mut progress = lock(&self.progress);
            match &event {
                RunEvent::Iteration(report) => progress.take(report),
                RunEvent::Finished { .. } => progress.finished = true,
                RunEvent::Log(_) | RunEvent::Checkpoint { .. } => {}
            }
        }
        self.events.push(event);
        if finished {
            self.complete.cancel();
        }
    }

    /// Notes how the run stood before this process, without telling it to watchers as something new.
    pub(crate) fn reported(&self, report: &IterationReport) {
        lock(&self.progress).take(report);
    }

    /// Makes weights known. Iteration k uses version k: so many iterations are done, in this process or before it.
    pub(crate) fn publish(&self, weights: Arc<Weights>) {
        self.gauges.weights_version.set(f64::from(weights.version.0));
        self.gauges.weights_bytes.set(weights.bytes.len() as f64);
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
        let (counters, episodes) = (ledger.counters(), ledger.episodes());
        let rows = actors.iter().map(|(&session, actor)| v1::ActorStatus {
            actor_id: actor.actor_id.clone(),
            address: actor.address.clone(),
            leases: ledger.leases_of(session) as u32,
            shards_done: actor.shards_done,
            last_seen_ms: actor.last_seen.elapsed().as_millis() as u64,
            threads: actor.threads,
            weights_version: actor.weights_version.map(|version| version.0),
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
            ledger: Some(books(&counters)),
            episodes: Some(books(&episodes)),
            shards_done: done as u32,
            shards_total: total as u32,
            weights_version: latest.as_ref().map_or(0, |weights| weights.version.0),
            weights_sha256: latest.map_or_else(String::new, |weights| weights.sha256.clone()),
            task_fingerprint: self.run.task_fingerprint.clone(),
            uptime_seconds: self.started.elapsed().as_secs_f64(),
        }
    }
}

fn books(counters: &Counters) -> v1::LedgerStatus {
    v1::LedgerStatus {
        leased: counters.leased,
        trained: counters.trained,
        duplicate: counters.duplicate,
        expired: counters.expired,
        rejected: counters.rejected,
        failed: counters.failed,
        outstanding: counters.outstanding,
        residual: counters.residual() as i64,
    }
}
