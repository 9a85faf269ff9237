//! Missions behind the API: planned on threads of their own, kept, and told to whoever watches.

use crate::assign_service::{Answering, Clock, refusal};
use crate::shard_assign::Gone;
use crate::scheduler::{GoalReply, GoalRequest, WeightsKey};
use crate::training_view::{Episode, Training, TrainingShard};
use magex_dispatch::mission::{Mission, Planned};
use magex_dispatch::missions::{KeepError, Missions, passes};
use magex_dispatch::{DispatchError, Problem};
use magex_proto::v1;
use magex_runtime::net::auth::{Caller, Role};
use magex_runtime::backoff::incarnation;
use magex_runtime::status;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use tokio::sync::broadcast;
use tonic::Status;

/// Events that a slow watcher may fall behind before it gets everything anew.
const BACKLOG: usize = 64;
/// How often an update is planned again because the mission changed meanwhile.
const ATTEMPTS: u32 = 16;
/// When to come back to a service that keeps as many missions as it may.
const FULL: Duration = Duration::from_secs(10);
/// When to come back to one whose disk takes nothing: not before it is tried again.
const NO_DISK: Duration = Duration::from_secs(2);
const PAGE: usize = 50;
const LONGEST_PAGE: usize = 500;
/// Bytes of a page: clients take messages of 4 MiB unless told otherwise.
const PAGE_BYTES: usize = 3 << 20;

/// Something that watchers are told.
#[derive(Debug, Clone)]
pub(crate) enum Event {
    /// A client's mission.
    Mission(v1::WatchKind, Arc<Mission>),
    /// Episodes that begin.
    Training(Arc<TrainingShard>),
}

/// All missions, and who wants to know of them.
#[derive(Debug)]
pub(crate) struct Keeper {
    missions: Missions,
    training: Training,
    answering: Arc<Answering>,
    events: broadcast::Sender<Event>,
    /// Held from a change until the watchers have been told: they hear of changes in their order.
    order: Mutex<()>,
}

/// Milliseconds since 1970: missions outlive the process, and their ages with them.
#[allow(clippy::disallowed_methods, reason = "when a mission was made is told to people and kept across restarts")]
pub(crate) fn now_ms() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis() as i64)
}

impl Keeper {
    pub(crate) fn new(missions: Missions, answering: Arc<Answering>) -> Arc<Self> {
        let (training, events) = (Training::default(), broadcast::Sender::new(BACKLOG));
        Arc::new(Self { missions, training, answering, events, order: Mutex::default() })
    }

    pub(crate) async fn create(
        self: &Arc<Self>,
        caller: Caller,
        request: v1::CreateMissionRequest,
        clock: Clock,
    ) -> Result<v1::Assignment, Status> {
        let cells = self.cells((0, 0), (request.agents.len(), request.goals.len()), learned(request.scheduler));
        let (own, places) = (self.clone(), self.answering.places(cells, clock.left()).await?);
        let gone = Gone::default();
        let waits = Waits::from(&gone, clock);
        blocking(move || {
            let _held = places;
            own.missions.check_room(&caller.name).map_err(kept)?;
            let (now, each) = (now_ms(), own.missions.bounds().each);
            let drawn = format!("m-{:016x}", incarnation());
            let planner = |problem: &Problem| own.plan(problem, &waits);
            let mission = Mission::create(request, &caller.name, &drawn, now, &each, &planner).map_err(refusal)?;
            waits.check()?;
            own.change(v1::WatchKind::Changed, || own.missions.insert(mission)).map_err(kept)
        })
        .await
    }

    pub(crate) async fn update(
        self: &Arc<Self>,
        caller: Caller,
        request: v1::UpdateMissionRequest,
        clock: Clock,
    ) -> Result<v1::Assignment, Status> {
        let gone = Gone::default();
        for _ in 1..ATTEMPTS {
            if let Some(assignment) = self.try_update(&caller, &request, Waits::from(&gone, clock), false).await? {
                return Ok(assignment);
            }
        }
        let last = self.try_update(&caller, &request, Waits::from(&gone, clock), true).await?;
        last.ok_or_else(|| Status::aborted("the mission grows faster than it is planned; send fewer updates at a time"))
    }

    /// One attempt at an update; `None` if the mission has meanwhile become another than was planned for.
    async fn try_update(
        self: &Arc<Self>,
        caller: &Caller,
        request: &v1::UpdateMissionRequest,
        waits: Waits,
        last: bool,
    ) -> Result<Option<v1::Assignment>, Status> {
        let mission = self.writable(caller, &request.mission_id)?;
        let most = self.most_cells(&mission, request);
        let (own, places) = (self.clone(), self.answering.places(most, waits.clock.left()).await?);
        let (caller, request) = (caller.clone(), request.clone());
        blocking(move || {
            let _held = places;
            let before = own.writable(&caller, &request.mission_id)?;
            let was = before.assignment.revision;
            if let Some(expected) = request.expected_revision.filter(|&expected| expected != was) {
                return Err(Status::aborted(format!(
                    "the mission is at revision {was}, not {expected}; read it again"
                )));
            }
            if own.most_cells(&before, &request) > most {
                // It has grown beyond the memory that was asked for.
                return Ok(None);
            }
            let (each, again) = (own.missions.bounds().each, request.expected_revision.is_none() && !last);
            let planner = |problem: &Problem| own.plan(problem, &waits);
            let next = before.update(request, now_ms(), &each, &planner).map_err(refusal)?;
            waits.check()?;
            match own.change(v1::WatchKind::Changed, || own.missions.replace(next, was)) {
                Err(KeepError::Changed { .. }) if again => Ok(None),
                result => result.map(Some).map_err(kept),
            }
        })
        .await
    }

