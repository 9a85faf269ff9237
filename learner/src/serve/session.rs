//! One connection of one actor: grants leases as its credit allows, receives results, and ends when the actor is silent for
//! the time of a lease. The actor's end is `session` of `magex-actor`.

mod results;

use crate::run_events::describe;
use crate::serve::ledger::{Asker, LeaseId, SessionId};
use crate::serve::roster::ActorEntry;
use crate::serve::shared::Shared;
use magex_proto::parts::Assembler;
use magex_proto::v1::rollout_request::Message as Request;
use magex_proto::v1::rollout_response::Message as Response;
use magex_proto::{PROTOCOL_VERSION, v1};
use magex_runtime::{status, trace};
use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{mpsc, watch};
use tokio::time::Instant;
use tokio_stream::{Stream, StreamExt as _};
use tokio_util::sync::CancellationToken;
use tonic::{Status, Streaming};
use tracing::Span;

pub(crate) type Outbound = mpsc::Sender<Result<v1::RolloutResponse, Status>>;

/// Limit of the leases that an actor may hold, and of its credit for more.
const MAX_LEASES: usize = 1024;

/// An actor that gives leases back gets one at a time, and after the second in a row one in this time (or in the time of a lease,
/// if that is less), until it delivers.
const PROBE: Duration = Duration::from_secs(5);
/// How often an idle actor is offered late shards that are kept for others with room.
const LATE_PERIOD: Duration = Duration::from_millis(200);

#[derive(Debug)]
enum SessionEnd {
    /// The actor or the network closed the connection.
    Left,
    /// The actor sent nothing for the time of a lease.
    Silent,
    /// The same process connected again.
    Replaced,
    /// The learner stops, or the run is complete.
    Closing,
    /// The actor broke the protocol or was evicted.
    Refused(Status),
}

impl SessionEnd {
    fn name(&self) -> &'static str {
        match self {
            Self::Left => "left",
            Self::Silent => "silent",
            Self::Replaced => "replaced",
            Self::Closing => "closing",
            Self::Refused(_) => "refused",
        }
    }
}

/// Serves one connection: waits for the hello, registers the actor and runs its session.
pub(crate) async fn serve(
    shared: Arc<Shared>,
    address: String,
    mut inbound: Streaming<v1::RolloutRequest>,
    outbound: Outbound,
) {
    let first = tokio::select! {
        () = shared.control.closing.cancelled() => return,
        first = tokio::time::timeout(shared.lease_time(), inbound.message()) => first,
    };
    let answer = match first {
        Ok(Ok(Some(_))) if shared.status.finished() => Ok(run_is_complete()),
        Ok(Ok(Some(first))) => match handshake(&shared, address, first, &outbound) {
            Ok((registered, hello)) => return Session::new(shared, registered, hello, outbound).serve(inbound).await,
            Err(refusal) => {
                tracing::warn!(reason = refusal.message(), "rejected an actor");
                Err(refusal)
            }
        },
        Ok(Ok(None) | Err(_)) => return,
        Err(_) => Err(Status::deadline_exceeded("hello: did not arrive in time")),
    };
    let _ = outbound.send(answer).await;
}

fn run_is_complete() -> v1::RolloutResponse {
    let drain = v1::Drain { reason: "the run is complete".to_owned(), finished: true };
    v1::RolloutResponse { message: Some(Response::Drain(drain)) }
}

/// Serves a connection whose hello has been read.
#[cfg(test)]
pub(crate) async fn serve_stream<S>(shared: Arc<Shared>, hello: v1::RolloutRequest, inbound: S, outbound: Outbound)
where
    S: Stream<Item = Result<v1::RolloutRequest, Status>> + Unpin,
{
    match handshake(&shared, "simulated".to_owned(), hello, &outbound) {
        Ok((registered, hello)) => Session::new(shared, registered, hello, outbound).serve(inbound).await,
        Err(refusal) => drop(outbound.send(Err(refusal)).await),
    }
}

