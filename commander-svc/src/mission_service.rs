//! Missions: planned on worker threads, stored, and published to watchers.

use crate::assign_service::AssignService;
use crate::call_budget::CallBudget;
use crate::cancel::{Work, on_thread};
use crate::error::to_status;
use crate::training_view::{TrainingShard, TrainingView};
use magex_dispatch::answer::Planned;
use magex_dispatch::clock::Now;
use magex_dispatch::mission::{Mission, places};
use magex_dispatch::missions::{KeepError, Missions, passes};
use magex_dispatch::{AssignError, Problem};
use magex_proto::v1;
use magex_runtime::backoff::random_id;
use magex_runtime::net::auth::{Caller, Role};
use magex_runtime::status;
use magex_runtime::sync::lock;
use std::sync::{Arc, Mutex};
use tokio::sync::broadcast;
use tonic::Status;

/// Events that a watcher may lag behind before it gets a new snapshot.
const BACKLOG: usize = 64;
/// Attempts at an update of a mission that changes concurrently.
const ATTEMPTS: u32 = 16;
/// Assignments of a page: default and maximum.
const PAGE: usize = 50;
const LONGEST_PAGE: usize = 500;
/// Bytes of a page: gRPC clients accept 4 MiB by default.
const PAGE_BYTES: usize = 3 << 20;

/// An event for watchers.
#[derive(Debug, Clone)]
pub(crate) enum Event {
    /// A client's mission.
    Mission(v1::WatchKind, Arc<Mission>),
    /// Episodes that start.
    Training(Arc<TrainingShard>),
}

/// All missions, and the channel to their watchers.
pub(crate) struct MissionService {
    pub(crate) missions: Missions,
    training: TrainingView,
    answering: Arc<AssignService>,
    pub(crate) events: broadcast::Sender<Event>,
    /// Held from a change until its event is sent, so that watchers see changes in order.
    order: Mutex<()>,
}

impl MissionService {
    pub(crate) fn new(missions: Missions, answering: Arc<AssignService>) -> Arc<Self> {
        let (training, events) = (TrainingView::default(), broadcast::Sender::new(BACKLOG));
        Arc::new(Self { missions, training, answering, events, order: Mutex::default() })
    }

    /// The moment, on the clock of missions and for clients.
    pub(crate) fn now(&self) -> Now {
        let (now, jump) = self.missions.clock.now();
        if let Some(ms) = jump {
            let seconds = ms as f64 / 1e3;
            tracing::warn!(seconds, "the time of day has jumped; missions keep their lifetimes");
        }
        now
    }

    pub(crate) async fn create(
        self: &Arc<Self>,
        caller: Caller,
        request: v1::CreateMissionRequest,
        budget: CallBudget,
    ) -> Result<v1::Assignment, Status> {
        let cells = self.cells((0, 0), (request.agents.len(), places(&request.goals)), learned(request.scheduler));
        let (own, places) = (self.clone(), self.answering.places(cells, budget.left()).await?);
        on_thread(places, budget, move |work| {
            own.missions.check_room(&caller.name).map_err(to_status)?;
            let (now, each) = (own.now(), own.missions.bounds.each);
            let drawn = format!("m-{:016x}", random_id());
            let planner = own.planner(work);
            let mission = Mission::create(request, &caller.name, &drawn, now, &each, &planner).map_err(to_status)?;
            check(work)?;
            own.change(v1::WatchKind::Changed, || own.missions.insert(mission)).map_err(to_status)
        })
        .await?
    }

    pub(crate) async fn update(
        self: &Arc<Self>,
        caller: Caller,
        request: v1::UpdateMissionRequest,
        budget: CallBudget,
    ) -> Result<v1::Assignment, Status> {
        for attempt in 1..=ATTEMPTS {
            let last = attempt == ATTEMPTS;
            if let Some(assignment) = self.try_update(&caller, &request, budget, last).await? {
                return Ok(assignment);
            }
        }
        Err(Status::aborted("the mission changes faster than it is planned; send fewer updates at a time"))
    }

