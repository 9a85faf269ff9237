//! Answering one team: which scheduler, on which thread, until when, and what stands in for it.
//!
//! Small teams are answered where the call came in: handing them to another thread costs more than the answer. Large ones
//! go to threads of their own, as many at once as there are processors and as there is memory.

use crate::shard_assign::Gone;
use crate::metrics::CommanderGauges;
use crate::scheduler::{Scheduler, SchedulerKind, TeamReply, TeamRequest, WeightsKey};
use crate::model_store::Store;
use magex_dispatch::mission::Planned;
use magex_dispatch::{DispatchError, Problem, answer, engine};
use magex_proto::v1;
use magex_runtime::backoff::incarnation;
use magex_runtime::status;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tonic::Status;

/// How long a request waits for a processor before it is turned away.
const QUEUE_PATIENCE: Duration = Duration::from_secs(1);

/// How long the learned scheduler may take for a team that brings no deadline before the exact one answers in its place.
const LEARNED_PATIENCE: Duration = Duration::from_millis(500);

/// How long any answer may take.
const PATIENCE: Duration = Duration::from_secs(60);

/// Pairs of a team that is answered at once by a classical scheduler: well under a millisecond.
const SMALL: usize = 10_000;

/// The same for the learned scheduler.
const SMALL_LEARNED: usize = 4096;

/// A model is asked on the spot only if it was so many times faster lately than it has time; otherwise it is watched from
/// another thread.
const MARGIN: u32 = 4;

/// Pairs per unit of memory, and units: one team of 5,000 × 5,000 at a time.
const UNIT: usize = 1_000_000;
const UNITS: usize = 26;

/// Answers teams.
#[derive(Debug)]
pub(crate) struct Answering {
    store: Arc<Store>,
    pub(crate) gauges: Arc<CommanderGauges>,
    processors: Arc<Semaphore>,
    memory: Arc<Semaphore>,
    /// How long the model took for a small team lately, nanoseconds: the slowest, slowly forgotten. Decides only on which
    /// thread it is asked.
    pace: AtomicU64,
    /// Seeds of requests that bring none.
    next_seed: AtomicU64,
}

/// When a request came in, and until when its answer is wanted.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Clock {
    start: Instant,
    until: Instant,
    /// The request itself set the end.
    own: bool,
}

impl Clock {
    /// From now on, for as long as the call's headers say.
    pub(crate) fn start(call: Option<Duration>) -> Self {
        let start = Instant::now();
        let until = start + call.unwrap_or(PATIENCE).min(PATIENCE);
        Self { start, until, own: call.is_some() }
    }

    fn limited(self, deadline: Option<Duration>) -> Self {
        let until = deadline.map_or(self.until, |deadline| self.until.min(self.start + deadline));
        Self { until, own: self.own || deadline.is_some(), ..self }
    }

    /// How long the learned scheduler may take: half of what is left, so that the exact one has the rest.
    pub(crate) fn learned(&self) -> Duration {
        let left = self.until.saturating_duration_since(Instant::now()) / 2;
        if self.own { left } else { left.min(LEARNED_PATIENCE) }
    }

    /// Since the request came in.
    pub(crate) fn elapsed(&self) -> Duration {
        self.start.elapsed()
    }

    /// Until the answer is wanted no more.
    pub(crate) fn left(&self) -> Duration {
        self.until.saturating_duration_since(Instant::now())
    }

    /// The answer is wanted no more.
    pub(crate) fn over(&self) -> bool {
        Instant::now() >= self.until
    }
}

/// A processor, and memory.
pub(crate) type Places = (OwnedSemaphorePermit, OwnedSemaphorePermit);

impl Answering {
    pub(crate) fn new(store: Arc<Store>, gauges: Arc<CommanderGauges>) -> Arc<Self> {
        let processors = Arc::new(Semaphore::new(magex_runtime::process::processors()));
        let (memory, next_seed) = (Arc::new(Semaphore::new(UNITS)), AtomicU64::new(incarnation()));
        let pace = AtomicU64::new(u64::MAX);
        Arc::new(Self { store, gauges, processors, memory, pace, next_seed })
    }

    /// A seed for a request without one.
    pub(crate) fn seed(&self) -> u64 {
        self.next_seed.fetch_add(1, Ordering::Relaxed)
    }

