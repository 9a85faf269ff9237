//! The shards of a plan, their leases and their results: a pure state machine without clock, threads or network.
//!
//! The learner opens a plan (the shards of an iteration). Actors lease shards and complete them in any order and any number
//! of times. The results come out in the order of the plan, each exactly once. Every lease ends in exactly one way, and so do
//! the episodes of its shard: leased = trained + duplicate + expired + rejected + failed + outstanding.
//!
//! A shard has more than one lease at a time in two cases. *Hedged:* the queue is empty, an actor is idle, and a lease is late:
//! the shard is leased to the idle actor too, and the first result counts. *Checked:* a result is confirmed by a second
//! computation ([`checks`]).

pub(crate) mod checks;
mod late;
mod pace;
mod totals;

use self::checks::{Checks, Sampling};
use self::pace::Pace;
pub(crate) use self::totals::Counters;
use self::totals::{DUPLICATE, EXPIRED, FAILED, REJECTED, TRAINED, Totals, balanced};
use crate::origin::Origin;
use crate::run_events::CollectError;
use magex_core::error::FieldError;
use magex_core::ids::{Shard, ShardKind};
use magex_core::trajectory::ShardResult;
use magex_proto::v1::Verdict;
use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::time::Duration;
use tokio::time::Instant;

/// Permanent (not retryable) failures before a shard is given up or an actor is evicted.
pub(crate) const MAX_FAILURES: u32 = 3;

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct SessionId(pub(crate) u64);

/// Name of a lease, unique among all processes that ever served the run (with overwhelming likelihood).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct LeaseId(pub(crate) u64);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Lease {
    pub(crate) id: LeaseId,
    pub(crate) shard: Shard,
}

/// A session that has room for a shard.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Asker {
    pub(crate) session: SessionId,
    /// Id of the actor's process.
    pub(crate) process: u64,
    pub(crate) now: Instant,
}

/// A late lease, for the log.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct OldestLease {
    pub(crate) shard: Shard,
    pub(crate) since: Instant,
}

/// A permanent failure of a shard: the actor reports that a retry would fail too.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ShardFailure<'a> {
    pub(crate) actor: &'a str,
    /// Id of the actor's process.
    pub(crate) process: u64,
    pub(crate) reason: &'a str,
    /// The processes of all connected actors.
    pub(crate) connected: &'a [u64],
}

#[derive(Debug)]
struct Slot {
    shard: Shard,
    result: Option<(ShardResult, Origin)>,
    queued: bool,
    leases: u32,
    /// Leases that there have been; `leases` are out.
    granted: u32,
    failures: u32,
    /// Processes and names of the actors at which it failed permanently.
    failed_at: Vec<(u64, String)>,
    /// Processes that gave it back.
    given_back: Vec<u64>,
}

impl Slot {
    /// Whether it is kept for others that have room: this process gave it back, and one of them has not.
    fn avoids(&self, process: u64, others: impl FnOnce() -> Vec<u64>) -> bool {
        self.given_back.contains(&process) && others().iter().any(|other| !self.given_back.contains(other))
    }

    /// Records a permanent failure. Returns whether the shard is at fault rather than the actor: it failed at
    /// [`MAX_FAILURES`] different actors, or at every connected one. A restarted process with the same name is the same actor.
    fn fail(&mut self, failure: &ShardFailure<'_>) -> bool {
        let ShardFailure { actor, process, connected, .. } = *failure;
        self.failures = self.failures.saturating_add(1);
        self.failed_at.retain(|(other, name)| *other != process && (name != actor || connected.contains(other)));
        self.failed_at.push((process, actor.to_owned()));
        let actors: BTreeSet<&str> = self.failed_at.iter().map(|(_, name)| name.as_str()).collect();
        let at_all = connected.iter().all(|other| self.failed_at.iter().any(|(process, _)| process == other));
        actors.len() >= MAX_FAILURES as usize || (at_all && self.failures >= MAX_FAILURES)
    }
}

#[derive(Debug, Clone, Copy)]
struct HeldLease {
    session: SessionId,
    process: u64,
    shard: Shard,
    since: Instant,
}

