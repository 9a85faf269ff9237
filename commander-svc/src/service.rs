//! The commander's gRPC face, and how it is served.

use crate::assign::{self, Team};
use crate::classical;
use crate::scheduler::{AssignError, GoalReply, GoalRequest, LoadScheduler, SchedulerKind, TeamReply, WeightsKey};
use crate::store::Store;
use crate::subscription;
use magex_proto::convert::ConvertError;
use magex_proto::v1::commander_service_server::{CommanderService, CommanderServiceServer};
use magex_proto::weights::Weights;
use magex_proto::{FILE_DESCRIPTOR_SET, MAX_BATCH_BYTES, v1};
use magex_runtime::backoff::incarnation;
use magex_runtime::client::{UrlError, lazy_channel};
use magex_runtime::health::Health;
use magex_runtime::{server, status};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};
use tokio::sync::{Semaphore, SemaphorePermit};
use tokio_util::sync::CancellationToken;
use tonic::transport::server::TcpIncoming;
use tonic::{Request, Response, Status};

/// How long an actor's request waits for the weights that it names.
const WEIGHTS_PATIENCE: Duration = Duration::from_secs(5);

/// How long a request waits for a processor before it is turned away.
const QUEUE_PATIENCE: Duration = Duration::from_secs(1);

/// How long the learned scheduler may take for one team before the exact one answers in its place.
const LEARNED_PATIENCE: Duration = Duration::from_millis(500);

/// Where a commander gets its models from.
#[derive(Debug, Clone, Default)]
pub struct CommanderConfig {
    /// The learner whose weights are followed, `http://host:port`.
    pub learner_url: Option<String>,
    /// Weights that are there from the start, with the run's configuration (TOML).
    pub model: Option<(Weights, String)>,
}

/// Why serving failed.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The learner's address is wrong.
    #[error("learner: {0}")]
    Url(#[from] UrlError),
    /// The weights that were given cannot be used.
    #[error("weights: {0}")]
    Weights(AssignError),
    /// The server.
    #[error("the commander's server failed: {0}")]
    Transport(#[from] tonic::transport::Error),
    /// The descriptors.
    #[error("the commander's reflection service cannot be built: {0}")]
    Reflection(#[from] server::ReflectionError),
}

/// Serves until `shutdown`, then returns within [`server::GRACE`]. Serving means: with a model, unless there is nowhere to get
/// one from; then the classical schedulers are all there is.
pub async fn run(
    config: CommanderConfig,
    load_scheduler: LoadScheduler,
    incoming: TcpIncoming,
    shutdown: CancellationToken,
) -> Result<(), ServeError> {
    let store = Arc::new(Store::new());
    let classical_only = config.learner_url.is_none() && config.model.is_none();
    if let Some((weights, toml)) = config.model {
        // Once to be told what is wrong, before anything is served.
        load_scheduler(&weights.bytes, &toml).map_err(ServeError::Weights)?;
        subscription::load(weights, toml, &store, load_scheduler).await;
    }
    let channel = config.learner_url.as_deref().map(lazy_channel).transpose()?;
    let follower = channel.map(|channel| tokio::spawn(subscription::follow(channel, store.clone(), load_scheduler)));

    let (health, health_service) = Health::new::<CommanderServiceServer<CommanderApi>>().await;
    let api = CommanderApi::new(store.clone(), shutdown.clone());
    let router = server::builder().add_service(health_service).add_service(
        CommanderServiceServer::new(api)
            .max_decoding_message_size(MAX_BATCH_BYTES)
            .max_encoding_message_size(MAX_BATCH_BYTES),
    );
    let router = server::with_reflection(router, FILE_DESCRIPTOR_SET)?;
    let stopping = shutdown.clone();
    let truth = tokio::spawn(async move {
        if !classical_only && stopping.run_until_cancelled(store.ready()).await.is_none() {
            return;
        }
        health.set(true).await;
        stopping.cancelled().await;
        health.set(false).await;
    });
    let served = server::serve(router, incoming, shutdown, server::GRACE).await;
    truth.abort();
    if let Some(follower) = follower {
        follower.abort();
    }
    Ok(served?)
}

/// Implements the contract on top of the store.
#[derive(Debug)]
struct CommanderApi {
    store: Arc<Store>,
    /// Processors: more requests at once would only slow each other down.
    processors: Semaphore,
    /// Seeds of requests that bring none.
    next_seed: AtomicU64,
    closing: CancellationToken,
}

impl CommanderApi {
    fn new(store: Arc<Store>, closing: CancellationToken) -> Self {
        let processors = std::thread::available_parallelism().map_or(1, usize::from);
        let next_seed = AtomicU64::new(incarnation());
        Self { store, processors: Semaphore::new(processors), next_seed, closing }
    }

    async fn processor(&self) -> Result<SemaphorePermit<'_>, Status> {
        let busy = || status::resource_exhausted("all processors are busy", QUEUE_PATIENCE);
        match tokio::time::timeout(QUEUE_PATIENCE, self.processors.acquire()).await {
            Ok(Ok(permit)) => Ok(permit),
            _ => Err(busy()),
        }
    }

    /// The learned answer, or why there is none.
    async fn learned(&self, team: &Arc<Team>) -> Result<(TeamReply, WeightsKey), String> {
        let Some((key, scheduler)) = self.store.latest() else {
            return Err("no model is loaded".to_owned());
        };
        let asked = team.clone();
        let answer = tokio::task::spawn_blocking(move || assign::ask_learned(&asked, scheduler.as_ref()));
        match tokio::time::timeout(LEARNED_PATIENCE, answer).await {
            Ok(Ok(Ok(reply))) => Ok((reply, key)),
            Ok(Ok(Err(error))) => Err(error.to_string()),
            Ok(Err(_)) => Err("the model failed".to_owned()),
            Err(_) => Err(format!("the model took longer than {LEARNED_PATIENCE:?}")),
        }
    }

    async fn batch_with(&self, request: GoalRequest, key: &WeightsKey) -> Result<GoalReply, Status> {
        if request.scheduler != SchedulerKind::Learned {
            return blocking(move || classical::assign_batch(&request)).await;
        }
        let wait = self.store.wait(key, WEIGHTS_PATIENCE);
        let Some(model) = self.closing.run_until_cancelled(wait).await.flatten() else {
            let (version, run) = (key.version, &key.run_id);
            let problem = format!("weights version {version} of run '{run}' are not here yet");
            return Err(status::unavailable(problem, Duration::from_millis(500)));
        };
        match model.scheduler {
            Ok(scheduler) => blocking(move || scheduler.assign_batch(&request)).await,
            Err(reason) => Err(status::failed_precondition(format!("weights version {}: {reason}", key.version))),
        }
    }
}

/// Runs work of the processor away from the threads that serve the network.
async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, AssignError> + Send + 'static,
) -> Result<T, Status> {
    match tokio::task::spawn_blocking(work).await {
        Ok(result) => result.map_err(to_status),
        Err(error) => Err(Status::internal(error.to_string())),
    }
}

