//! Keeps the weights cache filled: a connection of its own, so that bulk results never delay weights.

use crate::cache::WeightsCache;
use crate::gauges::ActorGauges;
use magex_proto::v1::learner_service_client::LearnerServiceClient;
use magex_proto::weights::WeightsAssembler;
use magex_proto::{MAX_MESSAGE_BYTES, v1};
use magex_runtime::backoff::Backoff;
use magex_runtime::client::Channel;
use std::sync::Arc;
use std::time::Duration;
use tonic::Status;

/// A learner that does not begin to answer within this time is asked again.
const OPEN_TIMEOUT: Duration = Duration::from_secs(10);

/// Follows the learner's weights for ever, through every break of the connection.
pub(crate) async fn follow(channel: Channel, actor_id: String, cache: Arc<WeightsCache>, gauges: Arc<ActorGauges>) {
    let mut backoff = Backoff::default();
    loop {
        let end = watch(channel.clone(), &actor_id, &cache, &gauges, &mut backoff).await;
        match end {
            Ok(()) => tracing::debug!("the weights stream ended"),
            Err(status) => tracing::debug!(reason = status.message(), "the weights stream broke"),
        }
        tokio::time::sleep(backoff.next_wait()).await;
    }
}

async fn watch(
    channel: Channel,
    actor_id: &str,
    cache: &WeightsCache,
    gauges: &ActorGauges,
    backoff: &mut Backoff,
) -> Result<(), Status> {
    let mut client = LearnerServiceClient::new(channel).max_decoding_message_size(MAX_MESSAGE_BYTES);
    let request = v1::WatchWeightsRequest {
        run_id: String::new(),
        subscriber_id: actor_id.to_owned(),
        role: v1::SubscriberRole::Actor.into(),
    };
    // The stream itself may be silent for as long as an update takes; a learner that is gone is noticed by the connection.
    let opened = tokio::time::timeout(OPEN_TIMEOUT, client.watch_weights(request)).await;
    let late = |_| Status::deadline_exceeded("the learner did not answer in time");
    let mut stream = opened.map_err(late)??.into_inner();
    let mut assembler = WeightsAssembler::default();
    while let Some(message) = stream.message().await? {
        backoff.reset();
        match assembler.push(message) {
            Ok(Some((weights, _))) => {
                tracing::debug!(version = weights.version.0, bytes = weights.bytes.len(), "weights arrived");
                gauges.weights_bytes.inc_by(weights.bytes.len() as u64);
                gauges.weights_version.set(f64::from(weights.version.0));
                cache.insert(weights);
            }
            Ok(None) => {}
            Err(error) => {
                tracing::warn!(%error, "damaged weights; asking for them again");
                return Err(Status::data_loss(error.to_string()));
            }
        }
    }
    Ok(())
}
