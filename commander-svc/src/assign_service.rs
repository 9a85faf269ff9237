//! Answers one team: chooses the thread, enforces the deadline, and falls back to the exact method.
//!
//! Small teams are answered on the thread of the call: handing them to another thread costs more than the answer. Large teams
//! are answered on worker threads, limited by processors and by memory.

use crate::call_budget::CallBudget;
use crate::cancel::on_thread;
use crate::error::{to_status, too_late};
use crate::metrics::CommanderMetrics;
use crate::model_store::ModelStore;
use crate::scheduler::{AssignmentMethod, Scheduler, TeamReply};
use magex_assign::GoOn;
use magex_dispatch::answer::Planned;
use magex_dispatch::{AssignError, Limits, Problem, engine};
use magex_proto::apart::apart;
use magex_proto::convert::ConvertError;
use magex_proto::v1;
use magex_runtime::backoff::random_id;
use magex_runtime::status;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tonic::Status;

/// How long a request waits for a processor before it is rejected.
const QUEUE_TIMEOUT: Duration = Duration::from_secs(1);

/// How long a call waits after its deadline for a worker that is about to stop.
const LATE: Duration = Duration::from_millis(5);

/// Largest team, in pairs, that exact, makespan, greedy and random answer on the thread of the call: well under a millisecond.
const SMALL: usize = 10_000;

/// The same for the learned method.
const SMALL_LEARNED: usize = 4096;

/// The model runs on the thread of the call only if its time limit is this many times its recent duration.
const MARGIN: u32 = 4;

/// Pairs per unit of memory, and number of units: one team of 5,000 × 5,000 at a time.
const UNIT: usize = 1_000_000;
const UNITS: usize = 26;

/// Answers teams.
pub(crate) struct AssignService {
    store: Arc<ModelStore>,
    pub(crate) metrics: Arc<CommanderMetrics>,
    /// One permit per processor that may answer a large team.
    pub(crate) processors: Arc<Semaphore>,
    memory: Arc<Semaphore>,
    /// Recent duration of the model on a small team, nanoseconds: a maximum that decays. It only chooses the thread.
    model_nanos: AtomicU64,
    /// Seeds of requests without one.
    next_seed: AtomicU64,
}

/// A processor, and memory.
pub(crate) type Places = (OwnedSemaphorePermit, OwnedSemaphorePermit);

impl AssignService {
    pub(crate) fn new(store: Arc<ModelStore>, metrics: Arc<CommanderMetrics>) -> Arc<Self> {
        let processors = Arc::new(Semaphore::new(magex_runtime::process::processors()));
        let (memory, next_seed) = (Arc::new(Semaphore::new(UNITS)), AtomicU64::new(random_id()));
        let model_nanos = AtomicU64::new(u64::MAX);
        Arc::new(Self { store, metrics, processors, memory, model_nanos, next_seed })
    }

    /// Checks a team on the wire. A long one is read while other calls of this thread run on another.
    pub(crate) fn read(&self, team: v1::AssignRequest, limits: &Limits) -> Result<Problem, ConvertError> {
        // The seed of a request without one.
        let seed = self.next_seed.fetch_add(1, Ordering::Relaxed);
        apart(bytes(&team), || Problem::read(team, seed, limits))
    }

    /// Answers a team on the wire.
    pub(crate) async fn respond(
        self: &Arc<Self>,
        problem: Problem,
        budget: CallBudget,
    ) -> Result<v1::AssignResponse, Status> {
        let budget = budget.limited(problem.deadline);
        let problem = Arc::new(problem);
        let planned = self.plan(&problem, budget).await?;
        let mut response = planned.respond(&problem);
        let elapsed = budget.elapsed();
        response.seconds = elapsed.as_secs_f64();
        self.metrics.answered(response.scheduler().into(), !response.fallback_reason.is_empty(), elapsed);
        Ok(response)
    }

    /// Answers a small team on the thread of the call, a large one on worker threads. The exact method answers here while no
    /// processor is free for the model.
    async fn plan(self: &Arc<Self>, problem: &Arc<Problem>, budget: CallBudget) -> Result<Planned, Status> {
        let (small, learned) = (problem.cells() <= SMALL, problem.scheduler == AssignmentMethod::Learned);
        let (here, cells) = match learned {
            true => (self.small_for_model(problem, &budget), engine::learned_cells(problem)),
            false => (small, problem.memory()),
        };
        let go_on = || !budget.over();
        let planned = if here {
            self.plan_here(problem, budget.learned(), &go_on)
        } else {
            match self.places(cells, budget.left()).await {
                Ok(places) => return self.plan_on_thread(problem, budget, places).await,
                Err(_) if learned && small => {
                    solve(problem, "all processors are busy, so the model was not called".to_owned(), &go_on)
                }
                Err(busy) => return Err(busy),
            }
        };
        let planned = planned.map_err(to_status)?;
        if budget.over() { Err(too_late()) } else { Ok(planned) }
    }

