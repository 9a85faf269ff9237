//! Trust, but recompute: some shards are computed a second time, by another actor, and the two results compared by digest.
//!
//! Shards are pure, so two results that differ prove that one of them is wrong; the learner's host computes the shard a third
//! time and so finds out which. A check outlives the plan of its shard by at most one plan, so that an iteration does not wait
//! for it.

use super::{Asker, LeaseId};
use crate::origin::Origin;
use magex_core::ids::Shard;
use magex_core::rng::{Key, Purpose};
use std::collections::HashMap;
use std::time::Duration;
use tokio::time::Instant;

/// Results of a new process that are all checked.
const FIRST: u32 = 3;
/// Processes whose results are counted.
const PROCESSES: usize = 4096;

/// Which shards are computed a second time.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sampling {
    /// Secret: an actor that knew it would know when it is looked at.
    pub(crate) key: u64,
    /// Share of the shards.
    pub(crate) share: f64,
}

impl Sampling {
    fn takes(&self, shard: &Shard) -> bool {
        let indices = [shard.iteration.0, shard.index, shard.kind as u32, shard.eval_set];
        self.share > 0.0
            && f64::from(Key::new(self.key, Purpose::Recompute, &indices).stream().uniform32()) < self.share
    }
}

/// A shard whose result is being confirmed.
#[derive(Debug, Clone)]
pub(crate) struct Check {
    pub(crate) shard: Shard,
    /// The result that counts so far.
    pub(crate) first: Origin,
    /// A result that differs from it.
    pub(crate) second: Option<Origin>,
    opened: Instant,
    /// Second computations under way: their leases, processes, and since when.
    leases: Vec<(LeaseId, u64, Instant)>,
}

/// How many checks ended in which way.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct CheckTotals {
    pub(crate) same: u64,
    pub(crate) different: u64,
    /// Given up: nothing could compute the shard a second time.
    pub(crate) given_up: u64,
}

#[derive(Debug)]
pub(crate) struct Checks {
    open: Vec<Check>,
    sampling: Sampling,
    /// Results accepted from each process.
    standing: HashMap<u64, u32>,
    /// Processes of results that were confirmed, and their shards, since the last look.
    confirmed: Vec<(u64, Shard)>,
    pub(crate) totals: CheckTotals,
}

impl Checks {
    pub(crate) fn new(sampling: Sampling) -> Self {
        let (open, standing, confirmed) = (Vec::new(), HashMap::new(), Vec::new());
        Self { open, sampling, standing, confirmed, totals: CheckTotals::default() }
    }

    /// A result was accepted. Whether it will be checked.
    pub(crate) fn accepted(&mut self, shard: &Shard, origin: &Origin, now: Instant) -> bool {
        if self.standing.len() >= PROCESSES && !self.standing.contains_key(&origin.process) {
            // They count as new again, which costs a few checks.
            self.standing.clear();
        }
        let accepted = self.standing.entry(origin.process).or_default();
        *accepted = accepted.saturating_add(1);
        let due = *accepted <= FIRST || self.sampling.takes(shard);
        if due && self.sampling.share > 0.0 {
            self.begin(shard, origin, None, now);
        }
        due
    }

    /// Begins a check, unless there is one of this shard.
    pub(crate) fn begin(&mut self, shard: &Shard, first: &Origin, second: Option<Origin>, now: Instant) {
        if self.open.iter().all(|check| check.shard != *shard) {
            let (shard, first) = (*shard, first.clone());
            self.open.push(Check { shard, first, second, opened: now, leases: Vec::new() });
        }
    }

    /// A shard that this actor should compute a second time: another one's, which no third has had for less than `late`.
    pub(crate) fn next(&self, asker: &Asker, late: impl Fn(&Shard) -> Duration) -> Option<Shard> {
        let free = |check: &&Check| {
            let taken = |&(_, process, since): &(LeaseId, u64, Instant)| {
                process == asker.process || asker.now.saturating_duration_since(since) < late(&check.shard)
            };
            check.second.is_none() && check.first.process != asker.process && !check.leases.iter().any(taken)
        };
        self.open.iter().find(free).map(|check| check.shard)
    }

