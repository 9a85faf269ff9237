//! The gRPC contract: checks the caller's role, reads the request, and passes it to the service that answers it.

use crate::assign_service::AssignService;
use crate::call_budget::CallBudget;
use crate::error::to_status;
use crate::mission_service::{self, MissionService};
use crate::model_store::ModelStore;
use crate::scheduler::{AssignmentMethod, GoalRequest};
use crate::shard_assign::{self, ShardAssign};
use crate::streams::{self, Interest};
use crate::training_view::TrainingShard;
use magex_dispatch::{Limits, Problem};
use magex_proto::v1;
use magex_proto::v1::commander_service_server::CommanderService;
use magex_runtime::net::auth::{Role, caller};
use magex_runtime::net::heartbeat::Heartbeat;
use magex_runtime::net::in_flight::{CallKind, InFlight};
use magex_runtime::{status, trace};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};
use tracing::Instrument as _;

/// Maximum number of missions that a watcher may name.
const WATCHED: usize = 1000;

/// The roles of external clients.
pub(crate) const CLIENT: &[Role] = &[Role::Client];

/// Streaming methods.
pub(crate) const STREAMS: &[&str] = &["AssignStream", "WatchAssignments", "ActStream"];

/// Implements the service.
pub(crate) struct CommanderApi {
    pub(crate) store: Arc<ModelStore>,
    pub(crate) answering: Arc<AssignService>,
    pub(crate) shards: ShardAssign,
    pub(crate) missions: Arc<MissionService>,
    pub(crate) in_flight: Arc<InFlight>,
    pub(crate) limits: Limits,
    pub(crate) draining: CancellationToken,
    /// Time between heartbeats on streams.
    pub(crate) heartbeat: Option<Duration>,
}

impl CommanderApi {
    /// Sets the gauges that are computed on demand.
    pub(crate) fn refresh_gauges(&self) {
        let metrics = &self.answering.metrics;
        metrics.in_flight.set(self.in_flight.count(CallKind::Call) as f64);
        metrics.streams.set(self.in_flight.count(CallKind::Stream) as f64);
        metrics.missions.set(self.missions.missions.count() as f64);
        metrics.backlog.set(self.missions.events.len() as f64);
        metrics.weights_version.set(self.store.latest().map_or(-1.0, |(key, _)| f64::from(key.version.0)));
        metrics.free_processors.set(self.answering.processors.available_permits() as f64);
    }
}

type Answer<T> = Result<Response<T>, Status>;

pub(crate) fn budget<T>(request: &Request<T>) -> CallBudget {
    CallBudget::start(request.extensions().get())
}

#[tonic::async_trait]
impl CommanderService for CommanderApi {
    type AssignStreamStream = ReceiverStream<Result<v1::AssignStreamResponse, Status>>;
    type WatchAssignmentsStream = ReceiverStream<Result<v1::WatchAssignmentsResponse, Status>>;

    async fn assign(&self, request: Request<v1::AssignRequest>) -> Answer<v1::AssignResponse> {
        caller(&request, CLIENT)?;
        let budget = budget(&request);
        let problem = self.answering.read(request.into_inner(), &self.limits).map_err(to_status)?;
        self.answering.respond(problem, budget).await.map(Response::new)
    }

    async fn assign_many(&self, request: Request<v1::AssignManyRequest>) -> Answer<v1::AssignManyResponse> {
        caller(&request, CLIENT)?;
        let budget = budget(&request);
        let teams = request.into_inner().teams;
        if teams.len() > self.limits.teams {
            let problem = format!("{} teams exceed the limit of {}", teams.len(), self.limits.teams);
            return Err(status::invalid_argument("teams", problem));
        }
        let read = |(k, team)| {
            let problem = self.answering.read(team, &self.limits);
            problem.map_err(|error| to_status(error.within(&format!("teams[{k}]"))))
        };
        let problems: Vec<Problem> = teams.into_iter().enumerate().map(read).collect::<Result<_, _>>()?;
        let mut answers = Vec::with_capacity(problems.len());
        for problem in problems {
            answers.push(self.answering.respond(problem, budget).await?);
            // Many small teams on this thread: let other calls run in between.
            tokio::task::yield_now().await;
        }
        Ok(Response::new(v1::AssignManyResponse { answers }))
    }

    async fn assign_stream(
        &self,
        request: Request<Streaming<v1::AssignStreamRequest>>,
    ) -> Answer<Self::AssignStreamStream> {
        caller(&request, CLIENT)?;
        let (answers, stream) = mpsc::channel(streams::AHEAD);
        let (answering, in_flight, draining) = (self.answering.clone(), self.in_flight.clone(), self.draining.clone());
        let (teams, beat) = (request.into_inner(), Heartbeat::new(self.heartbeat));
        tokio::spawn(streams::assign(answering, in_flight, self.limits, teams, answers, draining, beat));
        Ok(Response::new(ReceiverStream::new(stream)))
    }