fn to_status(error: AssignError) -> Status {
    match error {
        AssignError::Invalid { field, problem } => status::invalid_argument(field, problem),
        AssignError::Unsupported(reason) => status::failed_precondition(reason),
        AssignError::Failed(reason) => Status::internal(reason),
    }
}

fn invalid(error: ConvertError) -> Status {
    status::invalid_argument(error.field, error.problem)
}

#[tonic::async_trait]
impl CommanderService for CommanderApi {
    async fn assign(&self, request: Request<v1::AssignRequest>) -> Result<Response<v1::AssignResponse>, Status> {
        let start = Instant::now();
        let seed = self.next_seed.fetch_add(1, Ordering::Relaxed);
        let team = Arc::new(assign::read(request.into_inner(), seed).map_err(invalid)?);
        let _processor = self.processor().await?;
        let (mut kind, mut fallback_reason) = (team.scheduler, String::new());
        let mut learned = None;
        if kind == SchedulerKind::Learned {
            match self.learned(&team).await {
                Ok(answer) => learned = Some(answer),
                Err(reason) => (kind, fallback_reason) = (SchedulerKind::Exact, reason),
            }
        }
        let (reply, key) = learned.map_or((None, None), |(reply, key)| (Some(reply), Some(key)));
        let mut response = blocking(move || {
            let reply = reply.map_or_else(|| assign::ask_classical(&team, kind), Ok)?;
            assign::write(&team, &reply)
        })
        .await?;
        response.scheduler = v1::SchedulerKind::from(kind).into();
        response.fallback_reason = fallback_reason;
        if let Some(key) = key {
            (response.version, response.sha256, response.run_id) = (key.version.0, key.sha256, key.run_id.0);
        }
        response.seconds = start.elapsed().as_secs_f64();
        Ok(Response::new(response))
    }

    async fn assign_batch(
        &self,
        request: Request<v1::AssignBatchRequest>,
    ) -> Result<Response<v1::AssignBatchResponse>, Status> {
        let (request, key) = GoalRequest::from_message(request.into_inner()).map_err(invalid)?;
        let version = request.shard.version;
        let reply = self.batch_with(request.clone(), &key).await?;
        Ok(Response::new(reply.to_message(&request, version)))
    }

    async fn get_model(&self, _: Request<v1::GetModelRequest>) -> Result<Response<v1::GetModelResponse>, Status> {
        let latest = self.store.latest();
        let mut kinds = vec![SchedulerKind::Exact, SchedulerKind::Greedy, SchedulerKind::Random];
        if latest.is_some() {
            kinds.insert(0, SchedulerKind::Learned);
        }
        let schedulers = kinds.into_iter().map(|kind| v1::SchedulerKind::from(kind).into()).collect();
        let ready = latest.is_some();
        let response = match latest {
            Some((key, _)) => v1::GetModelResponse {
                ready,
                run_id: key.run_id.0,
                version: key.version.0,
                sha256: key.sha256,
                schedulers,
            },
            None => v1::GetModelResponse { schedulers, ..Default::default() },
        };
        Ok(Response::new(response))
    }
}
