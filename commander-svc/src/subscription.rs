//! Keeps the store filled with what the learner publishes.

use crate::model_store::{Model, ModelStore};
use crate::scheduler::{LoadScheduler, WeightsKey};
use magex_proto::v1::learner_service_client::LearnerServiceClient;
use magex_proto::weights::{Weights, WeightsAssembler};
use magex_proto::{MAX_MESSAGE_BYTES, v1};
use magex_runtime::backoff::Backoff;
use magex_runtime::client::Channel;
use std::sync::Arc;
use std::time::Duration;
use tonic::Status;

/// A learner that does not begin to answer within this time is asked again.
const OPEN_TIMEOUT: Duration = Duration::from_secs(10);

/// Follows the learner's weights for ever, through every break of the connection.
pub(crate) async fn follow(channel: Channel, store: Arc<ModelStore>, load_scheduler: LoadScheduler) {
    let mut backoff = Backoff::default();
    let mut waiting = false;
    loop {
        let reason = match watch(channel.clone(), &store, load_scheduler, &mut backoff, &mut waiting).await {
            Ok(()) => "the stream ended".to_owned(),
            Err(status) => status.message().to_owned(),
        };
        if !waiting {
            tracing::warn!(reason, "no learner; trying again until there is one");
            waiting = true;
        }
        tokio::time::sleep(backoff.next_wait()).await;
    }
}

async fn watch(
    channel: Channel,
    store: &ModelStore,
    load_scheduler: LoadScheduler,
    backoff: &mut Backoff,
    waiting: &mut bool,
) -> Result<(), Status> {
    let mut client = LearnerServiceClient::new(channel).max_decoding_message_size(MAX_MESSAGE_BYTES);
    let request = v1::WatchWeightsRequest {
        run_id: String::new(),
        subscriber_id: "commander".to_owned(),
        role: v1::SubscriberRole::Commander.into(),
    };
    // The stream itself may be silent for as long as an update takes; a learner that is gone is noticed by the connection.
    let opened = tokio::time::timeout(OPEN_TIMEOUT, client.watch_weights(request)).await;
    let late = |_| Status::deadline_exceeded("the learner did not answer in time");
    let mut stream = opened.map_err(late)??.into_inner();
    let mut assembler = WeightsAssembler::default();
    while let Some(message) = stream.message().await? {
        if *waiting {
            tracing::info!("connected to a learner");
        }
        *waiting = false;
        backoff.reset();
        match assembler.push(message) {
            Ok(Some((weights, toml))) => load(weights, toml, store, load_scheduler).await,
            Ok(None) => {}
            Err(error) => {
                tracing::warn!(%error, "damaged weights; asking for them again");
                return Err(Status::data_loss(error.to_string()));
            }
        }
    }
    Ok(())
}

/// Makes a model of weights and puts it into the store, usable or not.
pub(crate) async fn load(weights: Weights, toml: String, store: &ModelStore, load_scheduler: LoadScheduler) {
    let Weights { run_id, version, sha256, bytes } = weights;
    let key = WeightsKey { run_id, version, sha256 };
    let loading = tokio::task::spawn_blocking(move || load_scheduler(&bytes, &toml));
    let scheduler = match loading.await {
        Ok(loaded) => loaded.map_err(|error| error.to_string()),
        Err(error) => Err(error.to_string()),
    };
    match &scheduler {
        Ok(_) => tracing::debug!(version = key.version.0, "a model is ready"),
        Err(reason) => tracing::error!(version = key.version.0, reason, "weights cannot be used"),
    }
    store.insert(Model { key: Arc::new(key), scheduler });
}