    /// Answers a team on the wire.
    pub(crate) async fn respond(
        self: &Arc<Self>,
        problem: Problem,
        clock: Clock,
    ) -> Result<v1::AssignResponse, Status> {
        let clock = clock.limited(problem.deadline);
        let problem = Arc::new(problem);
        let planned = self.plan(&problem, &clock).await?;
        let mut response = answer::write(&problem, &planned.plan);
        response.fallback_reason = planned.fallback_reason;
        if let Some((version, sha256, run)) = planned.weights {
            (response.version, response.sha256, response.run_id) = (version, sha256, run);
        }
        let took = clock.elapsed();
        response.seconds = took.as_secs_f64();
        self.gauges.answered(response.scheduler().into(), !response.fallback_reason.is_empty(), took);
        Ok(response)
    }

    async fn plan(self: &Arc<Self>, problem: &Arc<Problem>, clock: &Clock) -> Result<Planned, Status> {
        let learned = problem.scheduler == SchedulerKind::Learned;
        let here = if learned { self.small_for_model(problem, clock) } else { problem.cells() <= SMALL };
        let cells = if learned { engine::learned_cells(problem) } else { problem.cells() };
        let on_the_spot = |planned: Planned| if clock.over() { Err(too_late()) } else { Ok(planned) };
        if here {
            let planned = self.plan_here(problem, clock.learned(), &|| !clock.over()).map_err(refusal)?;
            return on_the_spot(planned);
        }
        let mut reason = String::new();
        let places = match self.places(cells, clock.left()).await {
            Ok(places) => Arc::new(places),
            Err(_) if learned && problem.cells() <= SMALL => {
                let plan = engine::solve(problem, SchedulerKind::Exact, &|| !clock.over()).map_err(refusal)?;
                let fallback_reason = "all processors are busy with the model".to_owned();
                return on_the_spot(Planned { plan, fallback_reason, weights: None });
            }
            Err(busy) => return Err(busy),
        };
        if learned {
            match self.watch_learned(problem, clock, places.clone()).await {
                Ok(planned) => return Ok(planned),
                Err(why) => reason = why,
            }
        }
        let gone = Gone::default();
        let (problem, flag, until) = (problem.clone(), gone.0.clone(), clock.until);
        let kind = stand_in(problem.scheduler);
        let work = tokio::task::spawn_blocking(move || {
            // Held for as long as the thread works, whether or not anybody waits for it.
            let _held = places;
            engine::solve(&problem, kind, &|| !flag.load(Ordering::Relaxed) && Instant::now() < until)
        });
        let late = tokio::time::sleep_until((clock.until + Duration::from_millis(5)).into());
        let plan = tokio::select! {
            done = work => done.map_err(|error| Status::internal(error.to_string()))?.map_err(refusal)?,
            () = late => return Err(too_late()),
        };
        Ok(Planned { plan, fallback_reason: reason, weights: None })
    }

    /// The model answers teams of this size in a fraction of the time that there is.
    fn small_for_model(&self, problem: &Problem, clock: &Clock) -> bool {
        if engine::not_for_learned(problem).is_some() || self.store.latest().is_none() {
            return problem.cells() <= SMALL;
        }
        let pace = Duration::from_nanos(self.pace.load(Ordering::Relaxed));
        engine::learned_cells(problem) <= SMALL_LEARNED && pace.saturating_mul(MARGIN) <= clock.learned()
    }

    /// Processors that have nothing to do for large teams.
    pub(crate) fn free_processors(&self) -> usize {
        self.processors.available_permits()
    }

    /// A processor and memory for so many pairs.
    pub(crate) async fn places(&self, cells: usize, patience: Duration) -> Result<Places, Status> {
        let patience = QUEUE_PATIENCE.min(patience);
        let both = async {
            let memory = self.memory(cells).await?;
            Some((self.processors.clone().acquire_owned().await.ok()?, memory))
        };
        match tokio::time::timeout(patience, both).await {
            Ok(Some(places)) => Ok(places),
            _ => Err(busy()),
        }
    }

    /// Memory for so many pairs, as soon as there is some; `None` never.
    pub(crate) async fn memory(&self, cells: usize) -> Option<OwnedSemaphorePermit> {
        let units = cells.div_ceil(UNIT).clamp(1, UNITS) as u32;
        self.memory.clone().acquire_many_owned(units).await.ok()
    }

