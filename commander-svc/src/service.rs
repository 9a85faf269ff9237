//! Builds the commander and serves it.

use crate::api::{CommanderApi, STREAMS};
use crate::assign_service::AssignService;
use crate::metrics::CommanderMetrics;
use crate::mission_service::MissionService;
use crate::model_store::ModelStore;
use crate::policy_service::PolicyApi;
use crate::scheduler::LoadScheduler;
use crate::shard_assign::ShardAssign;
use crate::subscription;
use crate::weights_file::WeightsFile;
use magex_dispatch::Limits;
use magex_dispatch::disk::Disk;
use magex_dispatch::missions::{Bounds, Missions};
use magex_proto::v1::commander_service_server::{CommanderServiceServer, SERVICE_NAME};
use magex_proto::v1::policy_service_server::PolicyServiceServer;
use magex_proto::{FILE_DESCRIPTOR_SET, LEARNER, MAX_BATCH_BYTES, SERVICES};
use magex_runtime::client::Settings;
use magex_runtime::exit::{self, Failure};
use magex_runtime::health::Health;
use magex_runtime::metrics::Metrics;
use magex_runtime::net::guard::{Guard, Rules};
use magex_runtime::net::in_flight::{CallKind, InFlight, InFlightLimits};
use magex_runtime::peer::Remote;
use magex_runtime::security::Security;
use magex_runtime::server::{self, Incoming};
use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

/// How often expired missions are deleted.
const SWEEP: Duration = Duration::from_secs(2);
/// Number of these after which the clock of missions is written down, if no change does.
const NOTE: u64 = 30;
/// Bytes of requests in flight: of one caller, and of all callers.
const CALLER_BYTES: usize = 64 << 20;
const BYTES: usize = 256 << 20;
/// What to do about a message beyond --max-message.
const TOO_LONG: &str = "raise --max-message (MiB), or send positions or sparse_costs in place of a cost matrix";
/// Name of the file with the missions.
const MISSIONS: &str = "missions.redb";

/// Configuration of a commander.
#[derive(Debug, Clone)]
pub struct ServiceConfig {
    /// Learner whose weights are used, `http://host:port`.
    pub learner_url: Option<String>,
    /// Credentials for the learner.
    pub client: Settings,
    /// Weights file, loaded at the start and whenever it is replaced.
    pub weights: Option<WeightsFile>,
    /// Folder of the missions; without it they are lost when the process ends.
    pub data: Option<PathBuf>,
    /// Security of the port.
    pub security: Security,
    /// Limits of a request.
    pub limits: Limits,
    /// Longest message, bytes.
    pub message_bytes: usize,
    /// Calls in flight of one caller.
    pub calls: usize,
    /// Open streams of one caller.
    pub streams: usize,
    /// Limits of the missions.
    pub missions: Bounds,
    /// Agents of a step, all teams together, that a policy acts for.
    pub act_agents: usize,
    /// How long a stopping service rejects calls with UNAVAILABLE before it closes its port.
    pub drain: Duration,
    /// Time between heartbeats on streams; `None` for none.
    pub heartbeat: Option<Duration>,
    /// Its metrics.
    pub metrics: Arc<Metrics>,
}

impl Default for ServiceConfig {
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
            act_agents: 2000,
            drain: Duration::ZERO,
            heartbeat: None,
            metrics: Arc::default(),
        }
    }
}

impl ServiceConfig {
    fn in_flight(&self) -> InFlightLimits {
        // A message of the maximum size must fit.
        let caller_bytes = CALLER_BYTES.max(self.message_bytes);
        InFlightLimits { calls: self.calls, streams: self.streams, caller_bytes, bytes: BYTES.max(self.message_bytes) }
    }
}

/// [`run_and_tell`] without a listener for readiness.
pub async fn run(
    config: ServiceConfig,
    load_scheduler: LoadScheduler,
    incoming: Incoming,
    shutdown: CancellationToken,
) -> Result<(), Failure> {
    run_and_tell(config, load_scheduler, incoming, shutdown, || ()).await
}