    async fn assign_batch(&self, request: Request<v1::AssignBatchRequest>) -> Answer<v1::AssignBatchResponse> {
        caller(&request, &[Role::Actor])?;
        let span = tracing::info_span!(target: trace::TARGET, parent: None, "assign batch");
        trace::continue_from(&span, trace::of(request.metadata()));
        let budget = budget(&request);
        let (request, key) = GoalRequest::from_message(request.into_inner()).map_err(to_status)?;
        shard_assign::check(&request, &key, &self.limits).map_err(to_status)?;
        let version = request.shard.version;
        let request = Arc::new(request);
        let answer = self.shards.answer(request.clone(), &key, budget, &self.draining);
        let (reply, method) = answer.instrument(span).await?;
        self.answering.metrics.answered(method, false, budget.elapsed());
        let message = reply.to_message(&request, version);
        self.missions.record(TrainingShard { request, reply, key, method, at: self.missions.now() });
        Ok(Response::new(message))
    }

    async fn create_mission(&self, request: Request<v1::CreateMissionRequest>) -> Answer<v1::CreateMissionResponse> {
        let caller = caller(&request, CLIENT)?;
        let budget = budget(&request);
        let assignment = Some(self.missions.create(caller, request.into_inner(), budget).await?);
        Ok(Response::new(v1::CreateMissionResponse { assignment }))
    }

    async fn update_mission(&self, request: Request<v1::UpdateMissionRequest>) -> Answer<v1::UpdateMissionResponse> {
        let caller = caller(&request, CLIENT)?;
        let budget = budget(&request);
        let assignment = Some(self.missions.update(caller, request.into_inner(), budget).await?);
        Ok(Response::new(v1::UpdateMissionResponse { assignment }))
    }

    async fn get_assignment(&self, request: Request<v1::GetAssignmentRequest>) -> Answer<v1::GetAssignmentResponse> {
        let caller = caller(&request, CLIENT)?;
        let assignment = Some(self.missions.get(&caller, &request.into_inner().mission_id)?);
        Ok(Response::new(v1::GetAssignmentResponse { assignment }))
    }

    async fn list_assignments(
        &self,
        request: Request<v1::ListAssignmentsRequest>,
    ) -> Answer<v1::ListAssignmentsResponse> {
        let caller = caller(&request, CLIENT)?;
        self.missions.list(&caller, &request.into_inner()).map(Response::new)
    }

    async fn watch_assignments(
        &self,
        request: Request<v1::WatchAssignmentsRequest>,
    ) -> Answer<Self::WatchAssignmentsStream> {
        let caller = caller(&request, CLIENT)?;
        let request = request.into_inner();
        let names = request.mission_ids.len();
        if names > WATCHED {
            let problem = format!("{names} names exceed the limit of {WATCHED}; leave the list empty to watch all");
            return Err(status::invalid_argument("mission_ids", problem));
        }
        let source = mission_service::source(request.source)?;
        let interest = Interest { caller, ids: request.mission_ids.into_iter().collect(), source };
        let (watcher, stream) = mpsc::channel(streams::AHEAD);
        let beat = Heartbeat::new(self.heartbeat);
        tokio::spawn(streams::watch(self.missions.clone(), interest, watcher, self.draining.clone(), beat));
        Ok(Response::new(ReceiverStream::new(stream)))
    }

    async fn delete_mission(&self, request: Request<v1::DeleteMissionRequest>) -> Answer<v1::DeleteMissionResponse> {
        let caller = caller(&request, CLIENT)?;
        self.missions.delete(caller, request.into_inner().mission_id).await?;
        Ok(Response::new(v1::DeleteMissionResponse {}))
    }

    async fn get_model(&self, request: Request<v1::GetModelRequest>) -> Answer<v1::GetModelResponse> {
        caller(&request, &[Role::Client, Role::Actor])?;
        let latest = self.store.latest();
        // Weights of a run without a learned scheduler answer only that run's actors.
        let ready = latest.as_ref().is_some_and(|(_, scheduler)| scheduler.method() == AssignmentMethod::Learned);
        let methods = AssignmentMethod::ALL.into_iter().filter(|&method| ready || method != AssignmentMethod::Learned);
        let schedulers = methods.map(|method| v1::AssignmentMethod::from(method).into()).collect();
        let response = match latest {
            Some((key, _)) => v1::GetModelResponse {
                ready,
                run_id: key.run_id.0.clone(),
                version: key.version.0,
                sha256: key.sha256.clone(),
                schedulers,
            },
            None => v1::GetModelResponse { schedulers, ..Default::default() },
        };
        Ok(Response::new(response))
    }
}