/// Checks the hello and registers the session: its id, and the signals that end it.
fn handshake(
    shared: &Shared,
    address: String,
    first: v1::RolloutRequest,
    outbound: &Outbound,
) -> Result<((SessionId, Signals), v1::Hello), Status> {
    let Some(Request::Hello(hello)) = first.message else {
        return Err(status::invalid_argument("hello", "must be the first message"));
    };
    if hello.protocol_version != PROTOCOL_VERSION {
        return Err(status::failed_precondition(format!(
            "protocol_version: actor speaks protocol {}, learner speaks protocol {PROTOCOL_VERSION}; use the same release on both sides",
            hello.protocol_version
        )));
    }
    let own = &shared.run.task_fingerprint;
    if !hello.task_fingerprint.is_empty() && hello.task_fingerprint != *own {
        return Err(status::failed_precondition(format!(
            "task_fingerprint: actor requires task {}, learner runs task {own}; start the actor with the run's \
             configuration, or without one to accept the learner's",
            hello.task_fingerprint
        )));
    }
    let (replaced, eviction) = (CancellationToken::new(), watch::Sender::new(None));
    let signals = Signals { replaced: replaced.clone(), eviction: eviction.subscribe() };
    let id = shared.roster.join(ActorEntry {
        status: v1::ActorStatus {
            actor_id: hello.actor_id.clone(),
            address,
            threads: hello.threads,
            ..Default::default()
        },
        process_id: hello.process_id,
        last_seen: Instant::now(),
        replaced,
        eviction,
        has_room: false,
        hand_backs: 0,
        outbound: outbound.downgrade(),
    })?;
    Ok(((id, signals), hello))
}

/// How the rest of the service ends a session.
#[derive(Clone)]
struct Signals {
    /// Another session of the process replaces this one.
    replaced: CancellationToken,
    /// The actor is evicted, for this reason.
    eviction: watch::Receiver<Option<String>>,
}

struct GrantedLease {
    since: Instant,
    /// Whether the log says that it is late.
    stalled: bool,
    /// From the grant to the verdict on its result.
    span: Span,
}

struct Session {
    shared: Arc<Shared>,
    id: SessionId,
    actor_id: Arc<str>,
    process_id: u64,
    signals: Signals,
    outbound: Outbound,
    credit: usize,
    assembler: Assembler,
    /// Lease whose result is being assembled.
    assembling: Option<LeaseId>,
    /// Leases without a result.
    granted: HashMap<LeaseId, GrantedLease>,
    rejected: u32,
    /// Shards that failed for good, in a row.
    failed: u32,
    damaged: u32,
    /// Leases given back in a row.
    hand_backs: u32,
    /// When an actor that gives leases back gets the next one.
    probe: Option<Instant>,
    last_seen: Instant,
}

impl Session {
    fn new(shared: Arc<Shared>, (id, signals): (SessionId, Signals), hello: v1::Hello, outbound: Outbound) -> Self {
        tracing::info!(actor = hello.actor_id, threads = hello.threads, "actor joined");
        let assembler = Assembler::new(shared.limits.max_result_bytes());
        let last_seen = Instant::now();
        Self {
            shared,
            id,
            actor_id: hello.actor_id.into(),
            process_id: hello.process_id,
            signals,
            outbound,
            credit: 0,
            assembler,
            assembling: None,
            granted: HashMap::new(),
            rejected: 0,
            failed: 0,
            damaged: 0,
            hand_backs: 0,
            probe: None,
            last_seen,
        }
    }