    pub(crate) async fn delete(self: &Arc<Self>, caller: Caller, id: String) -> Result<(), Status> {
        let own = self.clone();
        blocking(move || {
            let may = |mission: &Mission| visible(&caller, mission, now_ms());
            match own.change(v1::WatchKind::Deleted, || own.missions.remove(&id, may)) {
                Err(KeepError::Missing(_)) => Err(own.absent(&id)),
                result => result.map(drop).map_err(kept),
            }
        })
        .await
    }

    pub(crate) fn get(&self, caller: &Caller, id: &str) -> Result<v1::Assignment, Status> {
        let now = now_ms();
        let own = self.missions.get(id).filter(|mission| visible(caller, mission, now));
        let found = own.map(|mission| mission.assignment.clone()).or_else(|| self.training.get(id, now));
        found.ok_or_else(|| missing(id))
    }

    pub(crate) fn list(
        &self,
        caller: &Caller,
        request: &v1::ListAssignmentsRequest,
    ) -> Result<v1::ListAssignmentsResponse, Status> {
        let source = source("source", request.source)?;
        let size = match request.page_size as usize {
            0 => PAGE,
            size => size.min(LONGEST_PAGE),
        };
        let (assignments, more) = self.after(caller, &request.page_token, size, source);
        let last = assignments.last().filter(|_| more);
        let next_page_token = last.map(|a| a.mission_id.clone()).unwrap_or_default();
        Ok(v1::ListAssignmentsResponse { assignments, next_page_token })
    }

    /// Up to `count` assignments after this name, by name, and no more than [`PAGE_BYTES`] unless the first alone is longer;
    /// and whether there are more.
    pub(crate) fn after(
        &self,
        caller: &Caller,
        name: &str,
        count: usize,
        filter: v1::MissionSource,
    ) -> (Vec<v1::Assignment>, bool) {
        let now = now_ms();
        // One more tells whether there is another page.
        let (mut missions, mut episodes) = (Vec::new(), Vec::new());
        if passes(filter, v1::MissionSource::Client) {
            missions = self.missions.page(name, count + 1, |mission| visible(caller, mission, now));
        }
        if passes(filter, v1::MissionSource::Training) {
            episodes = self.training.page(name, count + 1, now);
        }
        let (mut missions, mut episodes) = (missions.iter().peekable(), episodes.iter().peekable());
        let (mut found, mut bytes) = (Vec::new(), 0);
        loop {
            let client_first = match (missions.peek(), episodes.peek()) {
                (None, None) => return (found, false),
                (Some(mission), Some(episode)) => mission.id() <= episode.name.as_str(),
                (mission, _) => mission.is_some(),
            };
            let assignment = match client_first {
                true => missions.next().map(|mission| mission.assignment.clone()),
                false => episodes.next().and_then(Episode::assignment),
            };
            // An episode that makes no sense is left out.
            let Some(assignment) = assignment else { continue };
            bytes += magex_proto::encoded_len(&assignment);
            if found.len() == count || (bytes > PAGE_BYTES && !found.is_empty()) {
                return (found, true);
            }
            found.push(assignment);
        }
    }

    /// What happens from now on.
    pub(crate) fn events(&self) -> broadcast::Receiver<Event> {
        self.events.subscribe()
    }

    /// Shows the goals of a shard's episodes as missions.
    pub(crate) fn record(&self, request: Arc<GoalRequest>, reply: Arc<GoalReply>, key: WeightsKey) {
        let shard = Arc::new(TrainingShard::new(request, reply, key, now_ms()));
        self.training.insert(shard.clone());
        // Nobody may be watching.
        let _ = self.events.send(Event::Training(shard));
    }

    /// Clients' missions that are kept.
    pub(crate) fn count(&self) -> usize {
        self.missions.count()
    }

    /// Events that the slowest watcher has yet to see.
    pub(crate) fn backlog(&self) -> usize {
        self.events.len()
    }

    /// Lets go of the disk: another commander may have it.
    pub(crate) fn close(&self) {
        self.missions.close();
    }