/// Serves until `shutdown`, then drains for `config.drain` and returns within [`server::GRACE`] more. The health is SERVING once
/// a model is loaded, or at once if neither a learner nor weights are configured. `ready` is called once everything that was
/// configured is open: files, weights, and the learner's first weights.
pub async fn run_and_tell(
    config: ServiceConfig,
    load_scheduler: LoadScheduler,
    incoming: Incoming,
    shutdown: CancellationToken,
    ready: impl FnOnce() + Send + 'static,
) -> Result<(), Failure> {
    // The folder first: it is checked at once, and weights may take a while.
    let missions = open_missions(config.data.clone(), config.missions).await?;
    let store = Arc::new(ModelStore::new());
    let without_model = config.learner_url.is_none() && config.weights.is_none();
    let draining = CancellationToken::new();
    let in_flight = InFlight::new(config.in_flight(), draining.clone());
    // Aborted when this function returns.
    let mut helpers = JoinSet::new();
    if let Some(file) = config.weights {
        let loaded =
            file.first(&store, load_scheduler).await.map_err(|error| Failure::usage(format!("--weights: {error}")))?;
        helpers.spawn(file.follow(loaded, store.clone(), load_scheduler));
    }
    if let Some(url) = &config.learner_url {
        let learner = Remote { url: url.clone(), settings: config.client.clone(), wanted: LEARNER, known: &SERVICES };
        let channel = learner.channel().map_err(|error| Failure::usage(format!("--learner: {error}")))?;
        helpers.spawn(subscription::follow(learner, channel, store.clone(), load_scheduler));
    }
    let metrics = Arc::new(CommanderMetrics::new(&config.metrics));
    let answering = AssignService::new(store.clone(), metrics.clone());
    let missions = MissionService::new(missions, answering.clone());
    let (sweeper, closer) = (missions.clone(), missions.clone());
    helpers.spawn(async move {
        for sweep in 1u64.. {
            sweeper.sweep().await;
            if sweep % NOTE == 0 {
                sweeper.note_time().await;
            }
            tokio::time::sleep(SWEEP).await;
        }
    });
    let acting = PolicyApi {
        store: store.clone(),
        answering: answering.clone(),
        in_flight: in_flight.clone(),
        agents: config.act_agents,
        draining: draining.clone(),
        heartbeat: config.heartbeat,
    };
    let api = Arc::new(CommanderApi {
        store: store.clone(),
        shards: ShardAssign::new(store.clone(), answering.clone()),
        answering,
        missions,
        in_flight: in_flight.clone(),
        limits: config.limits,
        draining: draining.clone(),
        heartbeat: config.heartbeat,
    });
    let weak = Arc::downgrade(&api);
    config.metrics.before_scrape(move || {
        if let Some(api) = weak.upgrade() {
            api.refresh_gauges();
        }
    });
    let (health, health_service) = Health::new::<CommanderServiceServer<CommanderApi>>().await;
    let service = CommanderServiceServer::from_arc(api)
        .max_decoding_message_size(config.message_bytes)
        .max_encoding_message_size(config.message_bytes.max(MAX_BATCH_BYTES));
    let Security { tls, access } = config.security;
    let connections = incoming.connections();
    let acting = PolicyServiceServer::new(acting)
        .max_decoding_message_size(config.message_bytes)
        .max_encoding_message_size(config.message_bytes);
    let rules = |access| Rules {
        access,
        in_flight: in_flight.clone(),
        streams: STREAMS,
        message_bytes: config.message_bytes,
        too_long: Some(TOO_LONG),
        calls: Some(metrics.calls.clone()),
    };
    let internal =
        |what: &str, error: &dyn Display| Failure::new(exit::INTERNAL, format!("the commander's {what}: {error}"));
    let router = server::builder()
        .add_service(Guard::public(health_service, connections.clone()))
        .add_service(Guard::guarded(acting, rules(access.clone()), connections.clone()))
        .add_service(Guard::guarded(service, rules(access), connections.clone()));
    let router = server::with_reflection(router, SERVICE_NAME, FILE_DESCRIPTOR_SET, &connections)
        .map_err(|error| internal("reflection service cannot be built", &error))?;
    let closed = CancellationToken::new();
    let (stop, closing, drain) = (shutdown, closed.clone(), config.drain);
    helpers.spawn(async move {
        if without_model || stop.run_until_cancelled(store.ready()).await.is_some() {
            health.set(true).await;
            ready();
            stop.cancelled().await;
        }
        // Shutdown order: report NOT_SERVING, reject new calls with UNAVAILABLE for `drain`, then close the listener.
        health.set(false).await;
        draining.cancel();
        tokio::time::sleep(drain).await;
        tracing::debug!(calls = in_flight.count(CallKind::Call), "closing the listener");
        closing.cancel();
    });
    let served = server::serve(router, incoming, tls, closed, server::GRACE).await;
    helpers.abort_all();
    // Dropped connections may keep the service alive for a while, but another commander may need the file.
    let _ = tokio::task::spawn_blocking(move || closer.missions.close()).await;
    served.map_err(|error| internal("server failed", &error))
}

/// Opens the file of the missions on a thread that may block.
async fn open_missions(data: Option<PathBuf>, bounds: Bounds) -> Result<Missions, Failure> {
    let cannot = |what: &str, path: &Path, error: &dyn Display| {
        Failure::new(exit::CANNOT_CREATE, format!("{what} {}: {error}", path.display()))
    };
    let path = match &data {
        Some(folder) => {
            if folder.exists() && !folder.is_dir() {
                return Err(cannot("--data", folder, &"a file; give a folder"));
            }
            std::fs::create_dir_all(folder).map_err(|error| cannot("--data", folder, &error))?;
            folder.join(MISSIONS)
        }
        None => {
            tracing::debug!("no --data folder: missions are lost when the process ends");
            PathBuf::new()
        }
    };
    let file = data.map(|_| path.clone());
    let open = move || Missions::open(file.as_deref().map(Disk::open).transpose()?, bounds);
    let opened = tokio::task::spawn_blocking(open).await.map_err(|error| cannot("--data", &path, &error))?;
    opened.map_err(|error| cannot("missions in", &path, &error))
}