    async fn serve<S>(mut self, inbound: S)
    where
        S: Stream<Item = Result<v1::RolloutRequest, Status>> + Unpin,
    {
        let end = self.run_loop(inbound).await;
        let lost = self.shared.remove_session(self.id);
        self.shared.metrics.session_ended(end.name());
        if !matches!(end, SessionEnd::Closing) {
            self.shared.roster.mark_missing(&self.actor_id);
        }
        let (actor, rejected) = (&*self.actor_id, self.rejected);
        match end {
            SessionEnd::Left => tracing::info!(actor, lost, "actor left"),
            SessionEnd::Silent => {
                tracing::warn!(actor, lost, rejected, "actor fell silent; its leases return to the queue");
                let problem =
                    format!("no message for {:?}; the leases returned to the queue", self.shared.lease_time());
                let _ = self.outbound.try_send(Err(Status::deadline_exceeded(problem)));
            }
            SessionEnd::Replaced => tracing::info!(actor, lost, "actor reconnected"),
            SessionEnd::Closing if self.shared.status.finished() => {
                let _ = self.outbound.try_send(Ok(run_is_complete()));
            }
            SessionEnd::Closing => {
                let reason = self.shared.control.stop_requested().map_or_else(String::new, |reason| reason.to_string());
                let drain = Response::Drain(v1::Drain { reason, finished: false });
                let _ = self.outbound.try_send(Ok(v1::RolloutResponse { message: Some(drain) }));
            }
            SessionEnd::Refused(refusal) => {
                tracing::warn!(actor, lost, reason = refusal.message(), "ended an actor's session");
                let _ = self.outbound.try_send(Err(refusal));
            }
        }
    }

    async fn run_loop<S>(&mut self, mut inbound: S) -> SessionEnd
    where
        S: Stream<Item = Result<v1::RolloutRequest, Status>> + Unpin,
    {
        let wakeups = self.shared.work.lease_wakeups();
        let (closing, complete) = (self.shared.control.closing.clone(), self.shared.control.complete.clone());
        let (Signals { replaced, mut eviction }, outbound) = (self.signals.clone(), self.outbound.clone());
        if let Err(end) = self.send(self.welcome()).await {
            return end;
        }
        loop {
            // Made before the grant, so that shards queued after it wake this loop.
            let offered = wakeups.notified();
            if let Err(end) = self.grant_leases().await {
                return end;
            }
            self.complain_of_stalls();
            let deadline = self.last_seen + self.shared.lease_time();
            let next_grant = self.next_grant();
            // In this order: a message that has arrived counts before the deadline, however late it is read.
            tokio::select! {
                biased;
                () = closing.cancelled() => return SessionEnd::Closing,
                () = complete.cancelled() => return SessionEnd::Closing,
                () = replaced.cancelled() => return SessionEnd::Replaced,
                reason = reason_of(&mut eviction) => {
                    return SessionEnd::Refused(status::invalid_argument("result", reason));
                }
                message = inbound.next() => {
                    self.mark_seen();
                    let handled = match message {
                        Some(Ok(v1::RolloutRequest { message: Some(message) })) => self.on_message(message).await,
                        Some(Ok(_)) => Err(SessionEnd::Refused(status::invalid_argument("message", "not set or unknown"))),
                        None | Some(Err(_)) => Err(SessionEnd::Left),
                    };
                    if let Err(end) = handled {
                        return end;
                    }
                    // The time spent on this message is not silence of the actor.
                    self.mark_seen();
                }
                () = offered, if self.credit > 0 => {}
                () = outbound.closed() => return SessionEnd::Left,
                () = until(next_grant) => {}
                () = tokio::time::sleep_until(deadline) => return SessionEnd::Silent,
            }
        }
    }

    fn welcome(&self) -> Response {
        let run = &self.shared.run;
        Response::Welcome(v1::Welcome {
            run_id: run.run_id.0.clone(),
            protocol_version: PROTOCOL_VERSION,
            task_fingerprint: run.task_fingerprint.clone(),
            run_config_toml: run.run_config_toml.clone(),
            lease_seconds: run.lease.as_secs_f64(),
            seed: run.seed,
        })
    }

    fn mark_seen(&mut self) {
        self.last_seen = Instant::now();
        let (has_room, hand_backs) = (self.credit > 0 && self.probe.is_none(), self.hand_backs);
        self.shared.roster.update(self.id, |actor| {
            (actor.last_seen, actor.has_room, actor.hand_backs) = (self.last_seen, has_room, hand_backs);
        });
    }

