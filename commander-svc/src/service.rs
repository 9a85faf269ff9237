//! How the commander is put together and served.

use crate::assign_service::Answering;
use crate::api::{CommanderApi, STREAMS};
use crate::shard_assign::Batches;
use crate::metrics::{self, CommanderGauges};
use crate::mission_service::Keeper;
use crate::scheduler::LoadScheduler;
use crate::model_store::Store;
use crate::subscription;
use crate::weights_file::{WeightsError, WeightsFile};
use magex_dispatch::Limits;
use magex_dispatch::disk::{Disk, DiskError};
use magex_dispatch::missions::{Bounds, Missions};
use magex_proto::v1::commander_service_server::CommanderServiceServer;
use magex_proto::{FILE_DESCRIPTOR_SET, MAX_BATCH_BYTES};
use magex_runtime::net::in_flight::{Admission, FlightLimits, Kind};
use magex_runtime::net::call_metrics::Counted;
use magex_runtime::client::{Settings, UrlError};
use magex_runtime::net::deadline::Deadline;
use magex_runtime::net::guard::{Door, Open, Rules};
use magex_runtime::health::Health;
use magex_runtime::metrics::Metrics;
use magex_runtime::security::Security;
use magex_runtime::server::{self, Incoming};
use magex_runtime::tls::TlsError;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

/// How often missions are looked through for those whose time is over.
const SWEEP: Duration = Duration::from_secs(2);
/// Bytes of requests that are on their way or at work: of one caller, and of everybody.
const CALLER_BYTES: usize = 64 << 20;
const BYTES: usize = 256 << 20;
/// Name of the file with the missions.
const MISSIONS: &str = "missions.redb";

/// What a commander is and may.
#[derive(Debug, Clone)]
pub struct CommanderConfig {
    /// The learner whose weights are followed, `http://host:port`.
    pub learner_url: Option<String>,
    /// What the learner is shown.
    pub client: Settings,
    /// Weights that are there from the start, and followed.
    pub weights: Option<WeightsFile>,
    /// Folder for the missions; without it they end with the process.
    pub data: Option<PathBuf>,
    /// How the port is guarded.
    pub security: Security,
    /// Sizes of requests.
    pub limits: Limits,
    /// Longest message, bytes.
    pub message_bytes: usize,
    /// Calls in flight of one caller.
    pub calls: usize,
    /// Open streams of one caller.
    pub streams: usize,
    /// How many missions, how large and how old.
    pub missions: Bounds,
    /// How long a service that was told to stop goes on saying so before it closes its doors.
    pub drain: Duration,
    /// What it counts.
    pub metrics: Arc<Metrics>,
}

impl Default for CommanderConfig {
    fn default() -> Self {
        Self {
            learner_url: None,
            client: Settings::default(),
            weights: None,
            data: None,
            security: Security::default(),
            limits: Limits::default(),
            message_bytes: MAX_BATCH_BYTES,
            calls: 64,
            streams: 16,
            missions: Bounds::default(),
            drain: Duration::ZERO,
            metrics: Arc::default(),
        }
    }
}

impl CommanderConfig {
    fn flights(&self) -> FlightLimits {
        // One message of the longest kind has to fit.
        let caller_bytes = CALLER_BYTES.max(self.message_bytes);
        FlightLimits { calls: self.calls, streams: self.streams, caller_bytes, bytes: BYTES.max(self.message_bytes) }
    }
}

