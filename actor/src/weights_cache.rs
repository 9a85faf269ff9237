//! The weights that an actor holds: the two latest arrivals, verified.

use magex_proto::goals::WeightsKey;
use magex_proto::weights::Weights;
use magex_runtime::sync::lock;
use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio_util::sync::CancellationToken;

/// Number of versions held.
const KEPT: usize = 2;

/// Why the weights are not available.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CacheError {
    /// They did not arrive in time.
    #[error("weights version {wanted} did not arrive within {waited:?}; here are versions {held:?}")]
    TimedOut {
        /// The version waited for.
        wanted: u32,
        /// Time waited.
        waited: Duration,
        /// Versions that are held.
        held: Vec<u32>,
    },
    /// The pool shuts down; the result is no longer needed.
    #[error("cancelled: the result is no longer needed")]
    Cancelled,
}

/// Filled by the weights stream; rollout threads wait here for the version that their shard names.
#[derive(Debug, Default)]
pub struct WeightsCache {
    held: Mutex<VecDeque<Arc<Weights>>>,
    changed: Condvar,
}

impl WeightsCache {
    /// Inserts weights, replaces those of the same run and version, and drops the oldest arrival.
    pub fn insert(&self, weights: Weights) {
        let mut held = lock(&self.held);
        held.retain(|old| (&old.run_id, old.version) != (&weights.run_id, weights.version));
        held.push_back(Arc::new(weights));
        while held.len() > KEPT {
            held.pop_front();
        }
        drop(held);
        self.changed.notify_all();
    }

    /// Returns these weights as soon as they have arrived. Blocks for at most `patience`, or until `cancelled` followed by
    /// [`WeightsCache::wake`].
    pub fn wait(
        &self,
        wanted: &WeightsKey,
        patience: Duration,
        cancelled: &CancellationToken,
    ) -> Result<Arc<Weights>, CacheError> {
        let deadline = Instant::now() + patience;
        let mut held = lock(&self.held);
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

    /// Wakes all waiting threads, so that they check for cancellation.
    pub fn wake(&self) {
        // Taking the lock ensures that no thread is between its check and its wait.
        drop(lock(&self.held));
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
    fn the_two_latest_are_held() {
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
