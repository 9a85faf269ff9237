//! The shards of a plan, their leases and their results: a pure state machine without clock, threads or network.
//!
//! The learner opens a plan (the shards of an iteration). Actors lease shards and complete them in any order and any number
//! of times. The results come out in the order of the plan, each exactly once. Every lease ends in exactly one way, and so do
//! the episodes of its shard: leased = trained + duplicate + expired + rejected + failed + outstanding.

use crate::run_events::PlanError;
use magex_core::error::FieldError;
use magex_core::ids::Shard;
use magex_core::trajectory::ShardResult;
use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};

/// Permanent (not retryable) failures before a shard is given up or an actor is evicted.
pub const MAX_FAILURES: u32 = 3;

/// One connection of one actor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SessionId(pub u64);

/// Name of a lease, unique among all processes that ever served the run (with overwhelming likelihood).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct LeaseId(pub u64);

/// A leased shard.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Lease {
    /// Name of the lease.
    pub id: LeaseId,
    /// The work.
    pub shard: Shard,
}

/// The verdict on a result.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Verdict {
    /// Taken into the batch.
    Accepted,
    /// The shard is complete already, or belongs to no open plan.
    Duplicate,
    /// The result is invalid.
    Rejected(FieldError),
}

/// Totals of the leases so far, by how they ended: of shards, or of their episodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counters {
    /// Leased, including late results of leases that the ledger no longer knows.
    pub leased: u64,
    /// Taken into a batch.
    pub trained: u64,
    /// Dropped: complete already, or of no open plan.
    pub duplicate: u64,
    /// Lost with their actor.
    pub expired: u64,
    /// Rejected: the result was invalid.
    pub rejected: u64,
    /// Returned by the actor without a result.
    pub failed: u64,
    /// Still held.
    pub outstanding: u64,
}

impl Counters {
    /// Leases that did not end in exactly one way: always zero.
    pub fn residual(&self) -> i128 {
        let ended = [self.trained, self.duplicate, self.expired, self.rejected, self.failed, self.outstanding];
        i128::from(self.leased) - ended.into_iter().map(i128::from).sum::<i128>()
    }

    fn of(&mut self, fate: Fate) -> &mut u64 {
        match fate {
            Fate::Trained => &mut self.trained,
            Fate::Duplicate => &mut self.duplicate,
            Fate::Expired => &mut self.expired,
            Fate::Rejected => &mut self.rejected,
            Fate::Failed => &mut self.failed,
        }
    }
}

/// How a lease ends.
#[derive(Debug, Clone, Copy)]
enum Fate {
    Trained,
    Duplicate,
    Expired,
    Rejected,
    Failed,
}

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
        *self.shards.of(fate) += 1;
        *self.episodes.of(fate) += u64::from(episodes);
    }
}

/// A shard that fails at every actor.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GivenUp {
    /// The shard.
    pub shard: Shard,
    /// The reason of the last failure.
    pub reason: String,
}

/// A permanent failure of a shard: the actor reports that a retry would fail too.
#[derive(Debug, Clone, Copy)]
pub struct ShardFailure<'a> {
    /// Name of the actor.
    pub actor: &'a str,
    /// Id of its process.
    pub process: u64,
    /// The reason it gave.
    pub reason: &'a str,
    /// The processes of all connected actors.
    pub connected: &'a [u64],
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

/// The state machine. See the module's documentation.
#[derive(Debug)]
pub struct Ledger {
    next_lease: u64,
    plan: Vec<Slot>,
    position: HashMap<Shard, usize>,
    queue: VecDeque<usize>,
    held: BTreeMap<LeaseId, HeldLease>,
    done: usize,
    totals: Totals,
    given_up: Option<GivenUp>,
}

impl Ledger {
    /// An empty ledger whose leases are numbered from `first_lease`.
    pub fn new(first_lease: u64) -> Self {
        Self {
            next_lease: first_lease,
            plan: Vec::new(),
            position: HashMap::new(),
            queue: VecDeque::new(),
            held: BTreeMap::new(),
            done: 0,
            totals: Totals::default(),
            given_up: None,
        }
    }

    /// Opens a plan; the one before must have been taken or abandoned.
    pub fn open(&mut self, plan: Vec<Shard>) -> Result<(), PlanError> {
        if !self.plan.is_empty() {
            return Err(PlanError::Open { done: self.done, total: self.plan.len() });
        }
        if plan.is_empty() {
            return Err(PlanError::Empty);
        }
        let position: HashMap<Shard, usize> = plan.iter().enumerate().map(|(at, &shard)| (shard, at)).collect();
        if position.len() != plan.len() {
            let twice = plan.iter().enumerate().find(|(at, shard)| position.get(shard) != Some(at));
            let (index, iteration) = twice.map_or((0, 0), |(_, shard)| (shard.index, shard.iteration.0));
            return Err(PlanError::Repeated(index, iteration));
        }
        self.queue = (0..plan.len()).collect();
        self.position = position;
        let slot = |shard| Slot { shard, result: None, queued: true, leases: 0, failures: 0, failed_at: Vec::new() };
        self.plan = plan.into_iter().map(slot).collect();
        self.done = 0;
        self.given_up = None;
        Ok(())
    }

