//! The learner's gRPC service, and its server.

use crate::report::bottleneck::CollectTiming;
use crate::run_events::StopReason;
use crate::run_identity::RunIdentity;
use crate::serve::grpc_collector::GrpcCollector;
use crate::serve::judge::Judge;
use crate::serve::observer::ServiceObserver;
use crate::serve::session;
use crate::serve::shared::Shared;
use crate::serve::validate::Limits;
use crate::serve::weights_board;
use magex_proto::v1::learner_service_server::{LearnerService, LearnerServiceServer, SERVICE_NAME};
use magex_proto::{FILE_DESCRIPTOR_SET, MAX_MESSAGE_BYTES, v1};
use magex_runtime::health::Health;
use magex_runtime::http::{self, Router};
use magex_runtime::metrics::Metrics;
use magex_runtime::net::auth::{Role, caller, peer_address};
use magex_runtime::net::guard::{Guard, Rules};
use magex_runtime::net::heartbeat::Heartbeat;
use magex_runtime::net::in_flight::{InFlight, InFlightLimits};
use magex_runtime::security::Security;
use magex_runtime::server::{self, Incoming};
use magex_runtime::status;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Result, Streaming};

/// Default time of a lease.
pub const DEFAULT_LEASE: Duration = Duration::from_secs(15);

/// The part of the learner's health that says whether shards get done.
pub const PROGRESS: &str = "progress";

/// How often the learner looks whether they do.
const PROGRESS_PERIOD: Duration = Duration::from_secs(1);

const STREAMS: &[&str] = &["Rollout", "WatchWeights", "WatchRun"];

/// Limits in flight, per caller and in total. All actors of a run may be one caller.
const IN_FLIGHT: InFlightLimits = InFlightLimits { calls: 64, streams: 1024, caller_bytes: 512 << 20, bytes: 1 << 30 };

/// The two ends of the service: one for the network, one for the training thread.
pub fn learner_service(run: RunIdentity, limits: Limits) -> (LearnerHandle, GrpcCollector) {
    let shared = Arc::new(Shared::new(run, limits));
    let weak = Arc::downgrade(&shared);
    shared.registry.before_scrape(move || {
        if let Some(shared) = weak.upgrade() {
            shared.refresh_gauges();
        }
    });
    let collector = GrpcCollector {
        shared: shared.clone(),
        timing: CollectTiming::default(),
        judge: Judge::default(),
        shards: Vec::new(),
        origins: Vec::new(),
        unconfirmed: BTreeMap::new(),
    };
    (LearnerHandle { shared, security: Security::default(), heartbeat: None }, collector)
}

/// The network's end of the service.
#[derive(Debug, Clone)]
pub struct LearnerHandle {
    shared: Arc<Shared>,
    security: Security,
    heartbeat: Option<Duration>,
}

