//! Who works on what, and what became of it: a pure state machine without clock, threads or network.
//!
//! The learner opens a plan (the shards of an iteration); actors lease shards and complete them in any order and any number
//! of times; the results come out in the order of the plan, each exactly once. Every lease ends in exactly one way, and so
//! do the episodes of its shard: leased = trained + duplicate + expired + rejected + failed + outstanding.

use magex_core::ids::Shard;
use magex_core::trajectory::ShardResult;
use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};

/// Failures for good (not retryable) before which no shard is given up, and no actor is sent away for them.
pub const MAX_FAILURES: u32 = 3;

/// One connection of one actor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SessionId(pub u64);

/// Name of a lease, unique among all processes that ever served the run (with overwhelming likelihood).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct LeaseId(pub u64);

/// A shard handed out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Lease {
    /// Name of the lease.
    pub id: LeaseId,
    /// The work.
    pub shard: Shard,
}

/// What became of a result.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Verdict {
    /// Taken into the batch.
    Accepted,
    /// Done already, or of no open plan.
    Duplicate,
    /// Not usable; says why.
    Rejected(String),
}

/// What became of everything that was leased so far: of the shards, or of their episodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counters {
    /// Handed out, late results of forgotten leases included.
    pub leased: u64,
    /// Taken into a batch.
    pub trained: u64,
    /// Dropped: done already, or of no open plan.
    pub duplicate: u64,
    /// Lost with their actor.
    pub expired: u64,
    /// Refused: the result was not usable.
    pub rejected: u64,
    /// Given back by the actor.
    pub failed: u64,
    /// Still held.
    pub outstanding: u64,
}

impl Counters {
    /// What ended in no way or in two: always zero.
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

/// Shards and episodes, counted together so that neither can be forgotten.
#[derive(Debug, Default)]
struct Books {
    shards: Counters,
    episodes: Counters,
}

impl Books {
    fn leased(&mut self, episodes: u32) {
        self.shards.leased += 1;
        self.episodes.leased += u64::from(episodes);
    }

    fn ended(&mut self, fate: Fate, episodes: u32) {
        *self.shards.of(fate) += 1;
        *self.episodes.of(fate) += u64::from(episodes);
    }
}

/// A plan that cannot be opened.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PlanError {
    /// Nothing to do.
    #[error("the plan has no shards")]
    Empty,
    /// The same shard twice.
    #[error("the plan names shard {0} of iteration {1} twice")]
    Repeated(u32, u32),
    /// The one before is not complete.
    #[error("a plan is open with {done} of {total} shards done")]
    Open {
        /// Shards done.
        done: usize,
        /// Shards of the plan.
        total: usize,
    },
}

/// A shard that no actor can do.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GivenUp {
    /// Which.
    pub shard: Shard,
    /// What the last actor said.
    pub reason: String,
}

/// A failure for good: the actor says that it would meet it again.
#[derive(Debug, Clone, Copy)]
pub struct Failure<'a> {
    /// Name of the actor.
    pub actor: &'a str,
    /// Number of its process.
    pub process: u64,
    /// What it said.
    pub reason: &'a str,
    /// The processes of all actors that are connected.
    pub present: &'a [u64],
}

#[derive(Debug)]
struct Slot {
    shard: Shard,
    result: Option<ShardResult>,
    queued: bool,
    leases: u32,
    failures: u32,
    /// Processes and names of the actors at which it failed for good.
    failed_at: Vec<(u64, String)>,
}

impl Slot {
    /// Notes a failure for good; whether it is the shard that is to blame. One actor's failures say nothing: as many
    /// different ones must have met them, or everyone who is there. A process that is started anew under its old name is
    /// the same actor.
    fn fail(&mut self, failure: &Failure<'_>) -> bool {
        let Failure { actor, process, present, .. } = *failure;
        self.failures = self.failures.saturating_add(1);
        self.failed_at.retain(|(other, name)| *other != process && (name != actor || present.contains(other)));
        self.failed_at.push((process, actor.to_owned()));
        let actors: BTreeSet<&str> = self.failed_at.iter().map(|(_, name)| name.as_str()).collect();
        let everyone = present.iter().all(|here| self.failed_at.iter().any(|(process, _)| process == here));
        actors.len() >= MAX_FAILURES as usize || (everyone && self.failures >= MAX_FAILURES)
    }
}

