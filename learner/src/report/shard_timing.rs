//! Where the time of the open plan goes, by the learner's clock and by what the actors say of theirs.

use crate::report::bottleneck::Collected;
use magex_proto::v1::ShardTiming;
use std::time::{Duration, Instant};

/// Kept beside the ledger, which knows no clock.
#[derive(Debug, Default)]
pub(crate) struct Tally {
    sums: Collected,
    /// Since when nobody holds a lease.
    idle_since: Option<Instant>,
    /// When the results of training shards came in.
    arrivals: Vec<Instant>,
}

impl Tally {
    /// A new plan.
    pub(crate) fn open(&mut self) {
        *self = Self::default();
    }

    /// So many leases are held from now on.
    pub(crate) fn held(&mut self, leases: u64, now: Instant) {
        match (leases, self.idle_since) {
            (0, None) => self.idle_since = Some(now),
            (1.., Some(since)) => {
                self.sums.idle_s += now.saturating_duration_since(since).as_secs_f64();
                self.idle_since = None;
            }
            _ => {}
        }
    }

    /// A result was taken in, so long after its lease; and what its actor says about that time. An actor cannot have spent
    /// more than there was: what it says is cut to that.
    pub(crate) fn settled(&mut self, training: bool, since_lease: Duration, said: Option<ShardTiming>, now: Instant) {
        if training {
            self.arrivals.push(now);
        }
        let Some(said) = said else { return };
        let within = |seconds: f64, limit: f64| if seconds.is_finite() { seconds.clamp(0.0, limit) } else { 0.0 };
        let all = since_lease.as_secs_f64();
        let held = within(said.held_seconds, all);
        self.sums.held_s += held;
        self.sums.rollout_s += within(said.rollout_seconds, held);
        self.sums.goals_wait_s += within(said.goals_wait_seconds, held);
        self.sums.weights_wait_s += within(said.weights_wait_seconds, held);
        self.sums.transfer_s += all - held;
    }

    /// The plan is done: where its time went, and how old its training results are, seconds.
    pub(crate) fn close(&mut self, now: Instant) -> (Collected, Vec<f64>) {
        let age = |arrival: &Instant| now.saturating_duration_since(*arrival).as_secs_f64();
        (self.sums, self.arrivals.iter().map(age).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_an_actor_says_is_cut_to_the_time_there_was() {
        let (mut tally, start) = (Tally::default(), Instant::now());
        let at = |seconds: f64| start + Duration::from_secs_f64(seconds);
        tally.open();
        tally.held(0, at(0.0));
        tally.held(1, at(2.0));
        let said = |held_seconds, rollout_seconds| ShardTiming { held_seconds, rollout_seconds, ..Default::default() };
        tally.settled(true, Duration::from_secs(3), Some(said(2.0, 1.5)), at(5.0));
        tally.settled(true, Duration::from_secs(3), Some(said(1e9, 1e9)), at(6.0));
        tally.settled(false, Duration::from_secs(3), Some(said(f64::NAN, -1.0)), at(6.0));
        tally.settled(true, Duration::from_secs(3), None, at(7.0));
        let (sums, ages) = tally.close(at(8.0));
        assert_eq!((sums.held_s, sums.rollout_s, sums.transfer_s, sums.idle_s), (5.0, 4.5, 4.0, 2.0));
        assert_eq!(ages, [3.0, 2.0, 1.0]);
    }
}
