//! The weights that an actor holds: the two latest arrivals, verified. They arrive over a connection of their own, so that bulk
//! results never delay them.

use crate::metrics::ActorMetrics;
use magex_proto::goals::WeightsKey;
use magex_proto::v1::SubscriberRole;
use magex_proto::weights::Weights;
use magex_proto::weights_watch::{OPEN_TIMEOUT, WeightsStream, late};
use magex_runtime::backoff::Backoff;
use magex_runtime::client::Channel;
use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;
use tonic::Status;

const KEPT: usize = 2;

#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error("weights version {wanted} did not arrive within {waited:?}; here are versions {held:?}")]
pub(crate) struct WeightsLate {
    wanted: u32,
    waited: Duration,
    held: Vec<u32>,
}

/// Filled by the weights stream; rollout threads wait here for the version that their shard names.
#[derive(Debug, Default)]
pub(crate) struct WeightsCache(watch::Sender<VecDeque<Arc<Weights>>>);

impl WeightsCache {
    /// Inserts weights, replaces those of the same run and version, and drops the oldest arrival.
    pub(crate) fn insert(&self, weights: Weights) {
        self.0.send_modify(|held| {
            held.retain(|old| (&old.run_id, old.version) != (&weights.run_id, weights.version));
            held.push_back(Arc::new(weights));
            held.drain(..held.len().saturating_sub(KEPT));
        });
    }

    /// Returns these weights as soon as they have arrived, if they do within `patience`.
    pub(crate) async fn wait(&self, wanted: &WeightsKey, patience: Duration) -> Result<Arc<Weights>, WeightsLate> {
        let WeightsKey { run_id, version, sha256 } = wanted;
        let is_wanted =
            |weights: &&Arc<Weights>| (&weights.run_id, &weights.version, &weights.sha256) == (run_id, version, sha256);
        let mut held = self.0.subscribe();
        let arrival = held.wait_for(|held| held.iter().any(|weights| is_wanted(&weights)));
        let arrived = tokio::time::timeout(patience, arrival).await.ok().and_then(Result::ok);
        arrived.and_then(|held| held.iter().find(is_wanted).cloned()).ok_or_else(|| {
            let held = self.0.borrow().iter().map(|weights| weights.version.0).collect();
            WeightsLate { wanted: version.0, waited: patience, held }
        })
    }
}

/// Follows the learner's weights and reconnects after every failure. Never returns.
pub(crate) async fn follow(channel: Channel, actor_id: String, cache: Arc<WeightsCache>, metrics: Arc<ActorMetrics>) {
    let mut backoff = Backoff::default();
    loop {
        let arrivals = async {
            let opening = WeightsStream::open(channel.clone(), &actor_id, SubscriberRole::Actor);
            let mut stream = tokio::time::timeout(OPEN_TIMEOUT, opening).await.map_err(late)??;
            while let Some((weights, _)) = stream.next().await? {
                backoff.reset();
                tracing::debug!(version = weights.version.0, bytes = weights.bytes.len(), "weights arrived");
                metrics.weights_bytes.inc_by(weights.bytes.len() as u64);
                metrics.weights_version.set(f64::from(weights.version.0));
                cache.insert(weights);
            }
            Ok::<(), Status>(())
        };
        match arrivals.await {
            Ok(()) => tracing::debug!("the weights stream ended"),
            Err(status) => tracing::debug!(reason = status.message(), "the weights stream broke"),
        }
        tokio::time::sleep(backoff.next_wait()).await;
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

    #[tokio::test]
    async fn the_two_latest_are_held() {
        let cache = WeightsCache::default();
        (1..=3).for_each(|version| cache.insert(weights(version)));
        for version in [2, 3] {
            assert_eq!(*cache.wait(&key(&weights(version)), LONG).await.unwrap(), weights(version));
        }
        let error = cache.wait(&key(&weights(1)), Duration::ZERO).await.unwrap_err();
        assert_eq!(error, WeightsLate { wanted: 1, waited: Duration::ZERO, held: vec![2, 3] });
        let other = WeightsKey { sha256: "another".into(), ..key(&weights(3)) };
        assert!(cache.wait(&other, Duration::ZERO).await.is_err());
    }

    #[tokio::test]
    async fn a_waiting_thread_wakes_with_the_weights() {
        let cache = Arc::new(WeightsCache::default());
        let (waiting, wanted) = (cache.clone(), key(&weights(7)));
        let waiting = tokio::spawn(async move { waiting.wait(&wanted, LONG).await });
        tokio::task::yield_now().await;
        cache.insert(weights(7));
        assert_eq!(*waiting.await.unwrap().unwrap(), weights(7));
    }
}