#[derive(Debug, Clone, Copy)]
struct Held {
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
    held: BTreeMap<LeaseId, Held>,
    done: usize,
    books: Books,
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
            books: Books::default(),
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

    /// Hands out the next shard, if there is one to do.
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
            self.held.insert(id, Held { session, shard: slot.shard });
            self.books.leased(slot.shard.episodes);
            return Some(Lease { id, shard: slot.shard });
        }
    }

    /// Takes in a usable result. The result of a lease that is held no more (its actor had been given up, or the learner has
    /// been restarted since) is as good as any: a shard's result does not depend on who computes it.
    pub fn complete(&mut self, session: SessionId, lease: LeaseId, result: ShardResult) -> Verdict {
        let shard = *result.shard();
        if self.held_by(session, lease).is_some_and(|held| held.shard != shard) {
            self.reject(session, lease);
            return Verdict::Rejected("shard: not the one that was leased".to_owned());
        }
        if self.release(session, lease).is_none() {
            self.books.leased(shard.episodes);
        }
        match self.position.get(&shard).map(|&at| &mut self.plan[at]) {
            Some(slot) if slot.result.is_none() => {
                slot.result = Some(result);
                self.done += 1;
                self.books.ended(Fate::Trained, shard.episodes);
                Verdict::Accepted
            }
            _ => {
                self.books.ended(Fate::Duplicate, shard.episodes);
                Verdict::Duplicate
            }
        }
    }

    /// Notes that the result of a lease was not usable; the shard is to be done again, next.
    pub fn reject(&mut self, session: SessionId, lease: LeaseId) {
        // Of a lease that is held no more nobody knows how many episodes it had: it has none.
        let episodes = match self.release(session, lease) {
            Some(held) => {
                self.requeue(held.shard, true);
                held.shard.episodes
            }
            None => {
                self.books.leased(0);
                0
            }
        };
        self.books.ended(Fate::Rejected, episodes);
    }

    /// Takes a lease back from an actor that cannot do it now; it comes after the others.
    pub fn give_back(&mut self, session: SessionId, lease: LeaseId) {
        if let Some(held) = self.release(session, lease) {
            self.books.ended(Fate::Failed, held.shard.episodes);
            self.requeue(held.shard, false);
        }
    }

    /// Takes a lease back from an actor that could never do it; whether the actor held it. The shard is given up once it
    /// failed so at [`MAX_FAILURES`] different actors, or that often and at every actor that is there.
    pub fn fail(&mut self, session: SessionId, lease: LeaseId, failure: &Failure<'_>) -> bool {
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

    /// Takes back all leases of an actor that left or fell silent; they are the next to be handed out. How many there were.
    pub fn drop_actor(&mut self, session: SessionId) -> usize {
        let of_it: Vec<LeaseId> =
            self.held.iter().filter(|(_, held)| held.session == session).map(|(&id, _)| id).collect();
        // From the last to the first, so that the first is in front.
        for &lease in of_it.iter().rev() {
            if let Some(held) = self.release(session, lease) {
                self.books.ended(Fate::Expired, held.shard.episodes);
                self.requeue(held.shard, true);
            }
        }
        of_it.len()
    }

    /// The results in the order of the plan, once all are in; the plan is closed.
    pub fn take(&mut self) -> Option<Vec<ShardResult>> {
        if !self.is_complete() {
            return None;
        }
        let plan = std::mem::take(&mut self.plan);
        self.close();
        Some(plan.into_iter().filter_map(|slot| slot.result).collect())
    }

    /// Closes the plan without its results. Leases stay held until they end.
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
        Counters { outstanding: self.held.len() as u64, ..self.books.shards }
    }

    /// What became of the episodes of every lease so far.
    pub fn episodes(&self) -> Counters {
        let outstanding = self.held.values().map(|held| u64::from(held.shard.episodes)).sum();
        Counters { outstanding, ..self.books.episodes }
    }

    fn held_by(&self, session: SessionId, lease: LeaseId) -> Option<&Held> {
        self.held.get(&lease).filter(|held| held.session == session)
    }

    fn release(&mut self, session: SessionId, lease: LeaseId) -> Option<Held> {
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