    /// Asks the learned scheduler on another thread and leaves it there if it takes too long.
    async fn watch_learned(
        self: &Arc<Self>,
        problem: &Arc<Problem>,
        clock: &Clock,
        places: Arc<Places>,
    ) -> Result<Planned, String> {
        let (own, asked, patience, until) = (self.clone(), problem.clone(), clock.learned(), clock.until);
        let gone = Gone::default();
        let flag = gone.0.clone();
        let answer = tokio::task::spawn_blocking(move || {
            let _held = places;
            own.ask_learned(&asked, &|| !flag.load(Ordering::Relaxed) && Instant::now() < until)
        });
        match tokio::time::timeout(patience, answer).await {
            Ok(Ok(answer)) => answer,
            Ok(Err(_)) => Err("the model failed".to_owned()),
            Err(_) => Err(took_longer(patience)),
        }
    }

    /// Answers on this thread. The learned scheduler's answer is dropped if it took longer than `patience`.
    pub(crate) fn plan_here(
        &self,
        problem: &Problem,
        patience: Duration,
        go_on: &dyn Fn() -> bool,
    ) -> Result<Planned, DispatchError> {
        let mut reason = String::new();
        if problem.scheduler == SchedulerKind::Learned {
            let start = Instant::now();
            match self.ask_learned(problem, go_on) {
                Ok(planned) if start.elapsed() <= patience => return Ok(planned),
                Ok(_) => reason = took_longer(patience),
                Err(why) => reason = why,
            }
        }
        let plan = engine::solve(problem, stand_in(problem.scheduler), go_on)?;
        Ok(Planned { plan, fallback_reason: reason, weights: None })
    }

    /// The learned answer, or why there is none.
    fn ask_learned(&self, problem: &Problem, go_on: &dyn Fn() -> bool) -> Result<Planned, String> {
        if let Some(reason) = engine::not_for_learned(problem) {
            return Err(reason.to_owned());
        }
        let Some((key, scheduler)) = self.store.latest() else {
            return Err("no model is loaded".to_owned());
        };
        // Nobody may be waiting any more when a thread is free.
        if !go_on() {
            return Err("there was no time left for the model".to_owned());
        }
        let start = Instant::now();
        let reply = ask(problem, scheduler.as_ref());
        if engine::learned_cells(problem) <= SMALL_LEARNED {
            let took = u64::try_from(start.elapsed().as_nanos()).unwrap_or(u64::MAX);
            let before = self.pace.load(Ordering::Relaxed);
            let before = if before == u64::MAX { 0 } else { before - before / 8 };
            self.pace.store(took.max(before), Ordering::Relaxed);
        }
        let reply = reply?;
        // What follows is for somebody who still waits.
        if !go_on() {
            return Err("the model was late".to_owned());
        }
        let plan = engine::adopt(problem, reply.goals, reply.probabilities, go_on)?;
        Ok(Planned { plan, fallback_reason: String::new(), weights: Some(names(&key)) })
    }
}

fn ask(problem: &Problem, scheduler: &dyn Scheduler) -> Result<TeamReply, String> {
    let request = TeamRequest {
        agent_count: problem.agent_count,
        goal_count: problem.goal_count,
        dims: problem.dims,
        agents: problem.agents.clone(),
        goals: problem.goals.clone(),
        mode: problem.mode,
        seed: problem.seed,
    };
    // A model must not take the service down with it.
    match catch_unwind(AssertUnwindSafe(|| scheduler.assign_team(&request))) {
        Ok(reply) => reply.map_err(|error| error.to_string()),
        Err(_) => Err("the model failed".to_owned()),
    }
}

fn names(key: &WeightsKey) -> (u32, String, String) {
    (key.version.0, key.sha256.clone(), key.run_id.0.clone())
}

fn stand_in(kind: SchedulerKind) -> SchedulerKind {
    if kind == SchedulerKind::Learned { SchedulerKind::Exact } else { kind }
}

fn took_longer(patience: Duration) -> String {
    format!("the model took longer than {patience:.1?}")
}

fn busy() -> Status {
    status::resource_exhausted("all processors are busy", QUEUE_PATIENCE)
}

fn too_late() -> Status {
    Status::deadline_exceeded("there was no answer in time; allow more time, or ask for the greedy scheduler")
}

/// A problem as the caller is told of it.
pub(crate) fn refusal(error: DispatchError) -> Status {
    match error {
        DispatchError::Invalid(error) => status::invalid_argument(error.field, error.problem),
        DispatchError::Interrupted => too_late(),
    }
}