    /// One attempt at an update; `None` if the mission changed concurrently.
    async fn try_update(
        self: &Arc<Self>,
        caller: &Caller,
        request: &v1::UpdateMissionRequest,
        budget: CallBudget,
        last: bool,
    ) -> Result<Option<v1::Assignment>, Status> {
        let mission = self.writable(caller, &request.mission_id)?;
        let most = self.most_cells(&mission, request);
        let (own, places) = (self.clone(), self.answering.places(most, budget.left()).await?);
        let (caller, request) = (caller.clone(), request.clone());
        on_thread(places, budget, move |work| {
            let before = own.writable(&caller, &request.mission_id)?;
            let was = before.assignment.revision;
            if let Some(expected) = request.expected_revision.filter(|&expected| expected != was) {
                return Err(Status::aborted(format!(
                    "expected_revision: the mission is at revision {was}, not {expected}; read it again"
                )));
            }
            if own.most_cells(&before, &request) > most {
                // It has outgrown the reserved memory.
                return Ok(None);
            }
            let (each, again) = (own.missions.bounds.each, request.expected_revision.is_none() && !last);
            let next = before.update(request, own.now(), &each, &own.planner(work)).map_err(to_status)?;
            check(work)?;
            match own.change(v1::WatchKind::Changed, || own.missions.replace(next, was)) {
                Err(KeepError::Changed { .. }) if again => Ok(None),
                result => result.map(Some).map_err(to_status),
            }
        })
        .await?
    }

    pub(crate) async fn delete(self: &Arc<Self>, caller: Caller, id: String) -> Result<(), Status> {
        let own = self.clone();
        let deleting = tokio::task::spawn_blocking(move || {
            let now = own.now();
            let may = |mission: &Mission| visible(&caller, mission, &now);
            match own.change(v1::WatchKind::Deleted, || own.missions.remove(&id, may)) {
                Err(KeepError::Missing(_)) => Err(own.absent(&id)),
                result => result.map(drop).map_err(to_status),
            }
        });
        deleting.await.map_err(|error| Status::internal(error.to_string()))?
    }

    pub(crate) fn get(&self, caller: &Caller, id: &str) -> Result<v1::Assignment, Status> {
        let now = self.now();
        let own = self.missions.get(id).filter(|mission| visible(caller, mission, &now));
        let found = own.map(|mission| mission.shown(&now)).or_else(|| self.training.get(id, &now));
        found.ok_or_else(|| missing(id))
    }

    pub(crate) fn list(
        &self,
        caller: &Caller,
        request: &v1::ListAssignmentsRequest,
    ) -> Result<v1::ListAssignmentsResponse, Status> {
        let source = source(request.source)?;
        let size = match request.page_size as usize {
            0 => PAGE,
            size => size.min(LONGEST_PAGE),
        };
        let (assignments, more) = self.after(caller, &request.page_token, size, source);
        let last = assignments.last().filter(|_| more);
        let next_page_token = last.map(|a| a.mission_id.clone()).unwrap_or_default();
        Ok(v1::ListAssignmentsResponse { assignments, next_page_token })
    }

    /// Up to `count` assignments after this name, by name, within [`PAGE_BYTES`] (but at least one); whether there are more.
    pub(crate) fn after(
        &self,
        caller: &Caller,
        name: &str,
        count: usize,
        filter: v1::MissionSource,
    ) -> (Vec<v1::Assignment>, bool) {
        let now = self.now();
        // One more tells whether there is another page.
        let missions = || self.missions.page(name, count + 1, |mission| visible(caller, mission, &now));
        let missions = passes(filter, v1::MissionSource::Client).then(missions).unwrap_or_default();
        let episodes = || self.training.page(name, count + 1, &now);
        let episodes = passes(filter, v1::MissionSource::Training).then(episodes).unwrap_or_default();
        let (mut missions, mut episodes) = (missions.iter().peekable(), episodes.iter().peekable());
        let (mut found, mut bytes) = (Vec::new(), 0);
        loop {
            let client_first = match (missions.peek(), episodes.peek()) {
                (None, None) => return (found, false),
                (Some(mission), Some((name, ..))) => mission.id() <= name.as_str(),
                (mission, _) => mission.is_some(),
            };
            let assignment = match client_first {
                true => missions.next().map(|mission| mission.shown(&now)),
                false => episodes.next().and_then(|(_, shard, place)| shard.assignment(*place)),
            };
            // An inconsistent episode is skipped.
            let Some(assignment) = assignment else { continue };
            bytes += magex_proto::encoded_len(&assignment);
            if found.len() == count || (bytes > PAGE_BYTES && !found.is_empty()) {
                return (found, true);
            }
            found.push(assignment);
        }
    }

    /// Shows the goals of a shard's episodes as missions.
    pub(crate) fn record(&self, shard: TrainingShard) {
        let shard = Arc::new(shard);
        self.training.insert(shard.clone());
        // Fails without watchers.
        let _ = self.events.send(Event::Training(shard));
    }

