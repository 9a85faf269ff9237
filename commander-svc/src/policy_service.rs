//! Acts for teams of external clients with the policy of the loaded weights. Nothing is kept between two calls: what agents
//! remember travels with the call, or stays in the stream.

use crate::api::{CLIENT, budget};
use crate::assign_service::AssignService;
use crate::call_budget::CallBudget;
use crate::error::too_late;
use crate::model_store::ModelStore;
use crate::scheduler::{Scheduler, WeightsKey};
use crate::streams::{AHEAD, READ_TIMEOUT, problem};
use magex_core::ids::Mode;
use magex_policy::acting::{ActError, Choice, Decision, Teams};
use magex_policy::memory;
use magex_proto::v1;
use magex_proto::v1::policy_service_server::PolicyService;
use magex_runtime::backoff::random_id;
use magex_runtime::net::auth::caller;
use magex_runtime::net::heartbeat::Heartbeat;
use magex_runtime::net::in_flight::{InFlight, stopping};
use magex_runtime::status;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};

/// Agents of a step, all teams together, and pairs of them that are acted for on the thread of the call: about a millisecond
/// where the graph has an edge for every pair. Longer ones would delay the thread's other calls, checks of the health too.
const SMALL: usize = 256;
const SMALL_PAIRS: usize = 10_000;

/// Implements the service.
#[derive(Clone)]
pub(crate) struct PolicyApi {
    pub(crate) store: Arc<ModelStore>,
    pub(crate) answering: Arc<AssignService>,
    pub(crate) in_flight: Arc<InFlight>,
    /// Maximum number of agents of a step, all teams together.
    pub(crate) agents: usize,
    pub(crate) draining: CancellationToken,
    /// Time between heartbeats on streams.
    pub(crate) heartbeat: Option<Duration>,
}

#[tonic::async_trait]
impl PolicyService for PolicyApi {
    type ActStreamStream = ReceiverStream<Result<v1::ActStreamResponse, Status>>;

    async fn act(&self, request: Request<v1::ActRequest>) -> Result<Response<v1::ActResponse>, Status> {
        caller(&request, CLIENT)?;
        let budget = budget(&request);
        self.step(request.into_inner(), budget, "").await.map(Response::new)
    }

    async fn act_stream(
        &self,
        request: Request<Streaming<v1::ActStreamRequest>>,
    ) -> Result<Response<Self::ActStreamStream>, Status> {
        caller(&request, CLIENT)?;
        let (answers, stream) = mpsc::channel(AHEAD);
        let beat = Heartbeat::new(self.heartbeat);
        tokio::spawn(self.clone().stream(request.into_inner(), answers, beat));
        Ok(Response::new(ReceiverStream::new(stream)))
    }
}

impl PolicyApi {
    /// Answers one step; `path` is where it stands in the message.
    async fn step(&self, request: v1::ActRequest, budget: CallBudget, path: &str) -> Result<v1::ActResponse, Status> {
        let Some((key, model)) = self.store.latest() else {
            return Err(status::failed_precondition(
                "no policy is loaded; start the commander with --weights or --learner",
            ));
        };
        let mode = match request.mode() {
            v1::Mode::Sampled => Mode::Sampled,
            v1::Mode::Greedy | v1::Mode::Unspecified => Mode::Greedy,
        };
        let seed = request.seed.unwrap_or_else(|| if mode == Mode::Sampled { random_id() } else { 0 });
        let agents = request.positions.len() / (request.dims as usize).max(1);
        if agents > self.agents {
            let problem = format!("{agents} agents, all teams together, exceed the limit of {}", self.agents);
            return Err(status::invalid_argument(format!("{path}positions"), problem));
        }
        // The graph of a team has an edge for every pair.
        let pairs = agents * (agents / (request.teams as usize).max(1)).max(1);
        let work = Work { request, key, model, choice: Choice { mode, seed }, path: path.to_owned() };
        let response = if agents <= SMALL && pairs <= SMALL_PAIRS {
            work.run()?
        } else {
            let places = self.answering.places(pairs, budget.left()).await?;
            let working = tokio::task::spawn_blocking(move || {
                let _places = places;
                work.run()
            });
            working.await.map_err(|_| failed())??
        };
        if budget.over() {
            return Err(too_late());
        }
        self.answering.metrics.acted(agents, budget.elapsed());
        Ok(response)
    }

