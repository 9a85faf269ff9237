//! Missions behind the API: planned on threads of their own, kept, and told to whoever watches.

use crate::access::{Caller, Role};
use crate::answering::{Answering, refusal};
use crate::scheduler::{GoalReply, GoalRequest, WeightsKey};
use crate::training::{Training, TrainingShard};
use magex_dispatch::mission::{Mission, Planned};
use magex_dispatch::missions::{KeepError, Missions, passes};
use magex_dispatch::{DispatchError, Problem};
use magex_proto::v1;
use magex_runtime::backoff::incarnation;
use magex_runtime::status;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};
use tokio::sync::broadcast;
use tonic::Status;

/// Events that a slow watcher may fall behind before it gets everything anew.
const BACKLOG: usize = 64;
/// How long planning a mission may take.
const PATIENCE: Duration = Duration::from_secs(30);
/// How often an update is planned again because the mission changed meanwhile.
const ATTEMPTS: u32 = 16;
/// When to come back to a service that keeps as many missions as it may.
const FULL: Duration = Duration::from_secs(10);
const PAGE: usize = 50;
const LONGEST_PAGE: usize = 500;

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

/// Milliseconds since 1970.
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
    ) -> Result<v1::Assignment, Status> {
        let (own, permit) = (self.clone(), self.answering.processor().await?);
        blocking(move || {
            let _held = permit;
            own.missions.check_room(&caller.name).map_err(kept)?;
            let (now, each) = (now_ms(), own.missions.bounds().each);
            let drawn = format!("m-{:016x}", incarnation());
            let planner = |problem: &Problem| own.plan(problem);
            let mission = Mission::create(request, &caller.name, &drawn, now, &each, &planner).map_err(refusal)?;
            own.change(v1::WatchKind::Changed, || own.missions.insert(mission)).map_err(kept)
        })
        .await
    }

    pub(crate) async fn update(
        self: &Arc<Self>,
        caller: Caller,
        request: v1::UpdateMissionRequest,
    ) -> Result<v1::Assignment, Status> {
        let (own, permit) = (self.clone(), self.answering.processor().await?);
        blocking(move || {
            let _held = permit;
            let each = own.missions.bounds().each;
            let mut attempt = 0;
            loop {
                let before = own.writable(&caller, &request.mission_id)?;
                let was = before.assignment.revision;
                if let Some(expected) = request.expected_revision.filter(|&expected| expected != was) {
                    return Err(Status::aborted(format!(
                        "the mission is at revision {was}, not {expected}; read it again"
                    )));
                }
                let planner = |problem: &Problem| own.plan(problem);
                let next = before.update(request.clone(), now_ms(), &each, &planner).map_err(refusal)?;
                attempt += 1;
                match own.change(v1::WatchKind::Changed, || own.missions.replace(next, was)) {
                    // Planned for what is no longer so.
                    Err(KeepError::Changed { .. }) if request.expected_revision.is_none() && attempt < ATTEMPTS => {}
                    result => return result.map_err(kept),
                }
            }
        })
        .await
    }

    pub(crate) async fn delete(self: &Arc<Self>, caller: Caller, id: String) -> Result<(), Status> {
        let own = self.clone();
        blocking(move || {
            own.writable(&caller, &id)?;
            own.change(v1::WatchKind::Deleted, || own.missions.remove(&id)).map(drop).map_err(kept)
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
        // One more tells whether there is another page.
        let mut assignments = self.after(caller, &request.page_token, size + 1, source);
        let more = assignments.len() > size;
        assignments.truncate(size);
        let last = assignments.last().filter(|_| more);
        let next_page_token = last.map(|a| a.mission_id.clone()).unwrap_or_default();
        Ok(v1::ListAssignmentsResponse { assignments, next_page_token })
    }

    /// Up to `count` assignments after this name, by name.
    pub(crate) fn after(
        &self,
        caller: &Caller,
        name: &str,
        count: usize,
        filter: v1::MissionSource,
    ) -> Vec<v1::Assignment> {
        let now = now_ms();
        let mut found = Vec::new();
        if passes(filter, v1::MissionSource::Client) {
            let page = self.missions.page(name, count, |mission| visible(caller, mission, now));
            found.extend(page.iter().map(|mission| mission.assignment.clone()));
        }
        if passes(filter, v1::MissionSource::Training) {
            found.extend(self.training.page(name, count, now));
        }
        found.sort_by(|a, b| a.mission_id.cmp(&b.mission_id));
        found.truncate(count);
        found
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

    fn plan(&self, problem: &Problem) -> Result<Planned, DispatchError> {
        let start = Instant::now();
        self.answering.plan_here(problem, PATIENCE, &|| start.elapsed() < PATIENCE)
    }

    /// A mission that this caller may change.
    fn writable(&self, caller: &Caller, id: &str) -> Result<Arc<Mission>, Status> {
        let now = now_ms();
        if let Some(mission) = self.missions.get(id).filter(|mission| visible(caller, mission, now)) {
            return Ok(mission);
        }
        match self.training.get(id, now) {
            Some(_) => Err(status::failed_precondition(format!("'{id}' is an episode of a training run: read only"))),
            None => Err(missing(id)),
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
        KeepError::Closed => crate::admission::stopping(),
        KeepError::Disk(_) => {
            tracing::error!(error = text, "missions cannot be written");
            Status::internal(text)
        }
    }
}

async fn blocking<T: Send + 'static>(work: impl FnOnce() -> Result<T, Status> + Send + 'static) -> Result<T, Status> {
    tokio::task::spawn_blocking(work).await.map_err(|error| Status::internal(error.to_string()))?
}