    /// Answers on worker threads. The learned method is cancelled at its time limit.
    async fn plan_on_thread(
        self: &Arc<Self>,
        problem: &Arc<Problem>,
        budget: CallBudget,
        places: Places,
    ) -> Result<Planned, Status> {
        let (places, mut reason) = (Arc::new(places), String::new());
        if problem.scheduler == AssignmentMethod::Learned {
            let (own, problem, limit) = (self.clone(), problem.clone(), budget.learned());
            let asking = on_thread(places.clone(), budget, move |work| own.ask_learned(&problem, &|| work.go_on()));
            match tokio::time::timeout(limit, asking).await {
                Ok(Ok(Ok(planned))) => return Ok(planned),
                Ok(Ok(Err(why))) => reason = why,
                Ok(Err(_)) => MODEL_FAILED.clone_into(&mut reason),
                Err(_) => reason = exceeded(limit),
            }
        }
        let problem = problem.clone();
        let solving = on_thread(places, budget, move |work| solve(&problem, reason, &|| work.go_on()));
        let solved = tokio::time::timeout_at((budget.until + LATE).into(), solving).await;
        solved.map_err(|_| too_late())??.map_err(to_status)
    }

    /// The model answers teams of this size in a fraction of its time limit.
    fn small_for_model(&self, problem: &Problem, budget: &CallBudget) -> bool {
        if engine::not_for_learned(problem).is_some() || self.store.latest().is_none() {
            return problem.cells() <= SMALL;
        }
        let recent = Duration::from_nanos(self.model_nanos.load(Ordering::Relaxed));
        engine::learned_cells(problem) <= SMALL_LEARNED && recent.saturating_mul(MARGIN) <= budget.learned()
    }

    /// A processor, and memory for `cells` pairs.
    pub(crate) async fn places(&self, cells: usize, timeout: Duration) -> Result<Places, Status> {
        let both = async {
            let memory = self.memory(cells).await?;
            Some((self.processors.clone().acquire_owned().await.ok()?, memory))
        };
        match tokio::time::timeout(QUEUE_TIMEOUT.min(timeout), both).await {
            Ok(Some(places)) => Ok(places),
            _ => Err(status::resource_exhausted("all processors are busy; retry later", QUEUE_TIMEOUT)),
        }
    }

    /// Waits for memory for `cells` pairs; `None` once the service has ended.
    pub(crate) async fn memory(&self, cells: usize) -> Option<OwnedSemaphorePermit> {
        let units = cells.div_ceil(UNIT).clamp(1, UNITS) as u32;
        self.memory.clone().acquire_many_owned(units).await.ok()
    }

    /// Answers on this thread. The answer of a learned scheduler that exceeded `limit` is dropped.
    pub(crate) fn plan_here(&self, problem: &Problem, time: Duration, go_on: GoOn<'_>) -> Result<Planned, AssignError> {
        let mut reason = String::new();
        if problem.scheduler == AssignmentMethod::Learned {
            let start = Instant::now();
            match self.ask_learned(problem, go_on) {
                Ok(planned) if start.elapsed() <= time => return Ok(planned),
                Ok(_) => reason = exceeded(time),
                Err(why) => reason = why,
            }
        }
        solve(problem, reason, go_on)
    }

    /// The learned answer, or the reason for a fallback.
    fn ask_learned(&self, problem: &Problem, go_on: GoOn<'_>) -> Result<Planned, String> {
        if let Some(reason) = engine::not_for_learned(problem) {
            return Err(reason.to_owned());
        }
        let Some((key, scheduler)) = self.store.latest() else {
            return Err("no model is loaded".to_owned());
        };
        // The call may have ended before a thread was free.
        if !go_on() {
            return Err("the deadline passed before the model was called".to_owned());
        }
        let start = Instant::now();
        let reply = ask(problem, scheduler.as_ref());
        if engine::learned_cells(problem) <= SMALL_LEARNED {
            let nanos = u64::try_from(start.elapsed().as_nanos()).unwrap_or(u64::MAX);
            let before = self.model_nanos.load(Ordering::Relaxed);
            let before = if before == u64::MAX { 0 } else { before - before / 8 };
            self.model_nanos.store(nanos.max(before), Ordering::Relaxed);
        }
        let reply = reply?;
        // The rest is work only for a call that still waits.
        if !go_on() {
            return Err("the model answered after the deadline".to_owned());
        }
        let plan = engine::adopt(problem, reply.goals, reply.probabilities, go_on)?;
        let weights = (key.version.0, key.sha256.clone(), key.run_id.0.clone());
        Ok(Planned { plan, fallback_reason: String::new(), weights: Some(weights) })
    }
}

/// Roughly how long a team was on the wire.
fn bytes(team: &v1::AssignRequest) -> usize {
    let costs = team.costs.as_ref().map_or(0, |costs| 8 * costs.values.len());
    let pairs = team.cost_overrides.len() + team.forbidden.len() + team.current.len();
    costs + 16 * (pairs + team.agent_ids.len() + team.goal_ids.len())
}

const MODEL_FAILED: &str = "the model failed with an internal error";

/// Solves by the requested method; the exact one answers in place of the learned one, for `fallback_reason`.
fn solve(problem: &Problem, fallback_reason: String, go_on: GoOn<'_>) -> Result<Planned, AssignError> {
    let plan = engine::solve(problem, problem.scheduler, go_on)?;
    Ok(Planned { plan, fallback_reason, weights: None })
}

fn ask(problem: &Problem, scheduler: &dyn Scheduler) -> Result<TeamReply, String> {
    // A panic of the model must not end the service.
    match catch_unwind(AssertUnwindSafe(|| scheduler.assign_team(problem))) {
        Ok(reply) => reply.map_err(|error| error.to_string()),
        Err(_) => Err(MODEL_FAILED.to_owned()),
    }
}

fn exceeded(limit: Duration) -> String {
    format!("the model exceeded its time limit of {limit:.1?}")
}
