//! How long shards usually take: what is late is measured against it.

use magex_core::ids::ShardKind;
use std::collections::VecDeque;
use std::time::Duration;

/// Durations that are remembered of each kind.
const REMEMBERED: usize = 31;
/// A lease that is younger is never late: shards of milliseconds differ by more than a factor.
const SHORTEST: Duration = Duration::from_millis(100);
/// Fewer durations than this say what is possible, not what is usual.
const FEW: usize = 5;

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

    /// The median, or the shortest of a few: where the first shards of a kind went to actors that froze, the median of a few would
    /// be their silence, and the next such shard would wait for twice of it.
    fn usual(&self, kind: ShardKind) -> (Option<Duration>, bool) {
        let mut sorted: Vec<Duration> = self.recent[usize::from(kind == ShardKind::Eval)].iter().copied().collect();
        sorted.sort_unstable();
        let few = sorted.len() < FEW;
        (sorted.get(if few { 0 } else { sorted.len() / 2 }).copied(), few)
    }

    /// Age from which a lease is shared with an idle actor: twice what is usual, or the time of a lease while nothing is known.
    /// Shorter, and in undisturbed runs actors would repeat shards that are about to arrive, and still be at it when the next
    /// plan opens.
    pub(crate) fn late(&self, kind: ShardKind) -> Duration {
        self.late_or(kind, self.lease)
    }

    /// The same of a lease that is not the first one of its shard: actors that fail in turn must not cost a whole lease each.
    pub(crate) fn late_again(&self, kind: ShardKind) -> Duration {
        self.late_or(kind, self.lease / 4)
    }

    /// `first` is the age while nothing is known; a quarter of a lease is the most while little is.
    fn late_or(&self, kind: ShardKind, first: Duration) -> Duration {
        match self.usual(kind) {
            (None, _) => first,
            (Some(time), few) => (2 * time).max(SHORTEST).min(if few { self.lease / 4 } else { Duration::MAX }),
        }
    }

    /// Age from which a lease is worth a line in the log.
    pub(crate) fn stalled(&self, kind: ShardKind) -> Duration {
        self.usual(kind).0.map_or(self.lease, |time| (5 * time).max(self.lease))
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
        [1, 9, 4, 20, 20].into_iter().for_each(|time| pace.took(ShardKind::Train, seconds(time)));
        assert_eq!((pace.late(ShardKind::Train), pace.stalled(ShardKind::Train)), (seconds(18), seconds(45)));
        assert_eq!(pace.late(ShardKind::Eval), seconds(15));
        assert_eq!(pace.late_again(ShardKind::Train), seconds(18));
        (0..REMEMBERED).for_each(|_| pace.took(ShardKind::Train, Duration::from_millis(2)));
        assert_eq!((pace.late(ShardKind::Train), pace.stalled(ShardKind::Train)), (SHORTEST, seconds(15)));
    }

    #[test]
    fn while_few_are_known_the_shortest_counts_and_a_quarter_of_a_lease_is_the_most() {
        let seconds = Duration::from_secs;
        let mut pace = Pace::new(seconds(15));
        // The first shard of its kind went to an actor that froze.
        pace.took(ShardKind::Eval, seconds(14));
        assert_eq!((pace.late(ShardKind::Eval), pace.late_again(ShardKind::Eval)), (seconds(15) / 4, seconds(15) / 4));
        [1, 14].into_iter().for_each(|time| pace.took(ShardKind::Eval, seconds(time)));
        assert_eq!((pace.late(ShardKind::Eval), pace.late_again(ShardKind::Eval)), (seconds(2), seconds(2)));
        // Shards that do take longer than a lease: known as soon as there are more than a few.
        [14, 14].into_iter().for_each(|time| pace.took(ShardKind::Eval, seconds(time)));
        assert_eq!((pace.late(ShardKind::Eval), pace.late_again(ShardKind::Eval)), (seconds(28), seconds(28)));
    }
}
