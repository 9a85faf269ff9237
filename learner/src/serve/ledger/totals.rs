//! What became of every lease: the conservation ledger, in shards and in episodes.

use magex_proto::v1::LedgerStatus;

/// Totals of the leases so far, by how they ended: of shards, or of their episodes. `leased` includes late results of leases
/// that the ledger no longer knows.
pub(crate) type Counters = LedgerStatus;

/// The total that a lease is counted in when it ends.
pub(super) type Fate = fn(&mut Counters) -> &mut u64;

pub(super) const TRAINED: Fate = |totals| &mut totals.trained;
pub(super) const DUPLICATE: Fate = |totals| &mut totals.duplicate;
pub(super) const EXPIRED: Fate = |totals| &mut totals.expired;
pub(super) const REJECTED: Fate = |totals| &mut totals.rejected;
pub(super) const FAILED: Fate = |totals| &mut totals.failed;

/// Totals of shards and of episodes, counted together so that neither can be forgotten.
#[derive(Debug, Default)]
pub(super) struct Totals {
    pub(super) shards: Counters,
    pub(super) episodes: Counters,
}

impl Totals {
    pub(super) fn leased(&mut self, episodes: u32) {
        self.shards.leased += 1;
        self.episodes.leased += u64::from(episodes);
    }

    pub(super) fn ended(&mut self, fate: Fate, episodes: u32) {
        *fate(&mut self.shards) += 1;
        *fate(&mut self.episodes) += u64::from(episodes);
    }
}

/// Totals with what is held now and what is left over, which is always zero: every lease ends in exactly one way.
pub(super) fn balanced(totals: Counters, outstanding: u64) -> Counters {
    let Counters { leased, trained, duplicate, expired, rejected, failed, .. } = totals;
    let ended = trained + duplicate + expired + rejected + failed + outstanding;
    Counters { outstanding, residual: leased.wrapping_sub(ended).cast_signed(), ..totals }
}