    /// Leases the next queued shard, if there is one.
    pub fn lease(&mut self, session: SessionId) -> Option<Lease> {
        loop {
            let at = self.queue.pop_front()?;
            let slot = &mut self.plan[at];
            slot.queued = false;
            if slot.result.is_some() {
                continue;
            }
            slot.leases += 1;
            let id = LeaseId(self.next_lease);
            self.next_lease = self.next_lease.wrapping_add(1);
            self.held.insert(id, HeldLease { session, shard: slot.shard });
            self.totals.leased(slot.shard.episodes);
            return Some(Lease { id, shard: slot.shard });
        }
    }

    /// Accepts a valid result. A result whose lease has ended (its session was lost, or the learner restarted) counts too: a
    /// shard's result does not depend on which actor computes it.
    pub fn complete(&mut self, session: SessionId, lease: LeaseId, result: ShardResult) -> Verdict {
        let shard = *result.shard();
        if self.held_by(session, lease).is_some_and(|held| held.shard != shard) {
            self.reject(session, lease);
            return Verdict::Rejected(FieldError::new("shard", "not the one that was leased"));
        }
        if self.release(session, lease).is_none() {
            self.totals.leased(shard.episodes);
        }
        match self.position.get(&shard).map(|&at| &mut self.plan[at]) {
            Some(slot) if slot.result.is_none() => {
                slot.result = Some(result);
                self.done += 1;
                self.totals.ended(Fate::Trained, shard.episodes);
                Verdict::Accepted
            }
            _ => {
                self.totals.ended(Fate::Duplicate, shard.episodes);
                Verdict::Duplicate
            }
        }
    }

    /// Records an invalid result and queues the shard again, at the front.
    pub fn reject(&mut self, session: SessionId, lease: LeaseId) {
        // The shard of a lease that has ended is unknown, so it counts no episodes.
        let episodes = match self.release(session, lease) {
            Some(held) => {
                self.requeue(held.shard, true);
                held.shard.episodes
            }
            None => {
                self.totals.leased(0);
                0
            }
        };
        self.totals.ended(Fate::Rejected, episodes);
    }

    /// Returns a lease from an actor that cannot process it now; the shard is queued at the end.
    pub fn give_back(&mut self, session: SessionId, lease: LeaseId) {
        if let Some(held) = self.release(session, lease) {
            self.totals.ended(Fate::Failed, held.shard.episodes);
            self.requeue(held.shard, false);
        }
    }

    /// Returns a lease that failed permanently; false if the session does not hold it. The shard is given up after failing at
    /// [`MAX_FAILURES`] different actors, or that many times and at every connected actor.
    pub fn fail(&mut self, session: SessionId, lease: LeaseId, failure: &ShardFailure<'_>) -> bool {
        let Some(shard) = self.held_by(session, lease).map(|held| held.shard) else { return false };
        if let Some(&at) = self.position.get(&shard) {
            let slot = &mut self.plan[at];
            if slot.fail(failure) && slot.result.is_none() {
                self.given_up = Some(GivenUp { shard, reason: failure.reason.to_owned() });
            }
        }
        self.give_back(session, lease);
        true
    }

    /// Returns all leases of a session that ended to the front of the queue. Returns their number.
    pub fn drop_actor(&mut self, session: SessionId) -> usize {
        let leases: Vec<LeaseId> =
            self.held.iter().filter(|(_, held)| held.session == session).map(|(&id, _)| id).collect();
        // From the last to the first, so that the first is in front.
        for &lease in leases.iter().rev() {
            if let Some(held) = self.release(session, lease) {
                self.totals.ended(Fate::Expired, held.shard.episodes);
                self.requeue(held.shard, true);
            }
        }
        leases.len()
    }

    /// Closes a complete plan and returns its results in the order of the plan.
    pub fn take(&mut self) -> Option<Vec<ShardResult>> {
        if !self.is_complete() {
            return None;
        }
        let plan = std::mem::take(&mut self.plan);
        self.close();
        Some(plan.into_iter().filter_map(|slot| slot.result).collect())
    }

    /// Closes the plan without results. Leases stay held until they end.
    pub fn abandon(&mut self) {
        self.plan.clear();
        self.close();
    }

    /// All shards of the open plan are done.
    pub fn is_complete(&self) -> bool {
        !self.plan.is_empty() && self.done == self.plan.len()
    }

    /// Shards done, and shards of the open plan.
    pub fn progress(&self) -> (usize, usize) {
        (self.done, self.plan.len())
    }

    /// Shards that wait to be leased.
    pub fn queued(&self) -> usize {
        self.queue.len()
    }

    /// The shards of the open plan.
    pub fn plan(&self) -> impl Iterator<Item = &Shard> {
        self.plan.iter().map(|slot| &slot.shard)
    }

    /// The shard that no actor can do, if there is one.
    pub fn given_up(&self) -> Option<&GivenUp> {
        self.given_up.as_ref()
    }

    /// Leases that an actor holds.
    pub fn leases_of(&self, session: SessionId) -> usize {
        self.held.values().filter(|held| held.session == session).count()
    }

    /// What became of every lease so far.
    pub fn counters(&self) -> Counters {
        Counters { outstanding: self.held.len() as u64, ..self.totals.shards }
    }

    /// What became of the episodes of every lease so far.
    pub fn episodes(&self) -> Counters {
        let outstanding = self.held.values().map(|held| u64::from(held.shard.episodes)).sum();
        Counters { outstanding, ..self.totals.episodes }
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