#[derive(Debug)]
pub(crate) struct Ledger {
    next_lease: u64,
    plan: Vec<Slot>,
    position: HashMap<Shard, usize>,
    queue: VecDeque<usize>,
    held: BTreeMap<LeaseId, HeldLease>,
    done: usize,
    totals: Totals,
    /// A shard that fails at every actor, and the reason of its last failure.
    given_up: Option<(Shard, String)>,
    pace: Pace,
    /// Whether a late shard may be leased again before its lease has expired: right for pure shards only.
    pub(crate) hedges: bool,
    pub(crate) checks: Checks,
    /// Grows when there may be something new to lease.
    offers: u64,
}

impl Ledger {
    /// An empty ledger whose leases are numbered from `first_lease`. `lease` is the silence after which an actor loses its own.
    pub(crate) fn new(first_lease: u64, lease: Duration, sampling: Sampling) -> Self {
        Self {
            next_lease: first_lease,
            plan: Vec::new(),
            position: HashMap::new(),
            queue: VecDeque::new(),
            held: BTreeMap::new(),
            done: 0,
            totals: Totals::default(),
            given_up: None,
            pace: Pace::new(lease),
            hedges: true,
            checks: Checks::new(sampling),
            offers: 0,
        }
    }

    /// Opens a plan; the one before must have been taken or abandoned.
    pub(crate) fn open(&mut self, plan: Vec<Shard>) -> Result<(), CollectError> {
        if !self.plan.is_empty() {
            return Err(CollectError::OpenPlan(self.done, self.plan.len()));
        }
        if plan.is_empty() {
            return Err(CollectError::EmptyPlan);
        }
        let mut position = HashMap::new();
        for (at, shard) in plan.iter().enumerate() {
            if position.insert(*shard, at).is_some() {
                return Err(CollectError::Repeated(shard.index, shard.iteration.0));
            }
        }
        self.queue = (0..plan.len()).collect();
        self.position = position;
        let slot = |shard| Slot {
            shard,
            result: None,
            queued: true,
            leases: 0,
            granted: 0,
            failures: 0,
            failed_at: Vec::new(),
            given_back: Vec::new(),
        };
        self.plan = plan.into_iter().map(slot).collect();
        self.done = 0;
        self.given_up = None;
        self.offers += 1;
        Ok(())
    }

    /// The next shard for an actor: one to compute a second time, else one from the queue, else one whose lease is late.
    /// `others` are the processes of other actors that have room.
    pub(crate) fn lease(&mut self, asker: Asker, others: impl Fn() -> Vec<u64>) -> Option<Lease> {
        if let Some(shard) = self.checks.next(&asker, |shard| self.pace.late(shard.kind)) {
            let lease = self.grant(&asker, shard);
            self.checks.leased(lease.id, &shard, &asker);
            return Some(lease);
        }
        let at = self.queued_for(asker.process, &others).or_else(|| self.late_for(&asker, &others))?;
        let slot = &mut self.plan[at];
        (slot.leases, slot.granted) = (slot.leases + 1, slot.granted.saturating_add(1));
        Some(self.grant(&asker, self.plan[at].shard))
    }

    fn grant(&mut self, asker: &Asker, shard: Shard) -> Lease {
        let lease = Lease { id: LeaseId(self.next_lease), shard };
        self.next_lease = self.next_lease.wrapping_add(1);
        let Asker { session, process, now: since } = *asker;
        self.held.insert(lease.id, HeldLease { session, process, shard, since });
        self.totals.leased(shard.episodes);
        lease
    }

    /// Takes the first shard of the queue that this process may have.
    fn queued_for(&mut self, process: u64, others: &impl Fn() -> Vec<u64>) -> Option<usize> {
        let mut place = 0;
        while let Some(&at) = self.queue.get(place) {
            let slot = &mut self.plan[at];
            let done = slot.result.is_some();
            if !done && slot.avoids(process, others) {
                place += 1;
                continue;
            }
            slot.queued = false;
            self.queue.remove(place);
            if !done {
                return Some(at);
            }
        }
        None
    }