/// Why serving failed.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The learner's address is wrong.
    #[error("learner: {0}")]
    Url(#[from] UrlError),
    /// The weights that were given cannot be used.
    #[error("weights: {0}")]
    Weights(#[from] WeightsError),
    /// The missions cannot be read.
    #[error("missions in {}: {source}", path.display())]
    Missions {
        /// Their file or folder.
        path: PathBuf,
        /// Why.
        source: DiskError,
    },
    /// The folder for the missions cannot be made.
    #[error("--data {}: {source}", path.display())]
    Data {
        /// The folder.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The certificates.
    #[error("tls: {0}")]
    Tls(#[from] TlsError),
    /// The server.
    #[error("the commander's server failed: {0}")]
    Transport(#[from] tonic::transport::Error),
    /// The descriptors.
    #[error("the commander's reflection service cannot be built: {0}")]
    Reflection(#[from] server::ReflectionError),
}

/// Serves until `shutdown`, then says so for `config.drain` and returns within [`server::GRACE`] more. Serving means: with
/// a model, unless there is nowhere to get one from; then the classical schedulers are all there is.
pub async fn run(
    config: CommanderConfig,
    load_scheduler: LoadScheduler,
    incoming: Incoming,
    shutdown: CancellationToken,
) -> Result<(), ServeError> {
    let store = Arc::new(Store::new());
    let classical_only = config.learner_url.is_none() && config.weights.is_none();
    let draining = CancellationToken::new();
    let admission = Admission::new(config.flights(), draining.clone());
    // Ends with this function, whichever way.
    let mut helpers = JoinSet::new();
    if let Some(file) = config.weights {
        let loaded = file.first(&store, load_scheduler).await?;
        helpers.spawn(file.follow(loaded, store.clone(), load_scheduler));
    }
    if let Some(url) = &config.learner_url {
        helpers.spawn(subscription::follow(config.client.lazy_channel(url)?, store.clone(), load_scheduler));
    }
    let gauges = Arc::new(CommanderGauges::new(&config.metrics));
    let answering = Answering::new(store.clone(), gauges.clone());
    let keeper = Keeper::new(open_missions(config.data, config.missions).await?, answering.clone());
    let (sweeper, closer) = (keeper.clone(), keeper.clone());
    helpers.spawn(async move {
        loop {
            sweeper.sweep().await;
            tokio::time::sleep(SWEEP).await;
        }
    });
    let (limits, store_of_api) = (config.limits, store.clone());
    metrics::watch(&config.metrics, &gauges, &store, &keeper, &admission, &answering);
    let api = CommanderApi {
        store: store_of_api,
        batches: Batches::new(store.clone(), answering.clone()),
        answering,
        keeper,
        admission: admission.clone(),
        limits,
        draining: draining.clone(),
    };
    let (health, health_service) = Health::new::<CommanderServiceServer<CommanderApi>>().await;
    let service = CommanderServiceServer::new(api)
        .max_decoding_message_size(config.message_bytes)
        .max_encoding_message_size(config.message_bytes.max(MAX_BATCH_BYTES));
    let Security { tls, access } = config.security;
    let connections = incoming.connections();
    let rules = Rules {
        access,
        admission: admission.clone(),
        streams: STREAMS,
        message_bytes: config.message_bytes,
        connections: connections.clone(),
    };
    let router = server::secure_builder(tls.as_ref())?
        .add_service(Open::new(health_service, connections.clone()))
        .add_service(Counted::new(Door::new(Deadline::new(service), rules), gauges.calls.clone()));
    let router = server::with_reflection(router, FILE_DESCRIPTOR_SET, &connections)?;
    let closed = CancellationToken::new();
    let (told, closing, drain) = (shutdown, closed.clone(), config.drain);
    helpers.spawn(async move {
        if classical_only || told.run_until_cancelled(store.ready()).await.is_some() {
            health.set(true).await;
            told.cancelled().await;
        }
        // First the truth, then no more work, then the doors: who asks in between is told to go elsewhere.
        health.set(false).await;
        draining.cancel();
        tokio::time::sleep(drain).await;
        tracing::debug!(calls = admission.count(Kind::Call), "closing the doors");
        closing.cancel();
    });
    let served = server::serve(router, incoming, closed, server::GRACE).await;
    helpers.abort_all();
    // Connections that were left may hold on to the rest for a while.
    let _ = tokio::task::spawn_blocking(move || closer.close()).await;
    Ok(served?)
}

async fn open_missions(data: Option<PathBuf>, bounds: Bounds) -> Result<Missions, ServeError> {
    let Some(folder) = data else {
        tracing::debug!("no --data folder: missions end with this process");
        return Missions::open(None, bounds).map_err(|source| ServeError::Missions { path: PathBuf::new(), source });
    };
    std::fs::create_dir_all(&folder).map_err(|source| ServeError::Data { path: folder.clone(), source })?;
    let path = folder.join(MISSIONS);
    let file = path.clone();
    let opening = tokio::task::spawn_blocking(move || Missions::open(Some(Disk::open(&file)?), bounds));
    match opening.await {
        Ok(opened) => opened.map_err(|source| ServeError::Missions { path, source }),
        Err(error) => Err(ServeError::Data { path, source: std::io::Error::other(error) }),
    }
}