    /// Names a lease once that is out for much longer than usual.
    fn complain_of_stalls(&mut self) {
        let Some(oldest) = self.shared.work.inspect(|ledger| {
            let oldest = ledger.oldest_of(self.id)?;
            (oldest.since.elapsed() >= ledger.stalled(oldest.shard.kind)).then_some(oldest)
        }) else {
            return;
        };
        let granted = self.granted.values_mut().filter(|granted| granted.since == oldest.since && !granted.stalled);
        if let Some(granted) = granted.min_by_key(|granted| granted.since) {
            granted.stalled = true;
            tracing::warn!(
                actor = &*self.actor_id,
                shard = describe(&oldest.shard),
                held_s = oldest.since.elapsed().as_secs_f64(),
                "an actor holds a shard for much longer than usual; idle actors compute it meanwhile"
            );
        }
    }

    /// Leases that the actor may hold now.
    fn limit(&self, now: Instant) -> usize {
        match self.probe {
            Some(probe) if now < probe => 0,
            _ if self.hand_backs > 0 => 1,
            _ => MAX_LEASES,
        }
    }

    /// When it is worth asking the ledger again although nothing wakes this session.
    fn next_grant(&self) -> Option<Instant> {
        let now = Instant::now();
        if self.credit == 0 || self.granted.len() >= self.limit(now).max(1) {
            return None;
        }
        if let Some(probe) = self.probe.filter(|probe| now < *probe) {
            return Some(probe);
        }
        let late = self.shared.work.inspect(|ledger| ledger.next_late(self.process_id));
        late.map(|late| late.max(now + LATE_PERIOD / 10).min(now + LATE_PERIOD))
    }

    /// Sends a message. An actor that reads nothing for the time of a lease counts as silent.
    async fn send(&self, message: Response) -> Result<(), SessionEnd> {
        let message = Ok(v1::RolloutResponse { message: Some(message) });
        match self.outbound.send_timeout(message, self.shared.lease_time()).await {
            Ok(()) => Ok(()),
            Err(mpsc::error::SendTimeoutError::Timeout(_)) => Err(SessionEnd::Silent),
            Err(mpsc::error::SendTimeoutError::Closed(_)) => Err(SessionEnd::Left),
        }
    }

    async fn grant_leases(&mut self) -> Result<(), SessionEnd> {
        while self.credit > 0 && self.granted.len() < self.limit(Instant::now()) {
            let asker = Asker { session: self.id, process: self.process_id, now: Instant::now() };
            let others = || self.shared.roster.with_room(self.process_id);
            let Some(lease) = self.shared.work.with_ledger(|ledger| ledger.lease(asker, others)) else { break };
            self.credit -= 1;
            let weights_sha256 = self.shared.board.sha256(lease.shard.version).unwrap_or_default();
            let span = self.shared.work.lease_span(&lease, &self.actor_id);
            let traceparent = trace::traceparent(&span);
            self.granted.insert(lease.id, GrantedLease { since: asker.now, stalled: false, span });
            let shard = Some((&lease.shard).into());
            self.send(Response::Lease(v1::Lease { lease_id: lease.id.0, shard, weights_sha256, traceparent })).await?;
            if self.credit == 0 {
                self.shared.roster.update(self.id, |actor| actor.has_room = false);
            }
        }
        Ok(())
    }

    async fn on_message(&mut self, message: Request) -> Result<(), SessionEnd> {
        match message {
            Request::Hello(_) => Err(SessionEnd::Refused(status::invalid_argument("hello", "must be sent once"))),
            Request::Ready(ready) => {
                self.credit = self.credit.saturating_add(ready.credit as usize).min(MAX_LEASES);
                Ok(())
            }
            Request::Heartbeat(_) => Ok(()),
            Request::Failed(failed) => self.on_failed(&failed),
            Request::Part(part) => self.on_part(part).await,
        }
    }
}

/// Why the actor is evicted, once it is.
async fn reason_of(eviction: &mut watch::Receiver<Option<String>>) -> String {
    let reason = eviction.wait_for(Option::is_some).await.ok().and_then(|reason| reason.clone());
    match reason {
        Some(reason) => reason,
        // The roster has forgotten the session, which ends by itself.
        None => std::future::pending().await,
    }
}

async fn until(time: Option<Instant>) {
    match time {
        Some(time) => tokio::time::sleep_until(time).await,
        None => std::future::pending().await,
    }
}

#[cfg(test)]
mod tests;
