//! Whether a rollout thread still moves.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

/// Counts the steps of a rollout thread.
#[derive(Debug, Clone, Default)]
pub struct Pulse(Arc<Beats>);

#[derive(Debug, Default)]
struct Beats {
    beats: AtomicU64,
    busy: AtomicBool,
}

impl Pulse {
    /// The thread has done something: a joint step, or a wait that has ended.
    pub fn beat(&self) {
        self.0.beats.fetch_add(1, Ordering::Relaxed);
    }

    /// The thread takes a shard, or is done with it.
    pub(crate) fn set_busy(&self, busy: bool) {
        self.0.busy.store(busy, Ordering::Relaxed);
        self.beat();
    }

    fn read(&self) -> (u64, bool) {
        (self.0.beats.load(Ordering::Relaxed), self.0.busy.load(Ordering::Relaxed))
    }
}

/// Looks at the pulses of all threads now and then.
#[derive(Debug, Default)]
pub(crate) struct Watch {
    threads: Vec<(Pulse, u64, u32)>,
}

impl Watch {
    pub(crate) fn new(pulses: impl Iterator<Item = Pulse>) -> Self {
        Self { threads: pulses.map(|pulse| (pulse, 0, 0)).collect() }
    }

    /// Looks once. A thread that has a shard and has not moved for `limit` looks: its number. Looks are counted, not time, because a
    /// process that was stopped as a whole is not stuck when it goes on.
    pub(crate) fn stuck(&mut self, limit: u32) -> Option<usize> {
        for (pulse, seen, still) in &mut self.threads {
            let (beats, busy) = pulse.read();
            *still = if busy && beats == *seen { *still + 1 } else { 0 };
            *seen = beats;
        }
        self.threads.iter().position(|(.., still)| *still >= limit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_thread_with_a_shard_that_does_not_move_is_stuck() {
        let pulses: [Pulse; 2] = Default::default();
        let mut watch = Watch::new(pulses.iter().cloned());
        pulses[1].set_busy(true);
        assert_eq!(watch.stuck(2), None);
        pulses[1].beat();
        assert_eq!((watch.stuck(2), watch.stuck(2), watch.stuck(2)), (None, None, Some(1)));
        pulses[1].set_busy(false);
        assert_eq!((watch.stuck(2), watch.stuck(2), watch.stuck(2), watch.stuck(2)), (None, None, None, None));
    }
}