    pub(crate) fn leased(&mut self, lease: LeaseId, shard: &Shard, asker: &Asker) {
        if let Some(check) = self.open.iter_mut().find(|check| check.shard == *shard) {
            check.leases.push((lease, asker.process, asker.now));
        }
    }

    /// A lease has ended, with or without a result.
    pub(crate) fn released(&mut self, lease: LeaseId) {
        self.open.iter_mut().for_each(|check| check.leases.retain(|(other, ..)| *other != lease));
    }

    /// Another result of a shard that had one. Whether the two differ.
    pub(crate) fn compare(&mut self, shard: &Shard, known: Option<&Origin>, second: &Origin, now: Instant) -> bool {
        let at = self.open.iter().position(|check| check.shard == *shard);
        let Some(first) = at.map(|at| self.open[at].first.clone()).or_else(|| known.cloned()) else { return false };
        if first.digest != second.digest {
            match at {
                Some(at) => drop(self.open[at].second.get_or_insert_with(|| second.clone())),
                None => self.begin(shard, &first, Some(second.clone()), now),
            }
            return true;
        }
        // A process that repeats itself confirms nothing.
        if first.process != second.process {
            if let Some(at) = at.filter(|&at| self.open[at].second.is_none()) {
                self.open.remove(at);
                self.totals.same += 1;
            }
            self.confirmed.push((first.process, *shard));
        }
        false
    }

    /// A check that only the learner's host can decide: two results differ, or no other actor can compute the shard, or (if
    /// `waited` says that everything else is done) none has for too long.
    pub(crate) fn case(
        &self,
        connected: &[u64],
        waited: impl Fn(&Shard) -> Option<Duration>,
        now: Instant,
    ) -> Option<Check> {
        let undecided = |check: &&Check| {
            let alone = !connected.iter().any(|process| *process != check.first.process);
            let late = waited(&check.shard).is_some_and(|limit| now.saturating_duration_since(check.opened) >= limit);
            check.second.is_some() || alone || late
        };
        self.open.iter().find(undecided).cloned()
    }

    /// The learner's host has computed a shard: its digest, or `None` if it cannot. Returns the wrong results.
    pub(crate) fn decide(&mut self, shard: &Shard, digest: Option<&str>) -> Vec<Origin> {
        let Some(at) = self.open.iter().position(|check| check.shard == *shard) else { return Vec::new() };
        let check = self.open.remove(at);
        let Some(digest) = digest else {
            self.totals.given_up += 1;
            return Vec::new();
        };
        let of_two = [Some(check.first), check.second];
        let (right, wrong): (Vec<Origin>, Vec<Origin>) =
            of_two.into_iter().flatten().partition(|origin| origin.digest == digest);
        self.confirmed.extend(right.iter().map(|origin| (origin.process, *shard)));
        *(if wrong.is_empty() { &mut self.totals.same } else { &mut self.totals.different }) += 1;
        wrong
    }

    /// Forgets what a process that was evicted computed: its results are discarded.
    pub(crate) fn forget(&mut self, process: u64) {
        self.open.retain(|check| check.first.process != process);
        for check in &mut self.open {
            check.second.take_if(|second| second.process == process);
        }
        self.confirmed.retain(|(other, _)| *other != process);
    }

    /// Whether a check of an iteration before this one is open.
    pub(crate) fn open_before(&self, iteration: u32) -> bool {
        self.open.iter().any(|check| check.shard.iteration.0 < iteration)
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.open.is_empty()
    }

    /// Processes whose results are being checked.
    pub(crate) fn processes(&self) -> impl Iterator<Item = u64> {
        self.open.iter().map(|check| check.first.process)
    }

    pub(crate) fn clear(&mut self) {
        self.open.clear();
    }

    pub(crate) fn take_confirmed(&mut self) -> Vec<(u64, Shard)> {
        std::mem::take(&mut self.confirmed)
    }
}
