//! How long controllers without weights compute: measured around them, because no clock has a place in an environment.

use magex_actor::rollout::MakeController;
use magex_core::error::FieldError;
use magex_core::joint_state::JointState;
use magex_env::{Classical, Controller, classical};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

/// Sums up the time of all controllers that it makes, on all threads.
#[derive(Debug, Clone, Default)]
pub(crate) struct PlanningClock(Arc<AtomicU64>);

impl PlanningClock {
    /// Makes controllers whose time counts here.
    pub(crate) fn timed(&self, kind: Classical) -> MakeController {
        let clock = self.clone();
        Box::new(move |task, keys| Ok(Box::new(Timed { inner: classical(kind, task, keys)?, clock: clock.clone() })))
    }

    /// Milliseconds since the last call.
    pub(crate) fn take_ms(&self) -> f64 {
        self.0.swap(0, Ordering::Relaxed) as f64 * 1e-6
    }

    fn measure<T>(&self, work: impl FnOnce() -> T) -> T {
        let start = Instant::now();
        let result = work();
        self.0.fetch_add(u64::try_from(start.elapsed().as_nanos()).unwrap_or(u64::MAX), Ordering::Relaxed);
        result
    }
}

struct Timed {
    inner: Box<dyn Controller>,
    clock: PlanningClock,
}

impl Controller for Timed {
    fn begin(&mut self, start: &JointState<'_>) -> Result<(), FieldError> {
        let inner = &mut self.inner;
        self.clock.measure(|| inner.begin(start))
    }

    fn act(&mut self, state: &JointState<'_>, actions: &mut [u8]) -> Result<(), FieldError> {
        let inner = &mut self.inner;
        self.clock.measure(|| inner.act(state, actions))
    }
}