    /// Accepts a valid result, unless the shard is complete already or belongs to no open plan: that is a duplicate. A result
    /// whose lease has ended (its session was lost, or the learner restarted) counts too: a shard's result does not depend on
    /// which actor computes it.
    ///
    /// # Errors
    /// The result is rejected: the lease was for another shard.
    pub(crate) fn complete(
        &mut self,
        session: SessionId,
        lease: LeaseId,
        result: ShardResult,
        (origin, now): (Origin, Instant),
    ) -> Result<Verdict, FieldError> {
        let shard = *result.shard();
        if self.held_by(session, lease).is_some_and(|held| held.shard != shard) {
            self.reject(session, lease);
            return Err(FieldError::new("shard", "not the one that was leased"));
        }
        match self.release(session, lease) {
            Some(held) => self.pace.took(shard.kind, now.saturating_duration_since(held.since)),
            None => self.totals.leased(shard.episodes),
        }
        match self.position.get(&shard).map(|&at| &mut self.plan[at]) {
            Some(slot) if slot.result.is_none() => {
                self.offers += u64::from(self.checks.accepted(&shard, &origin, now));
                slot.result = Some((result, origin));
                self.done += 1;
                self.totals.ended(TRAINED, shard.episodes);
                Ok(Verdict::Accepted)
            }
            slot => {
                let known = slot.and_then(|slot| slot.result.as_ref()).map(|(_, origin)| origin);
                self.checks.compare(&shard, known, &origin, now);
                self.totals.ended(DUPLICATE, shard.episodes);
                Ok(Verdict::Duplicate)
            }
        }
    }

    /// Drops a result that was made with weights which the run has gone back on. Its shard is queued again if it is wanted.
    pub(crate) fn withdraw(&mut self, session: SessionId, lease: LeaseId) {
        match self.release(session, lease) {
            Some(held) => {
                self.totals.ended(DUPLICATE, held.shard.episodes);
                self.requeue(held.shard, true);
            }
            None => {
                self.totals.leased(0);
                self.totals.ended(DUPLICATE, 0);
            }
        }
    }

    /// Records an invalid result and queues the shard again, at the front.
    pub(crate) fn reject(&mut self, session: SessionId, lease: LeaseId) {
        if let Some(held) = self.release(session, lease) {
            self.requeue(held.shard, true);
            self.totals.ended(REJECTED, held.shard.episodes);
        } else {
            // The shard of a lease that has ended is unknown, so it counts no episodes.
            self.totals.leased(0);
            self.totals.ended(REJECTED, 0);
        }
    }

    /// Returns a lease from an actor that cannot process it now; the shard is queued at the end, and others get it first. False
    /// if the session does not hold it.
    pub(crate) fn give_back(&mut self, session: SessionId, lease: LeaseId) -> bool {
        let Some(held) = self.release(session, lease) else { return false };
        self.totals.ended(FAILED, held.shard.episodes);
        if let Some(&at) = self.position.get(&held.shard) {
            let given_back = &mut self.plan[at].given_back;
            given_back.retain(|process| *process != held.process);
            given_back.push(held.process);
        }
        self.requeue(held.shard, false);
        true
    }

    /// Returns a lease that failed permanently; false if the session does not hold it. The shard is given up after failing at
    /// [`MAX_FAILURES`] different actors, or that many times and at every connected actor.
    pub(crate) fn fail(&mut self, session: SessionId, lease: LeaseId, failure: &ShardFailure<'_>) -> bool {
        let Some(shard) = self.held_by(session, lease).map(|held| held.shard) else { return false };
        if let Some(&at) = self.position.get(&shard) {
            let slot = &mut self.plan[at];
            if slot.fail(failure) && slot.result.is_none() {
                self.given_up = Some((shard, failure.reason.to_owned()));
            }
        }
        self.give_back(session, lease);
        true
    }

    /// Returns all leases of a session that ended to the front of the queue. Returns their number.
    pub(crate) fn drop_actor(&mut self, session: SessionId) -> usize {
        let leases: Vec<LeaseId> =
            self.held.iter().filter(|(_, held)| held.session == session).map(|(&id, _)| id).collect();
        // From the last to the first, so that the first is in front.
        for &lease in leases.iter().rev() {
            if let Some(held) = self.release(session, lease) {
                self.totals.ended(EXPIRED, held.shard.episodes);
                self.requeue(held.shard, true);
            }
        }
        leases.len()
    }

