//! The learner's gRPC face, and how it is served.

use crate::collector::{GrpcCollector, StopReason};
use crate::ingest::Limits;
use crate::session;
use crate::state::Shared;
use crate::weights;
use magex_core::ids::RunId;
use magex_proto::v1::learner_service_server::{LearnerService, LearnerServiceServer};
use magex_proto::{FILE_DESCRIPTOR_SET, MAX_MESSAGE_BYTES, v1};
use magex_runtime::health::Health;
use magex_runtime::{server, status};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::transport::server::TcpIncoming;
use tonic::{Request, Response, Status, Streaming};

/// Time of a lease unless configured.
pub const DEFAULT_LEASE: Duration = Duration::from_secs(15);

/// What every peer is told about the run.
#[derive(Debug, Clone, PartialEq)]
pub struct RunIdentity {
    /// Identity of the run.
    pub run_id: RunId,
    /// Name of the run, for people.
    pub name: String,
    /// Fingerprint of the run's task.
    pub task_fingerprint: String,
    /// The run's configuration, TOML.
    pub run_config_toml: String,
    /// Seed of the run.
    pub seed: u64,
    /// An actor that says nothing for so long loses its leases.
    pub lease: Duration,
}

/// The learner's two ends: one for the network, one for the training thread.
pub fn learner_service(run: RunIdentity, limits: Limits) -> (LearnerHandle, GrpcCollector) {
    let shared = Arc::new(Shared::new(run, limits));
    (LearnerHandle { shared: shared.clone() }, GrpcCollector::new(shared))
}

/// The network's end of the learner.
#[derive(Debug, Clone)]
pub struct LearnerHandle {
    shared: Arc<Shared>,
}

/// Why serving failed.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The server.
    #[error("the learner's server failed: {0}")]
    Transport(#[from] tonic::transport::Error),
    /// The descriptors.
    #[error("the learner's reflection service cannot be built: {0}")]
    Reflection(#[from] server::ReflectionError),
}

impl LearnerHandle {
    /// Serves until `shutdown`. Then the trainer is told to stop, actors are told why, streams end, and the call returns
    /// within [`server::GRACE`]. After the end of the run cancel `shutdown`: actors are told that the run is complete.
    pub async fn serve(&self, incoming: TcpIncoming, shutdown: CancellationToken) -> Result<(), ServeError> {
        let (health, health_service) = Health::new::<LearnerServiceServer<LearnerApi>>().await;
        let api = LearnerApi { shared: self.shared.clone() };
        let router = server::builder()
            .add_service(health_service)
            .add_service(LearnerServiceServer::new(api).max_decoding_message_size(MAX_MESSAGE_BYTES));
        let router = server::with_reflection(router, FILE_DESCRIPTOR_SET)?;
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
            shared.stop(StopReason::Shutdown);
            shared.closing.cancel();
        });
        let served = server::serve(router, incoming, shutdown, server::GRACE).await;
        stopping.abort();
        self.close();
        Ok(served?)
    }

    /// How the run stands.
    pub fn status(&self) -> v1::RunStatus {
        self.shared.status()
    }

    /// Tells the trainer to stop at once and ends every stream.
    pub fn close(&self) {
        self.shared.stop(StopReason::Shutdown);
        self.shared.closing.cancel();
    }
}

/// Implements the contract on top of the shared state.
#[derive(Debug)]
struct LearnerApi {
    shared: Arc<Shared>,
}

impl LearnerApi {
    fn check_open(&self) -> Result<(), Status> {
        if self.shared.closing.is_cancelled() {
            return Err(status::unavailable("the learner stops", Duration::from_secs(1)));
        }
        Ok(())
    }
}

#[tonic::async_trait]
impl LearnerService for LearnerApi {
    type RolloutStream = ReceiverStream<Result<v1::RolloutResponse, Status>>;

    // Answers before the first message has come: the actor's call returns only then.
    async fn rollout(
        &self,
        request: Request<Streaming<v1::RolloutRequest>>,
    ) -> Result<Response<Self::RolloutStream>, Status> {
        self.check_open()?;
        let address = request.remote_addr().map_or_else(String::new, |address| address.to_string());
        let (outbound, stream) = mpsc::channel(64);
        tokio::spawn(session::run(self.shared.clone(), address, request.into_inner(), outbound));
        Ok(Response::new(ReceiverStream::new(stream)))
    }

    type WatchWeightsStream = ReceiverStream<Result<v1::WatchWeightsResponse, Status>>;

    async fn watch_weights(
        &self,
        request: Request<v1::WatchWeightsRequest>,
    ) -> Result<Response<Self::WatchWeightsStream>, Status> {
        self.check_open()?;
        let request = request.into_inner();
        let own = &self.shared.run.run_id;
        if !request.run_id.is_empty() && request.run_id != own.0 {
            return Err(status::failed_precondition(format!(
                "run_id: subscriber insists on run '{}', learner serves run '{own}'; leave it empty to take any",
                request.run_id
            )));
        }
        let (reader, stream) = mpsc::channel(1);
        let board = self.shared.board.subscribe();
        let (closing, toml) = (self.shared.closing.clone(), self.shared.run.run_config_toml.clone());
        tokio::spawn(async move { closing.run_until_cancelled(weights::stream(board, toml, reader)).await });
        Ok(Response::new(ReceiverStream::new(stream)))
    }

    async fn get_run(&self, _: Request<v1::GetRunRequest>) -> Result<Response<v1::GetRunResponse>, Status> {
        Ok(Response::new(v1::GetRunResponse { run: Some(self.shared.status()) }))
    }

    type WatchRunStream = ReceiverStream<Result<v1::WatchRunResponse, Status>>;

    async fn watch_run(&self, _: Request<v1::WatchRunRequest>) -> Result<Response<Self::WatchRunStream>, Status> {
        let (reader, stream) = mpsc::channel(64);
        tokio::spawn(self.shared.events.clone().stream(reader, self.shared.closing.clone()));
        Ok(Response::new(ReceiverStream::new(stream)))
    }

    async fn checkpoint(&self, _: Request<v1::CheckpointRequest>) -> Result<Response<v1::CheckpointResponse>, Status> {
        self.check_open()?;
        self.shared.request_checkpoint();
        Ok(Response::new(v1::CheckpointResponse { iteration: self.shared.current_iteration() }))
    }

    async fn drain(&self, request: Request<v1::DrainRequest>) -> Result<Response<v1::DrainResponse>, Status> {
        let reason = request.into_inner().reason;
        tracing::info!(reason, "asked to drain");
        self.shared.stop(StopReason::Drain(reason));
        Ok(Response::new(v1::DrainResponse { iteration: self.shared.current_iteration() }))
    }
}