    /// Answers a stream of steps in order, until the client ends it or the service drains.
    async fn stream(
        self,
        mut steps: Streaming<v1::ActStreamRequest>,
        answers: mpsc::Sender<Result<v1::ActStreamResponse, Status>>,
        mut heartbeat: Heartbeat,
    ) {
        let mut memory = bytes::Bytes::new();
        loop {
            let next = tokio::select! {
                next = steps.message() => next,
                () = heartbeat.due() => {
                    // A queue with messages in it needs no heartbeat.
                    let _ = answers.try_send(Ok(v1::ActStreamResponse::default()));
                    continue;
                }
                () = self.draining.cancelled() => Err(stopping()),
                () = answers.closed() => return,
            };
            let answer = match next {
                Ok(Some(request)) => {
                    let sequence = request.sequence;
                    let result = match self.in_flight.check_open() {
                        Ok(()) => self.next(request, &mut memory).await,
                        Err(status) => Err(status),
                    };
                    let result = match result {
                        Ok(answer) => v1::act_stream_response::Result::Answer(answer),
                        Err(status) => v1::act_stream_response::Result::Problem(problem(&status)),
                    };
                    Ok(v1::ActStreamResponse { sequence, result: Some(result) })
                }
                Ok(None) => break,
                Err(status) => Err(status),
            };
            let end = answer.is_err();
            if answers.send_timeout(answer, READ_TIMEOUT).await.is_err() || end {
                break;
            }
        }
    }

    async fn next(&self, request: v1::ActStreamRequest, memory: &mut bytes::Bytes) -> Result<v1::ActResponse, Status> {
        let mut step = request.step.ok_or_else(|| status::invalid_argument("step", "missing"))?;
        if step.memory.is_empty() && !request.begin {
            step.memory = memory.clone();
        }
        let mut answer = self.step(step, CallBudget::start(None), "step.").await?;
        *memory = std::mem::take(&mut answer.memory);
        Ok(answer)
    }
}

/// A step that was admitted.
struct Work {
    request: v1::ActRequest,
    key: Arc<WeightsKey>,
    model: Arc<dyn Scheduler>,
    choice: Choice,
    path: String,
}

impl Work {
    fn run(self) -> Result<v1::ActResponse, Status> {
        // A panic of the model must not end the service.
        catch_unwind(AssertUnwindSafe(|| self.act())).unwrap_or_else(|_| Err(failed()))
    }

    fn act(self) -> Result<v1::ActResponse, Status> {
        let Self { request, key, model, choice, path } = self;
        let policies =
            model.policies().map_err(|reason| status::failed_precondition(format!("no policy: {reason}")))?;
        let refused = |error| to_status(error, &path);
        let teams = Teams {
            teams: (request.teams as usize).max(1),
            dims: request.dims as usize,
            side: request.side,
            positions: request.positions,
            velocities: request.velocities,
            goals: request.goals,
            balls: request.balls,
            ball_velocities: request.ball_velocities,
            agent_state: request.agent_state,
        };
        let n = policies.check(&teams).map_err(refused)?;
        let memory = memory::unpack(&request.memory, &key.sha256, teams.teams, n).map_err(refused)?;
        let decision = policies.act(&teams, memory, choice).map_err(refused)?;
        let Decision { actions, logits, probabilities, memory } = decision;
        Ok(v1::ActResponse {
            actions: actions.into_iter().map(u32::from).collect(),
            probabilities,
            logits,
            memory: memory::pack(&memory, &key.sha256, teams.teams, n).into(),
            version: key.version.0,
            sha256: key.sha256.clone(),
            run_id: key.run_id.0.clone(),
            choices: policies.config().task.action_heads().into_iter().map(|size| size as u32).collect(),
        })
    }
}

fn to_status(error: ActError, path: &str) -> Status {
    match error {
        ActError::Invalid { field, problem } => status::invalid_argument(format!("{path}{field}"), problem),
        other => Status::internal(other.to_string()),
    }
}

fn failed() -> Status {
    Status::internal("the policy failed with an internal error")
}
