//! How long shards usually take: what is late is measured against it.

use magex_core::ids::ShardKind;
use std::collections::VecDeque;
use std::time::Duration;

/// Durations that are remembered of each kind.
const REMEMBERED: usize = 31;
/// A lease that is younger is never late: shards of milliseconds differ by more than a factor.
const SHORTEST: Duration = Duration::from_millis(100);

#[derive(Debug)]
pub(crate) struct Pace {
    /// From grant to result, of the latest training and evaluation shards.
    recent: [VecDeque<Duration>; 2],
    /// Silence after which an actor loses its leases.
    lease: Duration,
}

impl Pace {
    pub(crate) fn new(lease: Duration) -> Self {
        Self { recent: [VecDeque::new(), VecDeque::new()], lease }
    }

    pub(crate) fn took(&mut self, kind: ShardKind, time: Duration) {
        let recent = &mut self.recent[usize::from(kind == ShardKind::Eval)];
        recent.push_back(time);
        if recent.len() > REMEMBERED {
            recent.pop_front();
        }
    }

    fn median(&self, kind: ShardKind) -> Option<Duration> {
        let mut sorted: Vec<Duration> = self.recent[usize::from(kind == ShardKind::Eval)].iter().copied().collect();
        sorted.sort_unstable();
        sorted.get(sorted.len() / 2).copied()
    }

    /// Age from which a lease is shared with an idle actor: twice what is usual, or the time of a lease while nothing is known.
    /// Shorter, and in undisturbed runs actors would repeat shards that are about to arrive, and still be at it when the next
    /// plan opens.
    pub(crate) fn late(&self, kind: ShardKind) -> Duration {
        self.median(kind).map_or(self.lease, |median| (2 * median).max(SHORTEST))
    }

    /// The same of a lease that is not the first one of its shard: actors that fail in turn must not cost a whole lease each.
    pub(crate) fn late_again(&self, kind: ShardKind) -> Duration {
        self.median(kind).map_or(self.lease / 4, |_| self.late(kind))
    }

    /// Age from which a lease is worth a line in the log.
    pub(crate) fn stalled(&self, kind: ShardKind) -> Duration {
        self.median(kind).map_or(self.lease, |median| (5 * median).max(self.lease))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn late_is_twice_the_median_of_the_kind_and_a_lease_while_nothing_is_known() {
        let seconds = Duration::from_secs;
        let mut pace = Pace::new(seconds(15));
        assert_eq!((pace.late(ShardKind::Train), pace.stalled(ShardKind::Train)), (seconds(15), seconds(15)));
        assert_eq!(pace.late_again(ShardKind::Train), seconds(15) / 4);
        [1, 9, 4].into_iter().for_each(|time| pace.took(ShardKind::Train, seconds(time)));
        assert_eq!((pace.late(ShardKind::Train), pace.stalled(ShardKind::Train)), (seconds(8), seconds(20)));
        assert_eq!(pace.late(ShardKind::Eval), seconds(15));
        assert_eq!(pace.late_again(ShardKind::Train), seconds(8));
        (0..REMEMBERED).for_each(|_| pace.took(ShardKind::Train, Duration::from_millis(2)));
        assert_eq!((pace.late(ShardKind::Train), pace.stalled(ShardKind::Train)), (SHORTEST, seconds(15)));
    }
}
