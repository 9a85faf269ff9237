//! The contract on top of the parts: who may, what is asked, who answers.

use crate::access::{Caller, Role, caller};
use crate::admission::{Admission, Kind, Slot};
use crate::answering::{Answering, Clock};
use crate::classical;
use crate::keeper::{self, Keeper};
use crate::metadata;
use crate::scheduler::{AssignError, GoalReply, GoalRequest, SchedulerKind, WeightsKey};
use crate::store::Store;
use crate::streams::{self, Interest};
use magex_dispatch::{Limits, Problem};
use magex_proto::convert::ConvertError;
use magex_proto::v1;
use magex_proto::v1::commander_service_server::CommanderService;
use magex_runtime::status;
use std::sync::Arc;
use std::time::Duration;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};

/// How long an actor's request waits for the weights that it names.
const WEIGHTS_PATIENCE: Duration = Duration::from_secs(5);

/// Missions that a watcher may name.
const WATCHED: usize = 1000;

/// Implements the contract.
#[derive(Debug)]
pub(crate) struct CommanderApi {
    pub(crate) store: Arc<Store>,
    pub(crate) answering: Arc<Answering>,
    pub(crate) keeper: Arc<Keeper>,
    pub(crate) admission: Arc<Admission>,
    pub(crate) limits: Limits,
    pub(crate) draining: CancellationToken,
}

type Answer<T> = Result<Response<T>, Status>;

impl CommanderApi {
    /// Lets a client's call in.
    fn client<T>(&self, request: &Request<T>, kind: Kind) -> Result<(Caller, Slot), Status> {
        let caller = caller(request, &[Role::Client])?;
        let slot = self.admission.enter(&caller, kind)?;
        Ok((caller, slot))
    }

    async fn batch_with(&self, request: Arc<GoalRequest>, key: &WeightsKey) -> Result<GoalReply, Status> {
        if request.scheduler != SchedulerKind::Learned {
            return blocking(move || classical::assign_batch(&request)).await;
        }
        let wait = self.store.wait(key, WEIGHTS_PATIENCE);
        let Some(model) = self.draining.run_until_cancelled(wait).await.flatten() else {
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
    type AssignStreamStream = ReceiverStream<Result<v1::AssignStreamResponse, Status>>;
    type WatchAssignmentsStream = ReceiverStream<Result<v1::WatchAssignmentsResponse, Status>>;

    async fn assign(&self, request: Request<v1::AssignRequest>) -> Answer<v1::AssignResponse> {
        let (_, _slot) = self.client(&request, Kind::Call)?;
        let clock = Clock::start(metadata::deadline(request.metadata()));
        let problem = Problem::read(request.into_inner(), self.answering.seed(), &self.limits).map_err(invalid)?;
        self.answering.respond(problem, clock).await.map(Response::new)
    }

    async fn assign_many(&self, request: Request<v1::AssignManyRequest>) -> Answer<v1::AssignManyResponse> {
        let (_, _slot) = self.client(&request, Kind::Call)?;
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
        let (_, slot) = self.client(&request, Kind::Stream)?;
        let (answers, stream) = streams::channel();
        let (answering, admission, draining) = (self.answering.clone(), self.admission.clone(), self.draining.clone());
        let teams = request.into_inner();
        tokio::spawn(streams::assign(answering, admission, self.limits, teams, answers, draining, slot));
        Ok(Response::new(ReceiverStream::new(stream)))
    }

    async fn assign_batch(&self, request: Request<v1::AssignBatchRequest>) -> Answer<v1::AssignBatchResponse> {
        let caller = caller(&request, &[Role::Actor])?;
        let _slot = self.admission.enter(&caller, Kind::Call)?;
        let (request, key) = GoalRequest::from_message(request.into_inner()).map_err(invalid)?;
        let version = request.shard.version;
        let request = Arc::new(request);
        let reply = Arc::new(self.batch_with(request.clone(), &key).await?);
        let message = reply.to_message(&request, version);
        self.keeper.record(request, reply, key);
        Ok(Response::new(message))
    }

    async fn create_mission(&self, request: Request<v1::CreateMissionRequest>) -> Answer<v1::CreateMissionResponse> {
        let (caller, _slot) = self.client(&request, Kind::Call)?;
        let assignment = Some(self.keeper.create(caller, request.into_inner()).await?);
        Ok(Response::new(v1::CreateMissionResponse { assignment }))
    }

    async fn update_mission(&self, request: Request<v1::UpdateMissionRequest>) -> Answer<v1::UpdateMissionResponse> {
        let (caller, _slot) = self.client(&request, Kind::Call)?;
        let assignment = Some(self.keeper.update(caller, request.into_inner()).await?);
        Ok(Response::new(v1::UpdateMissionResponse { assignment }))
    }

    async fn get_assignment(&self, request: Request<v1::GetAssignmentRequest>) -> Answer<v1::GetAssignmentResponse> {
        let (caller, _slot) = self.client(&request, Kind::Call)?;
        let assignment = Some(self.keeper.get(&caller, &request.into_inner().mission_id)?);
        Ok(Response::new(v1::GetAssignmentResponse { assignment }))
    }

    async fn list_assignments(
        &self,
        request: Request<v1::ListAssignmentsRequest>,
    ) -> Answer<v1::ListAssignmentsResponse> {
        let (caller, _slot) = self.client(&request, Kind::Call)?;
        self.keeper.list(&caller, &request.into_inner()).map(Response::new)
    }

    async fn watch_assignments(
        &self,
        request: Request<v1::WatchAssignmentsRequest>,
    ) -> Answer<Self::WatchAssignmentsStream> {
        let (caller, slot) = self.client(&request, Kind::Stream)?;
        let request = request.into_inner();
        if request.mission_ids.len() > WATCHED {
            let problem =
                format!("{} names are more than {WATCHED}; leave them out to watch all", request.mission_ids.len());
            return Err(status::invalid_argument("mission_ids", problem));
        }
        let source = keeper::source("source", request.source)?;
        let interest = Interest { caller, ids: request.mission_ids.into_iter().collect(), source };
        let (watcher, stream) = streams::channel();
        tokio::spawn(streams::watch(self.keeper.clone(), interest, watcher, self.draining.clone(), slot));
        Ok(Response::new(ReceiverStream::new(stream)))
    }

    async fn delete_mission(&self, request: Request<v1::DeleteMissionRequest>) -> Answer<v1::DeleteMissionResponse> {
        let (caller, _slot) = self.client(&request, Kind::Call)?;
        self.keeper.delete(caller, request.into_inner().mission_id).await?;
        Ok(Response::new(v1::DeleteMissionResponse {}))
    }

    async fn get_model(&self, request: Request<v1::GetModelRequest>) -> Answer<v1::GetModelResponse> {
        caller(&request, &[Role::Client, Role::Actor])?;
        let latest = self.store.latest();
        let mut kinds =
            vec![SchedulerKind::Exact, SchedulerKind::Makespan, SchedulerKind::Greedy, SchedulerKind::Random];
        if latest.is_some() {
            kinds.insert(0, SchedulerKind::Learned);
        }
        let schedulers = kinds.into_iter().map(|kind| v1::SchedulerKind::from(kind).into()).collect();
        let response = match latest {
            Some((key, _)) => v1::GetModelResponse {
                ready: true,
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
