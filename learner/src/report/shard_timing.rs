//! Where the time of the open plan goes, by the learner's clock and the actors' reports.

use crate::report::bottleneck::CollectTiming;
use magex_proto::v1;
use std::time::{Duration, Instant};

/// Kept beside the ledger, which has no clock.
#[derive(Debug, Default)]
pub(crate) struct ShardTiming {
    sums: CollectTiming,
    /// Since when no lease is outstanding.
    idle_since: Option<Instant>,
    arrivals: Vec<Instant>,
}

impl ShardTiming {
    pub(crate) fn start(&mut self) {
        *self = Self::default();
    }

    pub(crate) fn leases_outstanding(&mut self, leases: u64, now: Instant) {
        match (leases, self.idle_since) {
            (0, None) => self.idle_since = Some(now),
            (1.., Some(since)) => {
                self.sums.idle_s += now.saturating_duration_since(since).as_secs_f64();
                self.idle_since = None;
            }
            _ => {}
        }
    }

    /// Adds an accepted result. The actor's reported times are clamped to `since_grant`, the time since its lease.
    pub(crate) fn result_accepted(
        &mut self,
        training: bool,
        since_grant: Duration,
        reported: Option<v1::ShardTiming>,
        now: Instant,
    ) {
        if training {
            self.arrivals.push(now);
        }
        let Some(reported) = reported else { return };
        let within = |seconds: f64, limit: f64| if seconds.is_finite() { seconds.clamp(0.0, limit) } else { 0.0 };
        let all = since_grant.as_secs_f64();
        let held = within(reported.held_seconds, all);
        self.sums.held_s += held;
        self.sums.rollout_s += within(reported.rollout_seconds, held);
        self.sums.goals_wait_s += within(reported.goals_wait_seconds, held);
        self.sums.weights_wait_s += within(reported.weights_wait_seconds, held);
        self.sums.transfer_s += all - held;
    }

    /// Where the time of the complete plan went, and the ages of its training results, seconds.
    pub(crate) fn finish(&mut self, now: Instant) -> (CollectTiming, Vec<f64>) {
        let age = |arrival: &Instant| now.saturating_duration_since(*arrival).as_secs_f64();
        (self.sums, self.arrivals.iter().map(age).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reported_times_are_clamped_to_the_time_since_the_lease() {
        let (mut timing, start) = (ShardTiming::default(), Instant::now());
        let at = |seconds: f64| start + Duration::from_secs_f64(seconds);
        timing.start();
        timing.leases_outstanding(0, at(0.0));
        timing.leases_outstanding(1, at(2.0));
        let reported =
            |held_seconds, rollout_seconds| v1::ShardTiming { held_seconds, rollout_seconds, ..Default::default() };
        timing.result_accepted(true, Duration::from_secs(3), Some(reported(2.0, 1.5)), at(5.0));
        timing.result_accepted(true, Duration::from_secs(3), Some(reported(1e9, 1e9)), at(6.0));
        timing.result_accepted(false, Duration::from_secs(3), Some(reported(f64::NAN, -1.0)), at(6.0));
        timing.result_accepted(true, Duration::from_secs(3), None, at(7.0));
        let (sums, ages) = timing.finish(at(8.0));
        assert_eq!((sums.held_s, sums.rollout_s, sums.transfer_s, sums.idle_s), (5.0, 4.5, 4.0, 2.0));
        assert_eq!(ages, [3.0, 2.0, 1.0]);
    }
}
