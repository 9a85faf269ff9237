//! The actors of the run: connected sessions, actors that are missing, and processes that were evicted.

use crate::serve::ledger::SessionId;
use crate::serve::lock_order::{OrderedMutex, Rank};
use crate::serve::metrics::LearnerMetrics;
use magex_proto::v1;
use magex_runtime::status;
use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;
use tokio::sync::mpsc::WeakSender;
use tokio::sync::watch;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// A missing actor counts as expected for this time.
const MISSING_TIME: Duration = Duration::from_secs(600);
const MAX_MISSING: usize = 1024;
const MAX_EVICTED: usize = 1024;

/// One session, as the rest of the service sees it.
#[derive(Debug, Clone)]
pub(crate) struct ActorEntry {
    /// Without its leases, which the ledger knows, and without the age of its last message.
    pub(crate) status: v1::ActorStatus,
    pub(crate) process_id: u64,
    pub(crate) last_seen: Instant,
    /// Ends the session: the same process has connected again.
    pub(crate) replaced: CancellationToken,
    /// Ends the session with this reason: the actor is evicted.
    pub(crate) eviction: watch::Sender<Option<String>>,
    /// Whether it would take another lease.
    pub(crate) has_room: bool,
    /// Leases given back in a row.
    pub(crate) hand_backs: u32,
    pub(crate) outbound: WeakSender<Result<v1::RolloutResponse, Status>>,
}

impl ActorEntry {
    fn queued_messages(&self) -> usize {
        self.outbound.upgrade().map_or(0, |queue| queue.max_capacity() - queue.capacity())
    }
}

#[derive(Debug, Default)]
struct Members {
    connected: BTreeMap<SessionId, ActorEntry>,
    /// Names of actors that left, and when.
    missing: BTreeMap<String, Instant>,
    /// Evicted processes, oldest first. A restarted actor has another process id.
    evicted: VecDeque<u64>,
}

impl Members {
    /// Processes of the connected actors. An evicted process stops counting immediately, before its session ends.
    fn processes(&self) -> impl Iterator<Item = u64> {
        self.connected.values().map(|actor| actor.process_id).filter(|process| !self.evicted.contains(process))
    }

    fn evict(&mut self, process_id: u64) {
        self.evicted.push_back(process_id);
        if self.evicted.len() > MAX_EVICTED {
            self.evicted.pop_front();
        }
    }
}

#[derive(Debug)]
pub(crate) struct Roster {
    members: OrderedMutex<Members>,
    max_actors: usize,
    next_session: AtomicU64,
}

impl Roster {
    pub(crate) fn new(max_actors: usize) -> Self {
        let members = OrderedMutex::new(Rank::Roster, Members::default());
        Self { members, max_actors, next_session: AtomicU64::new(0) }
    }

    /// Registers a session. It replaces sessions of the same process.
    ///
    /// # Errors
    /// The process was evicted, or the limit of actors is reached.
    pub(crate) fn join(&self, actor: ActorEntry) -> Result<SessionId, Status> {
        let mut members = self.members.lock();
        if members.evicted.contains(&actor.process_id) {
            return Err(Status::failed_precondition(
                "process_id: this actor process was evicted for invalid results or failed shards; check its log, then \
                 restart it",
            ));
        }
        for old in members.connected.values().filter(|old| old.process_id == actor.process_id) {
            old.replaced.cancel();
        }
        let staying = members.connected.values().filter(|old| !old.replaced.is_cancelled()).count();
        if staying >= self.max_actors {
            let problem = format!("actors: the limit of {} connected actors is reached", self.max_actors);
            return Err(status::resource_exhausted(problem, Duration::from_secs(5)));
        }
        let id = SessionId(self.next_session.fetch_add(1, Ordering::Relaxed));
        members.missing.remove(&actor.status.actor_id);
        members.connected.insert(id, actor);
        Ok(id)
    }

    pub(crate) fn remove_session(&self, session: SessionId) {
        self.members.lock().connected.remove(&session);
    }

    /// Records that an actor is missing, unless it has another session.
    pub(crate) fn mark_missing(&self, name: &str) {
        let mut members = self.members.lock();
        let connected = members.connected.values().any(|actor| actor.status.actor_id == name);
        if !connected && members.missing.len() < MAX_MISSING {
            members.missing.insert(name.to_owned(), Instant::now());
        }
    }

    /// Changes the entry of a session, unless it has ended.
    pub(crate) fn update(&self, session: SessionId, change: impl FnOnce(&mut ActorEntry)) {
        if let Some(actor) = self.members.lock().connected.get_mut(&session) {
            change(actor);
        }
    }

    /// Processes of the connected actors, without evicted ones.
    pub(crate) fn connected_processes(&self) -> Vec<u64> {
        self.members.lock().processes().collect()
    }

    pub(crate) fn evict(&self, process_id: u64) {
        self.members.lock().evict(process_id);
    }

    /// [`Self::evict`], and ends the process's session if it has one.
    pub(crate) fn evict_now(&self, process_id: u64, reason: &str) {
        let mut members = self.members.lock();
        members.evict(process_id);
        for actor in members.connected.values().filter(|actor| actor.process_id == process_id) {
            actor.eviction.send_replace(Some(reason.to_owned()));
        }
    }

    /// Processes of other actors that would take a lease.
    pub(crate) fn with_room(&self, except: u64) -> Vec<u64> {
        let members = self.members.lock();
        let others = members.connected.values().filter(|actor| actor.has_room && actor.process_id != except);
        others.map(|actor| actor.process_id).collect()
    }

    /// [`Self::evict`], unless no other process is connected. An evicted process stops counting immediately, so that
    /// concurrent evictions cannot remove the last actor.
    pub(crate) fn evict_if_others_remain(&self, process_id: u64) -> bool {
        let mut members = self.members.lock();
        let others = members.processes().any(|other| other != process_id);
        if others {
            members.evict(process_id);
        }
        others
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.members.lock().connected.is_empty()
    }

    pub(crate) fn sessions(&self) -> Vec<(SessionId, ActorEntry)> {
        self.members.lock().connected.iter().map(|(id, actor)| (*id, actor.clone())).collect()
    }

    /// Forgets actors that have been missing for too long, and sets the gauges of the others.
    pub(crate) fn refresh(&self, metrics: &LearnerMetrics) {
        let mut members = self.members.lock();
        members.missing.retain(|_, since| since.elapsed() < MISSING_TIME);
        let connected = members.connected.len();
        metrics.actors_live.set(connected as f64);
        metrics.actors_expected.set((connected + members.missing.len()) as f64);
        metrics.actor_threads.set(members.connected.values().map(|actor| f64::from(actor.status.threads)).sum());
        metrics.queue("actors", members.connected.values().map(ActorEntry::queued_messages).sum());
    }
}
