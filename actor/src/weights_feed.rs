//! Keeps the weights cache filled, over a connection of its own: bulk results never delay weights.

use crate::metrics::ActorMetrics;
use crate::weights_cache::WeightsCache;
use magex_proto::v1::SubscriberRole;
use magex_proto::weights_watch::{OPEN_TIMEOUT, WeightsStream, late};
use magex_runtime::backoff::Backoff;
use magex_runtime::client::Channel;
use std::sync::Arc;
use tonic::Status;

/// Follows the learner's weights and reconnects after every failure. Never returns.
pub(crate) async fn follow(channel: Channel, actor_id: String, cache: Arc<WeightsCache>, metrics: Arc<ActorMetrics>) {
    let mut backoff = Backoff::default();
    loop {
        let watch = async {
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
        match watch.await {
            Ok(()) => tracing::debug!("the weights stream ended"),
            Err(status) => tracing::debug!(reason = status.message(), "the weights stream broke"),
        }
        tokio::time::sleep(backoff.next_wait()).await;
    }
}
