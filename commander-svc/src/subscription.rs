//! Keeps the store filled with what the learner publishes.

use crate::model_store::{Model, ModelStore};
use crate::scheduler::{LoadScheduler, WeightsKey};
use magex_proto::v1::SubscriberRole;
use magex_proto::weights::Weights;
use magex_proto::weights_watch::{OPEN_TIMEOUT, WeightsStream, late};
use magex_runtime::backoff::Backoff;
use magex_runtime::client::Channel;
use magex_runtime::peer::{Complaints, Remote};
use std::sync::Arc;
use tonic::Status;

/// Follows the learner's weights and reconnects after every failure. Never returns.
pub(crate) async fn follow(learner: Remote, channel: Channel, store: Arc<ModelStore>, load_scheduler: LoadScheduler) {
    let mut backoff = Backoff::default();
    let mut complaints = Complaints::default();
    loop {
        let ended = watch(channel.clone(), &store, load_scheduler, &mut backoff, &mut complaints).await;
        let status = ended.err().unwrap_or_else(|| Status::unavailable("the stream ended"));
        let problem = learner.explain(&status).await;
        if complaints.due(&problem) {
            tracing::warn!(reason = problem.text, "no learner; retrying");
        }
        tokio::time::sleep(backoff.next_wait()).await;
    }
}

async fn watch(
    channel: Channel,
    store: &ModelStore,
    load_scheduler: LoadScheduler,
    backoff: &mut Backoff,
    complaints: &mut Complaints,
) -> Result<(), Status> {
    let opening = WeightsStream::open(channel, "commander", SubscriberRole::Commander);
    let mut stream = tokio::time::timeout(OPEN_TIMEOUT, opening).await.map_err(late)??;
    while let Some((weights, toml)) = stream.next().await? {
        if complaints.over() {
            tracing::info!("connected to a learner");
        }
        backoff.reset();
        load(weights, toml, store, load_scheduler).await;
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