    /// Closes a complete plan and returns its results in the order of the plan.
    pub(crate) fn take(&mut self) -> Option<Vec<(ShardResult, Origin)>> {
        if !self.is_complete() {
            return None;
        }
        let plan = std::mem::take(&mut self.plan);
        self.close();
        Some(plan.into_iter().filter_map(|slot| slot.result).collect())
    }

    /// Closes the plan without results. Leases stay held until they end.
    pub(crate) fn abandon(&mut self) {
        self.plan.clear();
        self.close();
    }

    /// Whether every shard is done, and so are the checks of earlier plans: their weights are gone when the next plan opens.
    pub(crate) fn is_complete(&self) -> bool {
        let iteration = self.plan.first().map_or(0, |slot| slot.shard.iteration.0);
        self.all_done() && !self.checks.open_before(iteration)
    }

    /// Whether every shard is done.
    pub(crate) fn all_done(&self) -> bool {
        !self.plan.is_empty() && self.done == self.plan.len()
    }

    /// Grows when there may be something new to lease.
    pub(crate) fn offers(&self) -> u64 {
        self.offers
    }

    /// Says that there may be something new to lease.
    pub(crate) fn offer(&mut self) {
        self.offers += 1;
    }

    /// Age from which a lease is late.
    pub(crate) fn late(&self, kind: ShardKind) -> Duration {
        self.pace.late(kind)
    }

    /// Age from which a lease is worth a line in the log.
    pub(crate) fn stalled(&self, kind: ShardKind) -> Duration {
        self.pace.stalled(kind)
    }

    /// The oldest lease of a session.
    pub(crate) fn oldest_of(&self, session: SessionId) -> Option<OldestLease> {
        let own = self.held.values().filter(|held| held.session == session);
        own.min_by_key(|held| held.since).map(|held| OldestLease { shard: held.shard, since: held.since })
    }

    /// Shards done, and shards of the open plan.
    pub(crate) fn progress(&self) -> (usize, usize) {
        (self.done, self.plan.len())
    }

    pub(crate) fn queued(&self) -> usize {
        self.queue.len()
    }

    pub(crate) fn plan(&self) -> impl Iterator<Item = &Shard> {
        self.plan.iter().map(|slot| &slot.shard)
    }

    pub(crate) fn given_up(&self) -> Option<&(Shard, String)> {
        self.given_up.as_ref()
    }

    pub(crate) fn leases_of(&self, session: SessionId) -> usize {
        self.held.values().filter(|held| held.session == session).count()
    }

    /// What became of every lease so far.
    pub(crate) fn counters(&self) -> Counters {
        balanced(self.totals.shards, self.held.len() as u64)
    }

    /// What became of the episodes of every lease so far.
    pub(crate) fn episodes(&self) -> Counters {
        let outstanding = self.held.values().map(|held| u64::from(held.shard.episodes)).sum();
        balanced(self.totals.episodes, outstanding)
    }

    fn held_by(&self, session: SessionId, lease: LeaseId) -> Option<&HeldLease> {
        self.held.get(&lease).filter(|held| held.session == session)
    }

    fn release(&mut self, session: SessionId, lease: LeaseId) -> Option<HeldLease> {
        self.held_by(session, lease)?;
        let held = self.held.remove(&lease)?;
        self.checks.released(lease);
        if let Some(&at) = self.position.get(&held.shard) {
            // A lease of an abandoned plan may name a shard that a later plan names again.
            self.plan[at].leases = self.plan[at].leases.saturating_sub(1);
        }
        Some(held)
    }

    fn requeue(&mut self, shard: Shard, front: bool) {
        // Even if it is not queued, it may be late for another actor now, or its check may be open again.
        self.offers += 1;
        let Some(&at) = self.position.get(&shard) else { return };
        let slot = &mut self.plan[at];
        if slot.result.is_some() || slot.queued || slot.leases > 0 {
            return;
        }
        slot.queued = true;
        if front {
            self.queue.push_front(at);
        } else {
            self.queue.push_back(at);
        }
    }

    fn close(&mut self) {
        self.position.clear();
        self.queue.clear();
        self.done = 0;
        self.given_up = None;
    }
}

#[cfg(test)]
mod tests;
