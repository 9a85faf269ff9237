//! The contract on top of the parts: who may, what is asked, who answers.

use crate::assign_service::{Answering, Clock};
use crate::shard_assign::{self, Batches};
use crate::mission_service::{self, Keeper};
use crate::metadata;
use crate::scheduler::{GoalRequest, SchedulerKind};
use crate::model_store::Store;
use crate::streams::{self, Interest};
use magex_dispatch::{Limits, Problem};
use magex_proto::convert::ConvertError;
use magex_proto::v1;
use magex_proto::v1::commander_service_server::CommanderService;
use magex_runtime::net::auth::{Role, caller};
use magex_runtime::net::in_flight::Admission;
use magex_runtime::{status, trace};
use std::sync::Arc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};
use tracing::Instrument as _;

/// Missions that a watcher may name.
const WATCHED: usize = 1000;

/// Who asks for assignments.
const CLIENT: &[Role] = &[Role::Client];

/// Methods that stay open.
pub(crate) const STREAMS: &[&str] = &["AssignStream", "WatchAssignments"];

/// Implements the contract.
#[derive(Debug)]
pub(crate) struct CommanderApi {
    pub(crate) store: Arc<Store>,
    pub(crate) answering: Arc<Answering>,
    pub(crate) batches: Batches,
    pub(crate) keeper: Arc<Keeper>,
    pub(crate) admission: Arc<Admission>,
    pub(crate) limits: Limits,
    pub(crate) draining: CancellationToken,
}

type Answer<T> = Result<Response<T>, Status>;

fn invalid(error: ConvertError) -> Status {
    status::invalid_argument(error.field, error.problem)
}

#[tonic::async_trait]
impl CommanderService for CommanderApi {
    type AssignStreamStream = ReceiverStream<Result<v1::AssignStreamResponse, Status>>;
    type WatchAssignmentsStream = ReceiverStream<Result<v1::WatchAssignmentsResponse, Status>>;

    async fn assign(&self, request: Request<v1::AssignRequest>) -> Answer<v1::AssignResponse> {
        caller(&request, CLIENT)?;
        let clock = Clock::start(metadata::deadline(request.metadata()));
        let problem = Problem::read(request.into_inner(), self.answering.seed(), &self.limits).map_err(invalid)?;
        self.answering.respond(problem, clock).await.map(Response::new)
    }

    async fn assign_many(&self, request: Request<v1::AssignManyRequest>) -> Answer<v1::AssignManyResponse> {
        caller(&request, CLIENT)?;
        let clock = Clock::start(metadata::deadline(request.metadata()));
        let teams = request.into_inner().teams;
        if teams.is_empty() || teams.len() > self.limits.teams {
            let problem = format!("{} teams; from 1 to {} are answered", teams.len(), self.limits.teams);
            return Err(status::invalid_argument("teams", problem));
        }
        let mut problems = Vec::with_capacity(teams.len());
        for (k, team) in teams.into_iter().enumerate() {
            let problem = Problem::read(team, self.answering.seed(), &self.limits);
            problems.push(problem.map_err(|error| invalid(error.within(&format!("teams[{k}]"))))?);
        }
        let mut answers = Vec::with_capacity(problems.len());
        for problem in problems {
            answers.push(self.answering.respond(problem, clock).await?);
            // Many small teams on this thread: others get their turn in between.
            tokio::task::yield_now().await;
        }
        Ok(Response::new(v1::AssignManyResponse { answers }))
    }

    async fn assign_stream(
        &self,
        request: Request<Streaming<v1::AssignStreamRequest>>,
    ) -> Answer<Self::AssignStreamStream> {
        caller(&request, CLIENT)?;
        let (answers, stream) = streams::channel();
        let (answering, admission, draining) = (self.answering.clone(), self.admission.clone(), self.draining.clone());
        let teams = request.into_inner();
        tokio::spawn(streams::assign(answering, admission, self.limits, teams, answers, draining));
        Ok(Response::new(ReceiverStream::new(stream)))
    }

