//! One connection of one actor: hands out leases as credit allows, takes in results, notices silence.

mod results;

use crate::serve::ledger::{Lease, LeaseId, SessionId};
use crate::serve::shared::{ActorEntry, Shared};
use magex_proto::parts::Assembler;
use magex_proto::v1::rollout_request::Message as Request;
use magex_proto::v1::rollout_response::Message as Response;
use magex_proto::{PROTOCOL_VERSION, v1};
use magex_runtime::sync::lock;
use magex_runtime::{status, trace};
use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::mpsc;
use tokio_stream::{Stream, StreamExt as _};
use tokio_util::sync::CancellationToken;
use tonic::{Status, Streaming};
use tracing::Span;

/// What the learner says to an actor.
pub(crate) type Outbound = mpsc::Sender<Result<v1::RolloutResponse, Status>>;

/// Leases that an actor may hold, and credit that it may have beside them, whatever it claims.
const MAX_LEASES: usize = 1024;

/// How a connection ends.
#[derive(Debug)]
enum End {
    /// The actor closed it, or the network did.
    Left,
    /// The actor said nothing for the time of a lease.
    Silent,
    /// The same process connected again.
    Replaced,
    /// The learner stops, or the run is complete.
    Closing,
    /// The learner sends the actor away.
    Refused(Status),
}

impl End {
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

/// Serves one connection from its first message to its end.
pub(crate) async fn run(
    shared: Arc<Shared>,
    address: String,
    mut inbound: Streaming<v1::RolloutRequest>,
    outbound: Outbound,
) {
    let hello = tokio::select! {
        () = shared.closing.cancelled() => return,
        hello = tokio::time::timeout(shared.lease_time(), inbound.message()) => match hello {
            Ok(Ok(Some(message))) => message,
            Ok(Ok(None) | Err(_)) => return,
            Err(_) => {
                let _ = outbound.send(Err(Status::deadline_exceeded("hello: did not come"))).await;
                return;
            }
        },
    };
    if shared.finished() {
        let _ = outbound.send(Ok(run_is_complete())).await;
        return;
    }
    let session = match greet(&shared, address, hello, &outbound) {
        Ok((session, hello)) => Session::new(shared, session, hello, outbound),
        Err(refusal) => {
            tracing::warn!(reason = refusal.message(), "refused an actor");
            let _ = outbound.send(Err(refusal)).await;
            return;
        }
    };
    session.serve(inbound).await;
}

fn run_is_complete() -> v1::RolloutResponse {
    let drain = v1::Drain { reason: "the run is complete".to_owned(), finished: true };
    v1::RolloutResponse { message: Some(Response::Drain(drain)) }
}

/// Checks the actor's introduction and puts it on the list.
fn greet(
    shared: &Shared,
    address: String,
    first: v1::RolloutRequest,
    outbound: &Outbound,
) -> Result<((SessionId, CancellationToken), v1::Hello), Status> {
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
            "task_fingerprint: actor insists on task {}, learner runs task {own}; start the actor with the run's \
             configuration, or without one to take the learner's",
            hello.task_fingerprint
        )));
    }
    if shared.was_sent_away(hello.incarnation) {
        return Err(status::failed_precondition(
            "incarnation: this process was sent away, for its results or for having none; find out why, then start the \
             actor anew",
        ));
    }
    let mut actors = lock(&shared.actors);
    for actor in actors.values().filter(|actor| actor.incarnation == hello.incarnation) {
        actor.replaced.cancel();
    }
    let standing = actors.values().filter(|actor| !actor.replaced.is_cancelled()).count();
    if standing >= shared.limits.max_actors {
        let limit = shared.limits.max_actors;
        return Err(status::resource_exhausted(
            format!("actors: all {limit} places are taken"),
            Duration::from_secs(5),
        ));
    }
    let replaced = CancellationToken::new();
    let id = SessionId(shared.next_session());
    actors.insert(
        id,
        ActorEntry {
            actor_id: hello.actor_id.clone(),
            incarnation: hello.incarnation,
            address,
            threads: hello.threads,
            shards_done: 0,
            weights_version: None,
            last_seen: Instant::now(),
            replaced: replaced.clone(),
            outbound: outbound.downgrade(),
        },
    );
    drop(actors);
    shared.found(&hello.actor_id);
    Ok(((id, replaced), hello))
}

/// A lease that was handed out here.
struct Handed {
    since: Instant,
    /// From the lease to what became of its result.
    span: Span,
}

struct Session {
    shared: Arc<Shared>,
    id: SessionId,
    actor_id: String,
    incarnation: u64,
    replaced: CancellationToken,
    outbound: Outbound,
    credit: usize,
    assembler: Assembler,
    /// Lease whose result is being put together.
    assembling: Option<LeaseId>,
    /// Leases that wait for a result.
    handed: HashMap<LeaseId, Handed>,
    rejected: u32,
    /// Shards in a row that it could never do.
    failed: u32,
    /// Results that were damaged on their way.
    damaged: u32,
    last_heard: Instant,
}

impl Session {
    fn new(
        shared: Arc<Shared>,
        (id, replaced): (SessionId, CancellationToken),
        hello: v1::Hello,
        outbound: Outbound,
    ) -> Self {
        tracing::info!(actor = hello.actor_id, threads = hello.threads, "actor joined");
        let assembler = Assembler::new(shared.limits.max_result_bytes());
        let last_heard = Instant::now();
        Self {
            shared,
            id,
            actor_id: hello.actor_id,
            incarnation: hello.incarnation,
            replaced,
            outbound,
            credit: 0,
            assembler,
            assembling: None,
            handed: HashMap::new(),
            rejected: 0,
            failed: 0,
            damaged: 0,
            last_heard,
        }
    }

