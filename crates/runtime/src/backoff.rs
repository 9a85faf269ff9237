//! Exponential backoff with jitter.

use std::hash::{BuildHasher as _, Hasher as _, RandomState};
use std::time::Duration;

/// First wait.
pub const FIRST: Duration = Duration::from_millis(100);
/// Longest wait.
pub const LONGEST: Duration = Duration::from_secs(5);

/// Each wait is drawn from the upper half of a span that doubles up to [`LONGEST`]. It reaches no number of a run.
#[derive(Debug, Clone)]
pub struct Backoff {
    span: Duration,
}

impl Default for Backoff {
    fn default() -> Self {
        Self { span: FIRST }
    }
}

impl Backoff {
    /// The next wait.
    pub fn next_wait(&mut self) -> Duration {
        let span = self.span;
        self.span = (span * 2).min(LONGEST);
        let fraction = f64::from(random_id() as u32) / f64::from(u32::MAX);
        span / 2 + span.mul_f64(0.5 * fraction)
    }

    /// After a success: begin with short waits again.
    pub fn reset(&mut self) {
        *self = Self::default();
    }
}

/// A random identifier that no other process is likely to draw. It never becomes a number of a run.
pub fn random_id() -> u64 {
    let mut hasher = RandomState::new().build_hasher();
    hasher.write_u32(std::process::id());
    hasher.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waits_grow_to_the_limit_and_start_over() {
        let mut backoff = Backoff::default();
        let mut span = FIRST;
        for _ in 0..20 {
            let wait = backoff.next_wait();
            assert!(wait >= span / 2 && wait <= span, "{wait:?} of {span:?}");
            span = (span * 2).min(LONGEST);
        }
        assert_eq!(span, LONGEST);
        backoff.reset();
        assert!(backoff.next_wait() <= FIRST);
    }

    #[test]
    fn random_ids_differ() {
        assert_ne!(random_id(), random_id());
    }
}
