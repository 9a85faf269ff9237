//! The weights that an actor holds: the latest that arrived and the one before, verified.

use magex_proto::goals::WeightsKey;
use magex_proto::weights::Weights;
use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio_util::sync::CancellationToken;

/// Versions that are held.
const KEPT: usize = 2;

/// Weights that did not come.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CacheError {
    /// They did not come in time.
    #[error("weights version {wanted} did not arrive within {waited:?}; here are versions {held:?}")]
    TimedOut {
        /// Version that was waited for.
        wanted: u32,
        /// How long.
        waited: Duration,
        /// Versions that are held.
        held: Vec<u32>,
    },
    /// Nobody wants the result any more.
    #[error("no longer wanted")]
    Cancelled,
}

/// Filled by the weights stream, read by rollout threads, which wait for the version that their shard names.
#[derive(Debug, Default)]
pub struct WeightsCache {
    held: Mutex<VecDeque<Arc<Weights>>>,
    changed: Condvar,
}

impl WeightsCache {
    /// Holds weights that arrived, in place of what had the same name, and forgets the oldest arrival.
    pub fn insert(&self, weights: Weights) {
        let mut held = self.held.lock().unwrap_or_else(PoisonError::into_inner);
        held.retain(|old| (&old.run_id, old.version) != (&weights.run_id, weights.version));
        held.push_back(Arc::new(weights));
        while held.len() > KEPT {
            held.pop_front();
        }
        drop(held);
        self.changed.notify_all();
    }

    /// The weights of this name, as soon as they are here. Blocks for at most `patience`, or until `cancelled` followed by
    /// [`WeightsCache::wake`].
    pub fn wait(
        &self,
        wanted: &WeightsKey,
        patience: Duration,
        cancelled: &CancellationToken,
    ) -> Result<Arc<Weights>, CacheError> {
        let deadline = Instant::now() + patience;
        let mut held = self.held.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            let is_wanted = |weights: &&Arc<Weights>| {
                (&weights.run_id, weights.version, &weights.sha256) == (&wanted.run_id, wanted.version, &wanted.sha256)
            };
            if let Some(weights) = held.iter().find(is_wanted) {
                return Ok(weights.clone());
            }
            if cancelled.is_cancelled() {
                return Err(CacheError::Cancelled);
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                let held = held.iter().map(|weights| weights.version.0).collect();
                return Err(CacheError::TimedOut { wanted: wanted.version.0, waited: patience, held });
            }
            held = self.changed.wait_timeout(held, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Lets everybody who waits look again.
    pub fn wake(&self) {
        // With the lock, so that nobody is between looking and waiting.
        drop(self.held.lock().unwrap_or_else(PoisonError::into_inner));
        self.changed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytes::Bytes;
    use magex_core::ids::{RunId, WeightsVersion};

    const LONG: Duration = Duration::from_secs(60);

    fn weights(version: u32) -> Weights {
        let bytes = Bytes::from(version.to_le_bytes().to_vec());
        Weights::new(RunId("r".into()), WeightsVersion(version), bytes)
    }

    fn key(weights: &Weights) -> WeightsKey {
        let Weights { run_id, version, sha256, .. } = weights.clone();
        WeightsKey { run_id, version, sha256 }
    }

    #[test]
    fn the_latest_two_are_held() {
        let (cache, token) = (WeightsCache::default(), CancellationToken::new());
        (1..=3).for_each(|version| cache.insert(weights(version)));
        for version in [2, 3] {
            assert_eq!(*cache.wait(&key(&weights(version)), LONG, &token).unwrap(), weights(version));
        }
        let error = cache.wait(&key(&weights(1)), Duration::ZERO, &token).unwrap_err();
        assert_eq!(error, CacheError::TimedOut { wanted: 1, waited: Duration::ZERO, held: vec![2, 3] });
        let other = WeightsKey { sha256: "another".into(), ..key(&weights(3)) };
        assert!(cache.wait(&other, Duration::ZERO, &token).is_err());
    }

    #[test]
    fn a_waiting_thread_wakes_with_the_weights_and_with_the_end() {
        let (cache, token) = (Arc::new(WeightsCache::default()), CancellationToken::new());
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| cache.wait(&key(&weights(7)), LONG, &token));
            cache.insert(weights(7));
            assert_eq!(*waiting.join().unwrap().unwrap(), weights(7));
            let waiting = scope.spawn(|| cache.wait(&key(&weights(8)), LONG, &token));
            token.cancel();
            cache.wake();
            assert_eq!(waiting.join().unwrap(), Err(CacheError::Cancelled));
        });
    }
}