    /// Forgets missions whose time is over.
    pub(crate) async fn sweep(self: &Arc<Self>) {
        let own = self.clone();
        let sweeping = move || {
            let _order = own.order.lock().unwrap_or_else(PoisonError::into_inner);
            let old = own.missions.expire(now_ms())?;
            old.into_iter().for_each(|mission| drop(own.tell(v1::WatchKind::Expired, mission)));
            Ok::<(), KeepError>(())
        };
        match tokio::task::spawn_blocking(sweeping).await {
            Ok(Ok(())) => {}
            Ok(Err(error)) => tracing::error!(%error, "old missions cannot be forgotten"),
            Err(error) => tracing::error!(%error, "old missions cannot be forgotten"),
        }
    }

    /// The most pairs that a scheduler looks at in a mission of (agents, goals) when `more` have come.
    fn cells(&self, (agents, goals): (usize, usize), more: (usize, usize), learned: bool) -> usize {
        let most = self.missions.bounds().each.members;
        let (agents, goals) = ((agents + more.0).min(most), (goals + more.1).min(most));
        // The learned scheduler fills the smaller side up.
        if learned { agents.max(goals).pow(2) } else { agents * goals }
    }

    fn most_cells(&self, before: &Mission, request: &v1::UpdateMissionRequest) -> usize {
        let learned = learned(before.assignment.scheduler) || learned(request.scheduler);
        self.cells(before.size(), (request.agents.len(), request.goals.len()), learned)
    }

    fn plan(&self, problem: &Problem, waits: &Waits) -> Result<Planned, DispatchError> {
        self.answering.plan_here(problem, waits.clock.learned(), &|| waits.go_on())
    }

    /// A mission that this caller may change.
    fn writable(&self, caller: &Caller, id: &str) -> Result<Arc<Mission>, Status> {
        let now = now_ms();
        let found = self.missions.get(id).filter(|mission| visible(caller, mission, now));
        found.ok_or_else(|| self.absent(id))
    }

    /// Why there is nothing of this name that a caller may change: the same words whether it is somebody else's or nobody's.
    fn absent(&self, id: &str) -> Status {
        match self.training.get(id, now_ms()) {
            Some(_) => status::failed_precondition(format!("'{id}' is an episode of a training run: read only")),
            None => missing(id),
        }
    }

    /// Changes something and tells the watchers. Runs where nobody who hangs up can come in between.
    fn change(
        &self,
        kind: v1::WatchKind,
        change: impl FnOnce() -> Result<Arc<Mission>, KeepError>,
    ) -> Result<v1::Assignment, KeepError> {
        // A thread that died left nothing half done: the lock guards no value.
        let _order = self.order.lock().unwrap_or_else(PoisonError::into_inner);
        Ok(self.tell(kind, change()?))
    }

    fn tell(&self, kind: v1::WatchKind, mission: Arc<Mission>) -> v1::Assignment {
        let assignment = mission.assignment.clone();
        // Nobody may be watching.
        let _ = self.events.send(Event::Mission(kind, mission));
        assignment
    }
}

/// Whether somebody still waits for a plan: the caller's call is dropped when it hangs up and when its deadline is over.
struct Waits {
    gone: Arc<AtomicBool>,
    clock: Clock,
}

impl Waits {
    fn from(gone: &Gone, clock: Clock) -> Self {
        Self { gone: gone.0.clone(), clock }
    }

    fn go_on(&self) -> bool {
        !self.gone.load(Ordering::Relaxed) && !self.clock.over()
    }

    /// Before something is written: who was told that there was no answer finds nothing changed.
    fn check(&self) -> Result<(), Status> {
        if self.go_on() { Ok(()) } else { Err(refusal(DispatchError::Interrupted)) }
    }
}

fn learned(scheduler: i32) -> bool {
    scheduler == v1::SchedulerKind::Learned as i32
}

/// Whether a caller may know of a mission at all.
pub(crate) fn visible(caller: &Caller, mission: &Mission, now: i64) -> bool {
    let own = caller.role == Role::Admin || mission.assignment.owner == *caller.name;
    own && mission.assignment.expires_ms > now
}

pub(crate) fn source(field: &str, value: i32) -> Result<v1::MissionSource, Status> {
    v1::MissionSource::try_from(value).map_err(|_| status::invalid_argument(field, format!("{value} is unknown")))
}

fn missing(id: &str) -> Status {
    Status::not_found(format!("there is no mission '{id}'"))
}

fn kept(error: KeepError) -> Status {
    let text = error.to_string();
    match error {
        KeepError::Exists(_) => Status::already_exists(text),
        KeepError::Missing(_) => Status::not_found(text),
        KeepError::Full(_) => status::resource_exhausted(text, FULL),
        KeepError::Changed { .. } => Status::aborted(text),
        KeepError::Closed => magex_runtime::net::in_flight::stopping(),
        KeepError::Disk(_) => {
            tracing::error!(error = text, "missions cannot be written");
            // The file is opened anew: this passes when there is room.
            status::unavailable(text, NO_DISK)
        }
    }
}

async fn blocking<T: Send + 'static>(work: impl FnOnce() -> Result<T, Status> + Send + 'static) -> Result<T, Status> {
    tokio::task::spawn_blocking(work).await.map_err(|error| Status::internal(error.to_string()))?
}

#[cfg(test)]
mod tests;