/// Why serving failed.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The server failed.
    #[error("the learner's server failed: {0}")]
    Transport(#[from] tonic::transport::Error),
    /// The descriptors are invalid.
    #[error("the learner's reflection service cannot be built: {0}")]
    Reflection(#[from] server::ReflectionError),
}

impl LearnerHandle {
    /// Sets the access rules of the port. Without them every caller may use every method.
    #[must_use]
    pub fn guarded(self, security: Security) -> Self {
        Self { security, ..self }
    }

    /// Sets the time between heartbeats on streams.
    #[must_use]
    pub fn beating(self, heartbeat: Option<Duration>) -> Self {
        Self { heartbeat, ..self }
    }

    /// Serves until `shutdown`. Then the trainer stops, actors receive the reason, streams end, and the call returns within
    /// [`server::GRACE`]. Cancel `shutdown` after the end of the run too: actors then receive that the run is complete.
    pub async fn serve(&self, incoming: Incoming, shutdown: CancellationToken) -> Result<(), ServeError> {
        let (health, health_service) = Health::new::<LearnerServiceServer<Self>>().await;
        let service = LearnerServiceServer::new(self.clone()).max_decoding_message_size(MAX_MESSAGE_BYTES);
        let connections = incoming.connections();
        let rules = Rules {
            access: self.security.access.clone(),
            // Callers learn from the service itself that it stops, and why.
            in_flight: InFlight::new(IN_FLIGHT, CancellationToken::new()),
            streams: STREAMS,
            message_bytes: MAX_MESSAGE_BYTES,
            too_long: None,
            calls: None,
        };
        let router = server::builder()
            .add_service(Guard::public(health_service, connections.clone()))
            .add_service(Guard::guarded(service, rules, connections.clone()));
        let router = server::with_reflection(router, SERVICE_NAME, FILE_DESCRIPTOR_SET, &connections)?;
        let watching = tokio::spawn(watch_progress(self.shared.clone(), health.clone()));
        let shared = self.shared.clone();
        let stopped = shutdown.clone();
        let stopping = tokio::spawn(async move {
            tokio::select! {
                // Ready with the first weights.
                () = shared.board.first() => health.set(true).await,
                () = stopped.cancelled() => {}
            }
            stopped.cancelled().await;
            health.set(false).await;
            shared.close();
        });
        let served = server::serve(router, incoming, self.security.tls.clone(), shutdown, server::GRACE).await;
        stopping.abort();
        watching.abort();
        self.close();
        Ok(served?)
    }

    /// Where the service counts.
    pub fn metrics(&self) -> &Metrics {
        &self.shared.registry
    }

    /// Health and metrics over plain HTTP.
    pub fn routes(&self) -> Router {
        http::routes(self.shared.registry.clone())
    }

    /// The status of the run.
    pub fn status(&self) -> v1::RunStatus {
        self.shared.run_status()
    }

    /// The observer through which the training thread reports to the service.
    pub fn observer(&self) -> ServiceObserver {
        ServiceObserver { shared: self.shared.clone() }
    }

    /// Returns after the first request to stop: a drain or a shutdown.
    pub async fn stop_signal(&self) {
        self.shared.control.stop_signal.cancelled().await;
    }

    /// Stops the trainer at once and ends every stream.
    pub fn close(&self) {
        self.shared.close();
    }

    fn check_open(&self) -> Result<()> {
        if self.shared.control.closing.is_cancelled() {
            return Err(status::unavailable("the learner is shutting down", Duration::from_secs(1)));
        }
        Ok(())
    }
}

/// Says it, in the health and in the log, when no shard gets done although there is work and there are actors.
async fn watch_progress(shared: Arc<Shared>, health: Health) {
    let mut moving = None;
    loop {
        let stalled = shared.stalled();
        if moving != Some(stalled.is_none()) {
            health.set_part(PROGRESS, stalled.is_none()).await;
            match &stalled {
                Some((since, holders)) => {
                    tracing::warn!(
                        since_s = since.as_secs_f64(),
                        holders,
                        "no shard gets done: every actor that has one hangs"
                    );
                }
                None if moving.is_some() => tracing::info!("shards get done again"),
                None => {}
            }
            moving = Some(stalled.is_none());
        }
        tokio::time::sleep(PROGRESS_PERIOD).await;
    }
}

#[tonic::async_trait]
impl LearnerService for LearnerHandle {
    type RolloutStream = ReceiverStream<Result<v1::RolloutResponse>>;

    // Answers before the first message arrives, because the actor's call returns only then.
    async fn rollout(&self, request: Request<Streaming<v1::RolloutRequest>>) -> Result<Response<Self::RolloutStream>> {
        caller(&request, &[Role::Actor])?;
        self.check_open()?;
        let address = peer_address(request.extensions()).map_or_else(String::new, |address| address.to_string());
        let (outbound, stream) = mpsc::channel(64);
        tokio::spawn(session::serve(self.shared.clone(), address, request.into_inner(), outbound));
        Ok(Response::new(ReceiverStream::new(stream)))
    }

    type WatchWeightsStream = ReceiverStream<Result<v1::WatchWeightsResponse>>;

    async fn watch_weights(
        &self,
        request: Request<v1::WatchWeightsRequest>,
    ) -> Result<Response<Self::WatchWeightsStream>> {
        caller(&request, &[Role::Actor, Role::Commander])?;
        self.check_open()?;
        let request = request.into_inner();
        let own = &self.shared.run.run_id;
        if !request.run_id.is_empty() && request.run_id != own.0 {
            return Err(status::failed_precondition(format!(
                "run_id: subscriber requires run '{}', learner serves run '{own}'; leave it empty to accept any",
                request.run_id
            )));
        }
        let permit = self.shared.watcher()?;
        let (reader, stream) = mpsc::channel(1);
        let board = self.shared.board.subscribe();
        let (closing, toml) = (self.shared.control.closing.clone(), self.shared.run.run_config_toml.clone());
        let (shared, patience) = (self.shared.clone(), self.shared.lease_time());
        let (subscribed, beat) = (shared.metrics.subscriber(request.role()), Heartbeat::new(self.heartbeat));
        tokio::spawn(async move {
            let _subscribed = subscribed;
            let sent = |version| {
                if let Some(since) = shared.board.since(version) {
                    shared.metrics.weights_published.observe(since.elapsed().as_secs_f64());
                }
            };
            closing.run_until_cancelled(weights_board::stream(board, toml, reader, patience, beat, sent)).await;
            drop(permit);
        });
        Ok(Response::new(ReceiverStream::new(stream)))
    }

    async fn get_run(&self, request: Request<v1::GetRunRequest>) -> Result<Response<v1::GetRunResponse>> {
        caller(&request, &[Role::Client])?;
        Ok(Response::new(v1::GetRunResponse { run: Some(self.shared.run_status()) }))
    }

    type WatchRunStream = ReceiverStream<Result<v1::WatchRunResponse>>;

    async fn watch_run(&self, request: Request<v1::WatchRunRequest>) -> Result<Response<Self::WatchRunStream>> {
        caller(&request, &[Role::Client])?;
        let permit = self.shared.watcher()?;
        let (reader, stream) = mpsc::channel(64);
        let (events, closing) = (self.shared.events.clone(), self.shared.control.closing.clone());
        let sending = events.stream(reader, closing, self.shared.lease_time(), Heartbeat::new(self.heartbeat));
        tokio::spawn(async move {
            sending.await;
            drop(permit);
        });
        Ok(Response::new(ReceiverStream::new(stream)))
    }

    async fn checkpoint(&self, request: Request<v1::CheckpointRequest>) -> Result<Response<v1::CheckpointResponse>> {
        caller(&request, &[])?;
        self.check_open()?;
        let refusal = match self.shared.run_status().state() {
            v1::RunState::Finished => "the run is complete and already on disk",
            v1::RunState::WaitingForActors => {
                "no actor is connected, so the iteration cannot end and no checkpoint is written; start actors, or drain the \
                 learner, which writes one at once"
            }
            _ => {
                self.shared.control.request_checkpoint();
                let iteration = self.shared.status.current_iteration();
                return Ok(Response::new(v1::CheckpointResponse { iteration }));
            }
        };
        Err(status::failed_precondition(refusal))
    }

    async fn drain(&self, request: Request<v1::DrainRequest>) -> Result<Response<v1::DrainResponse>> {
        caller(&request, &[])?;
        let reason = request.into_inner().reason;
        tracing::info!(reason, "drain requested");
        self.shared.stop(StopReason::Drain(reason));
        Ok(Response::new(v1::DrainResponse { iteration: self.shared.status.current_iteration() }))
    }
}
