//! Keeps the weights cache filled: a connection of its own, so that bulk results never delay weights.

use crate::cache::WeightsCache;
use magex_proto::v1::learner_service_client::LearnerServiceClient;
use magex_proto::weights::WeightsAssembler;
use magex_proto::{MAX_MESSAGE_BYTES, v1};
use magex_runtime::backoff::Backoff;
use std::sync::Arc;
use tonic::Status;
use tonic::transport::Channel;

/// Follows the learner's weights for ever, through every break of the connection.
pub(crate) async fn follow(channel: Channel, actor_id: String, cache: Arc<WeightsCache>) {
    let mut backoff = Backoff::default();
    loop {
        let end = watch(channel.clone(), &actor_id, &cache, &mut backoff).await;
        match end {
            Ok(()) => tracing::debug!("the weights stream ended"),
            Err(status) => tracing::debug!(reason = status.message(), "the weights stream broke"),
        }
        tokio::time::sleep(backoff.next_wait()).await;
    }
}

async fn watch(channel: Channel, actor_id: &str, cache: &WeightsCache, backoff: &mut Backoff) -> Result<(), Status> {
    let mut client = LearnerServiceClient::new(channel).max_decoding_message_size(MAX_MESSAGE_BYTES);
    let request = v1::WatchWeightsRequest {
        run_id: String::new(),
        subscriber_id: actor_id.to_owned(),
        role: v1::SubscriberRole::Actor.into(),
    };
    let mut stream = client.watch_weights(request).await?.into_inner();
    let mut assembler = WeightsAssembler::default();
    while let Some(message) = stream.message().await? {
        backoff.reset();
        match assembler.push(message) {
            Ok(Some((weights, _))) => {
                tracing::debug!(version = weights.version.0, bytes = weights.bytes.len(), "weights arrived");
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
