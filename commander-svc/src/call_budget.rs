//! The time that a call may take.

use magex_runtime::net::deadline::Deadline;
use std::time::{Duration, Instant};

/// How long any answer may take.
const LONGEST: Duration = Duration::from_secs(60);

/// How long the learned scheduler may take for a team without a deadline before the exact one answers in its place.
const LEARNED: Duration = Duration::from_millis(500);

/// When a request arrived, and its deadline.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CallBudget {
    start: Instant,
    /// The deadline.
    pub(crate) until: Instant,
    /// The caller set a deadline.
    explicit: bool,
}

impl CallBudget {
    /// Starts now and ends at the call's deadline, or after [`LONGEST`].
    pub(crate) fn start(call: Option<&Deadline>) -> Self {
        let start = Instant::now();
        let latest = start + LONGEST;
        let until = call.and_then(|call| call.start.checked_add(call.timeout)).map_or(latest, |end| end.min(latest));
        Self { start, until, explicit: call.is_some() }
    }

    /// The same, with the request's own deadline.
    pub(crate) fn limited(self, deadline: Option<Duration>) -> Self {
        let until = deadline.map_or(self.until, |deadline| self.until.min(self.start + deadline));
        Self { until, explicit: self.explicit || deadline.is_some(), ..self }
    }

    /// How long the learned scheduler may take: half of what is left, so that the exact one has the other half.
    pub(crate) fn learned(&self) -> Duration {
        let half = self.left() / 2;
        if self.explicit { half } else { half.min(LEARNED) }
    }

    /// Time since the request arrived.
    pub(crate) fn elapsed(&self) -> Duration {
        self.start.elapsed()
    }

    /// Time to the deadline.
    pub(crate) fn left(&self) -> Duration {
        self.until.saturating_duration_since(Instant::now())
    }

    /// The deadline has passed.
    pub(crate) fn over(&self) -> bool {
        Instant::now() >= self.until
    }
}