    /// Deletes expired missions.
    pub(crate) async fn sweep(self: &Arc<Self>) {
        let own = self.clone();
        let sweeping = move || {
            let _order = lock(&own.order);
            let old = own.missions.expire(own.now())?;
            old.into_iter().for_each(|mission| drop(own.publish(v1::WatchKind::Expired, mission)));
            Ok::<(), KeepError>(())
        };
        match tokio::task::spawn_blocking(sweeping).await {
            Ok(Ok(())) => {}
            Ok(Err(error)) => tracing::error!(%error, "expired missions cannot be deleted"),
            Err(error) => tracing::error!(%error, "expired missions cannot be deleted"),
        }
    }

    /// Writes the clock of the missions down.
    pub(crate) async fn note_time(self: &Arc<Self>) {
        let own = self.clone();
        match tokio::task::spawn_blocking(move || own.missions.note_time()).await {
            Ok(Ok(())) => {}
            Ok(Err(error)) => tracing::warn!(%error, "the time cannot be written to the file of the missions"),
            Err(error) => tracing::warn!(%error, "the time cannot be written to the file of the missions"),
        }
    }

    /// Upper bound of the pairs that a scheduler sees in a mission of (agents, goals) after `more` are added.
    fn cells(&self, (agents, goals): (usize, usize), more: (usize, usize), learned: bool) -> usize {
        let most = self.missions.bounds.each.members;
        let (agents, goals) = ((agents + more.0).min(most), (goals + more.1).min(most));
        // The learned scheduler pads the smaller side.
        if learned { agents.max(goals).pow(2) } else { agents * goals }
    }

    fn most_cells(&self, before: &Mission, request: &v1::UpdateMissionRequest) -> usize {
        let learned = learned(before.assignment.scheduler) || learned(request.scheduler);
        self.cells(before.size(), (request.agents.len(), places(&request.goals)), learned)
    }

    fn planner(&self, work: &Work) -> impl Fn(&Problem) -> Result<Planned, AssignError> {
        move |problem| self.answering.plan_here(problem, work.budget.learned(), &|| work.go_on())
    }

    /// A mission that this caller may change.
    fn writable(&self, caller: &Caller, id: &str) -> Result<Arc<Mission>, Status> {
        let now = self.now();
        let found = self.missions.get(id).filter(|mission| visible(caller, mission, &now));
        found.ok_or_else(|| self.absent(id))
    }

    /// Why a caller may not change a mission: the same status whether it belongs to another client or does not exist.
    fn absent(&self, id: &str) -> Status {
        match self.training.get(id, &self.now()) {
            Some(_) => status::failed_precondition(format!("'{id}' is an episode of a training run: read only")),
            None => missing(id),
        }
    }

    /// Applies a change and publishes it. Runs on a blocking thread, so that a cancelled call cannot separate the two.
    fn change(
        &self,
        kind: v1::WatchKind,
        change: impl FnOnce() -> Result<Arc<Mission>, KeepError>,
    ) -> Result<v1::Assignment, KeepError> {
        let _order = lock(&self.order);
        Ok(self.publish(kind, change()?))
    }

    fn publish(&self, kind: v1::WatchKind, mission: Arc<Mission>) -> v1::Assignment {
        let assignment = mission.assignment.clone();
        // Fails without watchers.
        let _ = self.events.send(Event::Mission(kind, mission));
        assignment
    }
}

/// Before something is written: a call that was answered with an error has changed nothing.
fn check(work: &Work) -> Result<(), Status> {
    if work.go_on() { Ok(()) } else { Err(to_status(AssignError::Interrupted)) }
}

fn learned(scheduler: i32) -> bool {
    scheduler == v1::AssignmentMethod::Learned as i32
}

/// Whether a mission is visible to a caller.
pub(crate) fn visible(caller: &Caller, mission: &Mission, now: &Now) -> bool {
    let own = caller.role == Role::Admin || mission.assignment.owner == *caller.name;
    own && !mission.expired(now)
}

pub(crate) fn source(value: i32) -> Result<v1::MissionSource, Status> {
    v1::MissionSource::try_from(value)
        .map_err(|_| status::invalid_argument("source", format!("{value} is not a source; use client or training")))
}

fn missing(id: &str) -> Status {
    Status::not_found(format!("there is no mission '{id}'"))
}

#[cfg(test)]
mod tests;