    async fn assign_batch(&self, request: Request<v1::AssignBatchRequest>) -> Answer<v1::AssignBatchResponse> {
        caller(&request, &[Role::Actor])?;
        let span = tracing::info_span!(target: trace::TARGET, parent: None, "assign batch");
        trace::continue_from(&span, trace::of(request.metadata()));
        let clock = Clock::start(metadata::deadline(request.metadata()));
        let (request, key) = GoalRequest::from_message(request.into_inner()).map_err(invalid)?;
        shard_assign::check(&request, &key, &self.limits)?;
        let version = request.shard.version;
        let request = Arc::new(request);
        let answer = self.batches.answer(request.clone(), &key, clock, &self.draining);
        let reply = Arc::new(answer.instrument(span).await?);
        self.answering.gauges.answered(request.scheduler, false, clock.elapsed());
        let message = reply.to_message(&request, version);
        self.keeper.record(request, reply, key);
        Ok(Response::new(message))
    }

    async fn create_mission(&self, request: Request<v1::CreateMissionRequest>) -> Answer<v1::CreateMissionResponse> {
        let caller = caller(&request, CLIENT)?;
        let clock = Clock::start(metadata::deadline(request.metadata()));
        let assignment = Some(self.keeper.create(caller, request.into_inner(), clock).await?);
        Ok(Response::new(v1::CreateMissionResponse { assignment }))
    }

    async fn update_mission(&self, request: Request<v1::UpdateMissionRequest>) -> Answer<v1::UpdateMissionResponse> {
        let caller = caller(&request, CLIENT)?;
        let clock = Clock::start(metadata::deadline(request.metadata()));
        let assignment = Some(self.keeper.update(caller, request.into_inner(), clock).await?);
        Ok(Response::new(v1::UpdateMissionResponse { assignment }))
    }

    async fn get_assignment(&self, request: Request<v1::GetAssignmentRequest>) -> Answer<v1::GetAssignmentResponse> {
        let caller = caller(&request, CLIENT)?;
        let assignment = Some(self.keeper.get(&caller, &request.into_inner().mission_id)?);
        Ok(Response::new(v1::GetAssignmentResponse { assignment }))
    }

    async fn list_assignments(
        &self,
        request: Request<v1::ListAssignmentsRequest>,
    ) -> Answer<v1::ListAssignmentsResponse> {
        let caller = caller(&request, CLIENT)?;
        self.keeper.list(&caller, &request.into_inner()).map(Response::new)
    }

    async fn watch_assignments(
        &self,
        request: Request<v1::WatchAssignmentsRequest>,
    ) -> Answer<Self::WatchAssignmentsStream> {
        let caller = caller(&request, CLIENT)?;
        let request = request.into_inner();
        if request.mission_ids.len() > WATCHED {
            let problem =
                format!("{} names are more than {WATCHED}; leave them out to watch all", request.mission_ids.len());
            return Err(status::invalid_argument("mission_ids", problem));
        }
        let source = mission_service::source("source", request.source)?;
        let interest = Interest { caller, ids: request.mission_ids.into_iter().collect(), source };
        let (watcher, stream) = streams::channel();
        tokio::spawn(streams::watch(self.keeper.clone(), interest, watcher, self.draining.clone()));
        Ok(Response::new(ReceiverStream::new(stream)))
    }

    async fn delete_mission(&self, request: Request<v1::DeleteMissionRequest>) -> Answer<v1::DeleteMissionResponse> {
        let caller = caller(&request, CLIENT)?;
        self.keeper.delete(caller, request.into_inner().mission_id).await?;
        Ok(Response::new(v1::DeleteMissionResponse {}))
    }

    async fn get_model(&self, request: Request<v1::GetModelRequest>) -> Answer<v1::GetModelResponse> {
        caller(&request, &[Role::Client, Role::Actor])?;
        let latest = self.store.latest();
        let mut kinds =
            vec![SchedulerKind::Exact, SchedulerKind::Makespan, SchedulerKind::Greedy, SchedulerKind::Random];
        // The model of a run with a classical scheduler answers that run's actors, and nobody else.
        let ready = latest.as_ref().is_some_and(|(_, scheduler)| scheduler.teams());
        if ready {
            kinds.insert(0, SchedulerKind::Learned);
        }
        let schedulers = kinds.into_iter().map(|kind| v1::SchedulerKind::from(kind).into()).collect();
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
