//! The shards of a plan, their leases and their results: a pure state machine without clock, threads or network.
//!
//! The learner opens a plan (the shards of an iteration). Actors lease shards and complete them in any order and any number
//! of times. The results come out in the order of the plan, each exactly once. Every lease ends in exactly one way, and so do
//! the episodes of its shard: leased = trained + duplicate + expired + rejected + failed + outstanding.

use crate::run_events::CollectError;
use magex_core::error::FieldError;
use magex_core::ids::Shard;
use magex_core::trajectory::ShardResult;
use magex_proto::v1::{LedgerStatus, Verdict};
use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};

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

/// Totals of the leases so far, by how they ended: of shards, or of their episodes. `leased` includes late results of leases
/// that the ledger no longer knows.
pub(crate) type Counters = LedgerStatus;

/// The total that a lease is counted in when it ends.
type Fate = fn(&mut Counters) -> &mut u64;

const TRAINED: Fate = |totals| &mut totals.trained;
const DUPLICATE: Fate = |totals| &mut totals.duplicate;
const EXPIRED: Fate = |totals| &mut totals.expired;
const REJECTED: Fate = |totals| &mut totals.rejected;
const FAILED: Fate = |totals| &mut totals.failed;

/// Totals of shards and of episodes, counted together so that neither can be forgotten.
#[derive(Debug, Default)]
struct Totals {
    shards: Counters,
    episodes: Counters,
}

impl Totals {
    fn leased(&mut self, episodes: u32) {
        self.shards.leased += 1;
        self.episodes.leased += u64::from(episodes);
    }

    fn ended(&mut self, fate: Fate, episodes: u32) {
        *fate(&mut self.shards) += 1;
        *fate(&mut self.episodes) += u64::from(episodes);
    }
}

/// Totals with what is held now and what is left over, which is always zero: every lease ends in exactly one way.
fn balanced(totals: Counters, outstanding: u64) -> Counters {
    let Counters { leased, trained, duplicate, expired, rejected, failed, .. } = totals;
    let ended = trained + duplicate + expired + rejected + failed + outstanding;
    Counters { outstanding, residual: leased.wrapping_sub(ended).cast_signed(), ..totals }
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
    result: Option<ShardResult>,
    queued: bool,
    leases: u32,
    failures: u32,
    /// Processes and names of the actors at which it failed permanently.
    failed_at: Vec<(u64, String)>,
}

impl Slot {
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
    shard: Shard,
}

#[derive(Debug, Default)]
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
}

impl Ledger {
    /// An empty ledger whose leases are numbered from `first_lease`.
    pub(crate) fn new(first_lease: u64) -> Self {
        Self { next_lease: first_lease, ..Self::default() }
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
        let slot = |shard| Slot { shard, result: None, queued: true, leases: 0, failures: 0, failed_at: Vec::new() };
        self.plan = plan.into_iter().map(slot).collect();
        self.done = 0;
        self.given_up = None;
        Ok(())
    }

    pub(crate) fn lease(&mut self, session: SessionId) -> Option<Lease> {
        loop {
            let at = self.queue.pop_front()?;
            let slot = &mut self.plan[at];
            slot.queued = false;
            if slot.result.is_some() {
                continue;
            }
            slot.leases += 1;
            let lease = Lease { id: LeaseId(self.next_lease), shard: slot.shard };
            self.next_lease = self.next_lease.wrapping_add(1);
            self.held.insert(lease.id, HeldLease { session, shard: lease.shard });
            self.totals.leased(lease.shard.episodes);
            return Some(lease);
        }
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
    ) -> Result<Verdict, FieldError> {
        let shard = *result.shard();
        if self.held_by(session, lease).is_some_and(|held| held.shard != shard) {
            self.reject(session, lease);
            return Err(FieldError::new("shard", "not the one that was leased"));
        }
        if self.release(session, lease).is_none() {
            self.totals.leased(shard.episodes);
        }
        match self.position.get(&shard).map(|&at| &mut self.plan[at]) {
            Some(slot) if slot.result.is_none() => {
                slot.result = Some(result);
                self.done += 1;
                self.totals.ended(TRAINED, shard.episodes);
                Ok(Verdict::Accepted)
            }
            _ => {
                self.totals.ended(DUPLICATE, shard.episodes);
                Ok(Verdict::Duplicate)
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

    /// Returns a lease from an actor that cannot process it now; the shard is queued at the end.
    pub(crate) fn give_back(&mut self, session: SessionId, lease: LeaseId) {
        if let Some(held) = self.release(session, lease) {
            self.totals.ended(FAILED, held.shard.episodes);
            self.requeue(held.shard, false);
        }
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
    pub(crate) fn take(&mut self) -> Option<Vec<ShardResult>> {
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

    pub(crate) fn is_complete(&self) -> bool {
        !self.plan.is_empty() && self.done == self.plan.len()
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
        if let Some(&at) = self.position.get(&held.shard) {
            // A lease of an abandoned plan may name a shard that a later plan names again.
            self.plan[at].leases = self.plan[at].leases.saturating_sub(1);
        }
        Some(held)
    }

    fn requeue(&mut self, shard: Shard, front: bool) {
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