    async fn serve(mut self, inbound: Streaming<v1::RolloutRequest>) {
        let end = self.talk(inbound).await;
        let lost = self.shared.with_ledger(|ledger| ledger.drop_actor(self.id));
        self.shared.left(self.id);
        self.shared.gauges.session_ended(end.name());
        if !matches!(end, End::Closing) {
            self.shared.miss(&self.actor_id);
        }
        let (actor, rejected) = (&self.actor_id, self.rejected);
        match end {
            End::Left => tracing::info!(actor, lost, "actor left"),
            End::Silent => {
                tracing::warn!(actor, lost, rejected, "actor fell silent; its leases go to others");
                let problem =
                    format!("nothing heard for {:?}; the leases are given to others", self.shared.lease_time());
                let _ = self.outbound.try_send(Err(Status::deadline_exceeded(problem)));
            }
            End::Replaced => tracing::info!(actor, lost, "actor connected again"),
            End::Closing if self.shared.finished() => {
                let _ = self.outbound.try_send(Ok(run_is_complete()));
            }
            End::Closing => {
                let reason = self.shared.stop_requested().map_or_else(String::new, |reason| reason.to_string());
                let drain = Response::Drain(v1::Drain { reason, finished: false });
                let _ = self.outbound.try_send(Ok(v1::RolloutResponse { message: Some(drain) }));
            }
            End::Refused(refusal) => {
                tracing::warn!(actor, lost, reason = refusal.message(), "sent an actor away");
                let _ = self.outbound.try_send(Err(refusal));
            }
        }
    }

    async fn talk<S>(&mut self, mut inbound: S) -> End
    where
        S: Stream<Item = Result<v1::RolloutRequest, Status>> + Unpin,
    {
        // Before the first look at the queue, so that nothing queued later goes unseen.
        let mut work = self.shared.work();
        let (closing, complete) = (self.shared.closing.clone(), self.shared.complete.clone());
        let (replaced, outbound) = (self.replaced.clone(), self.outbound.clone());
        if let Err(end) = self.say(self.welcome()).await {
            return end;
        }
        loop {
            work.borrow_and_update();
            if let Err(end) = self.hand_out().await {
                return end;
            }
            let deadline = tokio::time::Instant::from_std(self.last_heard + self.shared.lease_time());
            // In this order: who has said something is not silent, however late it is read.
            tokio::select! {
                biased;
                () = closing.cancelled() => return End::Closing,
                () = complete.cancelled() => return End::Closing,
                () = replaced.cancelled() => return End::Replaced,
                message = inbound.next() => {
                    self.heard();
                    let heard = match message {
                        Some(Ok(v1::RolloutRequest { message: Some(message) })) => self.hear(message).await,
                        Some(Ok(_)) => Err(End::Refused(status::invalid_argument("message", "not set or unknown"))),
                        None | Some(Err(_)) => Err(End::Left),
                    };
                    if let Err(end) = heard {
                        return end;
                    }
                    // The time that a long result took here is not the actor's silence.
                    self.heard();
                }
                changed = work.changed(), if self.credit > 0 => if changed.is_err() { return End::Closing },
                () = outbound.closed() => return End::Left,
                () = tokio::time::sleep_until(deadline) => return End::Silent,
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

    fn heard(&mut self) {
        self.last_heard = Instant::now();
        if let Some(actor) = lock(&self.shared.actors).get_mut(&self.id) {
            actor.last_seen = self.last_heard;
        }
    }

    /// Says something; an actor that does not listen for the time of a lease is as good as gone.
    async fn say(&self, message: Response) -> Result<(), End> {
        let message = Ok(v1::RolloutResponse { message: Some(message) });
        match self.outbound.send_timeout(message, self.shared.lease_time()).await {
            Ok(()) => Ok(()),
            Err(mpsc::error::SendTimeoutError::Timeout(_)) => Err(End::Silent),
            Err(mpsc::error::SendTimeoutError::Closed(_)) => Err(End::Left),
        }
    }

    /// Leases out what there is, as far as the credit goes.
    async fn hand_out(&mut self) -> Result<(), End> {
        while self.credit > 0 && self.handed.len() < MAX_LEASES {
            let Some(lease) = self.shared.with_ledger(|ledger| ledger.lease(self.id)) else { break };
            self.credit -= 1;
            let weights_sha256 = self.shared.board.sha256(lease.shard.version).unwrap_or_default();
            let span = self.lease_span(&lease);
            let traceparent = trace::traceparent(&span);
            self.handed.insert(lease.id, Handed { since: Instant::now(), span });
            let shard = Some((&lease.shard).into());
            self.say(Response::Lease(v1::Lease { lease_id: lease.id.0, shard, weights_sha256, traceparent })).await?;
        }
        Ok(())
    }

    fn lease_span(&self, lease: &Lease) -> Span {
        let (iteration, index, actor) = (lease.shard.iteration.0, lease.shard.index, self.actor_id.as_str());
        let parent = lock(&self.shared.trace);
        tracing::info_span!(target: trace::TARGET, parent: &*parent, "lease", iteration, index, actor)
    }

    async fn hear(&mut self, message: Request) -> Result<(), End> {
        match message {
            Request::Hello(_) => Err(End::Refused(status::invalid_argument("hello", "said twice"))),
            Request::Ready(ready) => {
                self.credit = self.credit.saturating_add(ready.credit as usize).min(MAX_LEASES);
                Ok(())
            }
            Request::Heartbeat(_) => Ok(()),
            Request::Failed(failed) => self.take_back(&failed),
            Request::Part(part) => self.take_part(part).await,
        }
    }
}

#[cfg(test)]
mod tests;
