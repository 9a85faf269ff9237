//! The streaming calls: teams one after the other, and watching missions.

use crate::assign_service::{Answering, Clock};
use crate::mission_service::{Event, Keeper, now_ms, visible};
use magex_dispatch::missions::passes;
use magex_dispatch::{Limits, Problem};
use magex_proto::v1;
use magex_runtime::net::auth::Caller;
use magex_runtime::net::in_flight::{Admission, stopping};
use magex_runtime::status;
use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::broadcast::error::RecvError;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tonic::{Status, Streaming};
use tonic_types::StatusExt as _;

/// Answers that wait for a client to read them. More would only be older.
const AHEAD: usize = 2;
/// A client that reads nothing for so long is left.
const MUTE: Duration = Duration::from_secs(60);
/// Assignments of a snapshot that are fetched at once.
const PAGE: usize = 64;

/// Answers a stream of teams in order, until the client ends it or the service drains.
pub(crate) async fn assign(
    answering: Arc<Answering>,
    admission: Arc<Admission>,
    limits: Limits,
    mut teams: Streaming<v1::AssignStreamRequest>,
    answers: mpsc::Sender<Result<v1::AssignStreamResponse, Status>>,
    draining: CancellationToken,
) {
    loop {
        let next = tokio::select! {
            next = teams.message() => next,
            () = draining.cancelled() => Err(stopping()),
            () = answers.closed() => return,
        };
        let answer = match next {
            Ok(Some(request)) => {
                let clock = Clock::start(None);
                let sequence = request.sequence;
                let result = match admission.check_open() {
                    // Whoever hangs up does not keep a processor busy.
                    Ok(()) => tokio::select! {
                        result = one(&answering, &limits, request.team, clock) => result,
                        () = answers.closed() => return,
                    },
                    Err(status) => Err(status),
                };
                let result = match result {
                    Ok(answer) => v1::assign_stream_response::Result::Answer(answer),
                    Err(status) => v1::assign_stream_response::Result::Problem(problem(&status)),
                };
                Ok(v1::AssignStreamResponse { sequence, result: Some(result) })
            }
            Ok(None) => break,
            Err(status) => Err(status),
        };
        let end = answer.is_err();
        if answers.send_timeout(answer, MUTE).await.is_err() || end {
            break;
        }
    }
}

async fn one(
    answering: &Arc<Answering>,
    limits: &Limits,
    team: Option<v1::AssignRequest>,
    clock: Clock,
) -> Result<v1::AssignResponse, Status> {
    let team = team.ok_or_else(|| status::invalid_argument("team", "missing"))?;
    let problem = Problem::read(team, answering.seed(), limits).map_err(|error| {
        let error = error.within("team");
        status::invalid_argument(error.field, error.problem)
    })?;
    answering.respond(problem, clock).await
}

fn problem(status: &Status) -> v1::AssignProblem {
    let fields = status.get_details_bad_request().map(|details| details.field_violations).unwrap_or_default();
    v1::AssignProblem {
        code: status.code() as i32 as u32,
        message: status.message().to_owned(),
        fields: fields
            .into_iter()
            .map(|field| v1::FieldProblem { field: field.field, problem: field.description })
            .collect(),
    }
}

/// What a watcher wants to know.
#[derive(Debug, Clone)]
pub(crate) struct Interest {
    pub(crate) caller: Caller,
    pub(crate) ids: BTreeSet<String>,
    pub(crate) source: v1::MissionSource,
}

impl Interest {
    fn wants(&self, id: &str) -> bool {
        self.ids.is_empty() || self.ids.contains(id)
    }
}

type Watcher = mpsc::Sender<Result<v1::WatchAssignmentsResponse, Status>>;

/// Tells a watcher what is, and then what changes, until it goes or the service drains.
pub(crate) async fn watch(keeper: Arc<Keeper>, interest: Interest, watcher: Watcher, draining: CancellationToken) {
    // Subscribed first: what happens during the snapshot is not missed.
    let mut events = keeper.events();
    let Some(mut told) = snapshot(&keeper, &interest, &watcher).await else { return };
    loop {
        let event = tokio::select! {
            event = events.recv() => event,
            () = watcher.closed() => break,
            () = draining.cancelled() => {
                // It may be gone, too.
                let _ = watcher.send_timeout(Err(stopping()), MUTE).await;
                break;
            }
        };
        let alive = match event {
            Ok(event) => tell(&interest, &watcher, &mut told, event).await,
            Err(RecvError::Lagged(missed)) => {
                tracing::debug!(missed, watcher = &*interest.caller.name, "a slow watcher gets everything anew");
                match snapshot(&keeper, &interest, &watcher).await {
                    Some(now) => {
                        told = now;
                        true
                    }
                    None => false,
                }
            }
            Err(RecvError::Closed) => false,
        };
        if !alive {
            break;
        }
    }
}

/// Sends everything as it is. The revisions that were sent, or `None` if the watcher has gone.
async fn snapshot(keeper: &Keeper, interest: &Interest, watcher: &Watcher) -> Option<HashMap<String, (i64, u64)>> {
    let (mut told, mut after) = (HashMap::new(), String::new());
    loop {
        let (page, _) = keeper.after(&interest.caller, &after, PAGE, interest.source);
        let Some(last) = page.last() else { break };
        after.clone_from(&last.mission_id);
        for assignment in page.into_iter().filter(|a| interest.wants(&a.mission_id)) {
            told.insert(assignment.mission_id.clone(), (assignment.created_ms, assignment.revision));
            send(watcher, v1::WatchKind::Snapshot, Some(assignment)).await?;
        }
    }
    send(watcher, v1::WatchKind::Synced, None).await?;
    Some(told)
}

async fn tell(interest: &Interest, watcher: &Watcher, told: &mut HashMap<String, (i64, u64)>, event: Event) -> bool {
    match event {
        Event::Mission(kind, mission) => {
            let a = &mission.assignment;
            // The last word about a mission that is over is still about its owner's mission.
            let now = if kind == v1::WatchKind::Changed { now_ms() } else { i64::MIN };
            let wanted = passes(interest.source, v1::MissionSource::Client) && interest.wants(&a.mission_id);
            if !wanted || !visible(&interest.caller, &mission, now) {
                return true;
            }
            match kind {
                // The snapshot was newer.
                v1::WatchKind::Changed if told.get(&a.mission_id).is_some_and(|&t| t >= (a.created_ms, a.revision)) => {
                    return true;
                }
                v1::WatchKind::Changed => drop(told.insert(a.mission_id.clone(), (a.created_ms, a.revision))),
                _ => drop(told.remove(&a.mission_id)),
            }
            send(watcher, kind, Some(a.clone())).await.is_some()
        }
        Event::Training(shard) => {
            if !passes(interest.source, v1::MissionSource::Training) {
                return true;
            }
            for assignment in shard.assignments().filter(|a| interest.wants(&a.mission_id)) {
                if send(watcher, v1::WatchKind::Changed, Some(assignment)).await.is_none() {
                    return false;
                }
            }
            true
        }
    }
}

async fn send(watcher: &Watcher, kind: v1::WatchKind, assignment: Option<v1::Assignment>) -> Option<()> {
    let message = v1::WatchAssignmentsResponse { kind: kind.into(), assignment };
    watcher.send_timeout(Ok(message), MUTE).await.ok()
}

/// A channel of answers as long as a slow client may be behind.
pub(crate) fn channel<T>() -> (mpsc::Sender<T>, mpsc::Receiver<T>) {
    mpsc::channel(AHEAD)
}
