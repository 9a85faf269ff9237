//! The streaming calls: streams of teams, and watching missions.

use crate::assign_service::AssignService;
use crate::call_budget::CallBudget;
use crate::error::to_status;
use crate::mission_service::{Event, MissionService, visible};
use magex_dispatch::Limits;
use magex_dispatch::clock::Now;
use magex_dispatch::missions::passes;
use magex_proto::v1;
use magex_runtime::net::auth::Caller;
use magex_runtime::net::heartbeat::Heartbeat;
use magex_runtime::net::in_flight::{InFlight, stopping};
use magex_runtime::status;
use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::broadcast::error::RecvError;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tonic::{Status, Streaming};
use tonic_types::StatusExt as _;

/// Capacity of the queue of answers to a client.
pub(crate) const AHEAD: usize = 2;
/// A client that does not read for this time loses its stream.
pub(crate) const READ_TIMEOUT: Duration = Duration::from_secs(60);
/// Assignments of a snapshot that are fetched together.
const PAGE: usize = 64;

/// Answers a stream of teams in order, until the client ends it or the service drains.
pub(crate) async fn assign(
    answering: Arc<AssignService>,
    in_flight: Arc<InFlight>,
    limits: Limits,
    mut teams: Streaming<v1::AssignStreamRequest>,
    answers: mpsc::Sender<Result<v1::AssignStreamResponse, Status>>,
    draining: CancellationToken,
    mut heartbeat: Heartbeat,
) {
    loop {
        let next = tokio::select! {
            next = teams.message() => next,
            () = heartbeat.due() => {
                // A queue with messages in it needs no heartbeat.
                let _ = answers.try_send(Ok(v1::AssignStreamResponse::default()));
                continue;
            }
            () = draining.cancelled() => Err(stopping()),
            () = answers.closed() => return,
        };
        let answer = match next {
            Ok(Some(request)) => {
                let budget = CallBudget::start(None);
                let sequence = request.sequence;
                let result = match in_flight.check_open() {
                    // A client that cancels frees the processor.
                    Ok(()) => tokio::select! {
                        result = one(&answering, &limits, request.team, budget) => result,
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
        if answers.send_timeout(answer, READ_TIMEOUT).await.is_err() || end {
            break;
        }
    }
}

async fn one(
    answering: &Arc<AssignService>,
    limits: &Limits,
    team: Option<v1::AssignRequest>,
    budget: CallBudget,
) -> Result<v1::AssignResponse, Status> {
    let team = team.ok_or_else(|| status::invalid_argument("team", "missing"))?;
    let problem = answering.read(team, limits).map_err(|error| to_status(error.within("team")))?;
    answering.respond(problem, budget).await
}

pub(crate) fn problem(status: &Status) -> v1::AssignProblem {
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

/// The filter of a watcher.
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

/// (Time of creation, revision) of the missions that a watcher has received, by name.
type Sent = HashMap<String, (i64, u64)>;

type Watcher = mpsc::Sender<Result<v1::WatchAssignmentsResponse, Status>>;

/// Sends a watcher a snapshot, then every change, until it cancels or the service drains.
pub(crate) async fn watch(
    missions: Arc<MissionService>,
    interest: Interest,
    watcher: Watcher,
    draining: CancellationToken,
    mut heartbeat: Heartbeat,
) {
    // Subscribes first, so that no change during the snapshot is missed.
    let mut events = missions.events.subscribe();
    let mut sent = Sent::new();
    let mut open = snapshot(&missions, &interest, &watcher, &mut sent).await;
    while open.is_some() {
        let event = tokio::select! {
            event = events.recv() => event,
            () = heartbeat.due() => {
                open = send(&watcher, v1::WatchKind::Heartbeat, None).await;
                continue;
            }
            () = watcher.closed() => break,
            () = draining.cancelled() => {
                // The watcher may have cancelled, too.
                let _ = watcher.send_timeout(Err(stopping()), READ_TIMEOUT).await;
                break;
            }
        };
        open = match event {
            Ok(event) => publish(&missions, &interest, &watcher, &mut sent, event).await,
            Err(RecvError::Lagged(missed)) => {
                tracing::debug!(missed, watcher = &*interest.caller.name, "a slow watcher gets a new snapshot");
                snapshot(&missions, &interest, &watcher, &mut sent).await
            }
            Err(RecvError::Closed) => None,
        };
    }
}

/// Sends the current assignments and remembers their revisions. Returns `None` if the watcher has cancelled.
async fn snapshot(missions: &MissionService, interest: &Interest, watcher: &Watcher, sent: &mut Sent) -> Option<()> {
    sent.clear();
    let mut after = String::new();
    loop {
        let (page, _) = missions.after(&interest.caller, &after, PAGE, interest.source);
        let Some(last) = page.last() else { break };
        after.clone_from(&last.mission_id);
        for assignment in page.into_iter().filter(|a| interest.wants(&a.mission_id)) {
            sent.insert(assignment.mission_id.clone(), (assignment.created_ms, assignment.revision));
            send(watcher, v1::WatchKind::Snapshot, Some(assignment)).await?;
        }
    }
    send(watcher, v1::WatchKind::Synced, None).await
}

/// Sends an event if the watcher wants it and has not got it with a snapshot. Returns `None` if the watcher has cancelled.
async fn publish(
    missions: &MissionService,
    interest: &Interest,
    watcher: &Watcher,
    sent: &mut Sent,
    event: Event,
) -> Option<()> {
    match event {
        Event::Mission(kind, mission) if passes(interest.source, v1::MissionSource::Client) => {
            let a = &mission.assignment;
            // The last event of a deleted or expired mission is still visible to its owner.
            let now = missions.now();
            let then = if kind == v1::WatchKind::Changed { now } else { Now { clock_ms: i64::MIN, ..now } };
            if !interest.wants(&a.mission_id) || !visible(&interest.caller, &mission, &then) {
                return Some(());
            }
            let revision = (a.created_ms, a.revision);
            match kind {
                // Older than the snapshot.
                v1::WatchKind::Changed if sent.get(&a.mission_id).is_some_and(|&last| last >= revision) => {
                    return Some(());
                }
                v1::WatchKind::Changed => drop(sent.insert(a.mission_id.clone(), revision)),
                _ => drop(sent.remove(&a.mission_id)),
            }
            send(watcher, kind, Some(mission.shown(&now))).await
        }
        Event::Training(shard) if passes(interest.source, v1::MissionSource::Training) => {
            for assignment in shard.assignments().filter(|a| interest.wants(&a.mission_id)) {
                send(watcher, v1::WatchKind::Changed, Some(assignment)).await?;
            }
            Some(())
        }
        _ => Some(()),
    }
}

async fn send(watcher: &Watcher, kind: v1::WatchKind, assignment: Option<v1::Assignment>) -> Option<()> {
    let message = v1::WatchAssignmentsResponse { kind: kind.into(), assignment };
    watcher.send_timeout(Ok(message), READ_TIMEOUT).await.ok()
}
