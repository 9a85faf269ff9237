//! Leases that are late: their shards are leased once more, to an actor that is idle.

use super::{Asker, Ledger, Slot};
use magex_core::ids::Shard;
use std::collections::BTreeMap;
use tokio::time::Instant;

/// The leases of a shard that are out.
#[derive(Debug, Clone, Copy)]
struct Out {
    oldest: Instant,
    newest: Instant,
    /// Whether the process that asks has one of them.
    own: bool,
}

impl Ledger {
    /// The shard whose lease is the oldest of those that are late and that this process does not hold. It is leased once more:
    /// shards are pure, so whichever result comes first has the same bits.
    pub(super) fn late_for(&self, asker: &Asker, others: &impl Fn() -> Vec<u64>) -> Option<usize> {
        if !self.hedges {
            return None;
        }
        let late = |(at, out): &(usize, Out)| {
            let slot = &self.plan[*at];
            !out.own && !slot.queued && asker.now >= self.late_at(*at, out) && !slot.avoids(asker.process, others)
        };
        self.out(asker.process).into_iter().filter(late).min_by_key(|(_, out)| out.oldest).map(|(at, _)| at)
    }

    /// When a lease that is out now becomes late for this process, if nothing changes before.
    pub(crate) fn next_late(&self, process: u64) -> Option<Instant> {
        if !self.hedges {
            return None;
        }
        let open = self.out(process).into_iter().filter(|(at, out)| !out.own && !self.plan[*at].queued);
        open.map(|(at, out)| self.late_at(at, &out)).min()
    }

    /// When a shard that is out becomes late.
    fn late_at(&self, at: usize, out: &Out) -> Instant {
        let Slot { shard: Shard { kind, .. }, granted, .. } = self.plan[at];
        out.newest + if granted <= 1 { self.pace.late(kind) } else { self.pace.late_again(kind) }
    }

    /// The shards of the plan that are leased and not done.
    fn out(&self, process: u64) -> BTreeMap<usize, Out> {
        let mut shards: BTreeMap<usize, Out> = BTreeMap::new();
        for held in self.held.values() {
            let open = self.position.get(&held.shard).filter(|&&at| self.plan[at].result.is_none());
            let Some(&at) = open else { continue };
            let own = held.process == process;
            let out = shards.entry(at).or_insert(Out { oldest: held.since, newest: held.since, own });
            out.oldest = out.oldest.min(held.since);
            out.newest = out.newest.max(held.since);
            out.own |= own;
        }
        shards
    }
}
