//! One connection of one actor: hands out leases as credit allows, takes in results, notices silence.

use crate::ingest::{admit, describe};
use crate::ledger::{LeaseId, SessionId, Verdict};
use crate::state::{ActorEntry, Shared, lock};
use bytes::Bytes;
use magex_core::trajectory::ShardResult;
use magex_proto::convert::ConvertError;
use magex_proto::parts::Assembler;
use magex_proto::v1::rollout_request::Message as Request;
use magex_proto::v1::rollout_response::Message as Response;
use magex_proto::{PROTOCOL_VERSION, v1};
use magex_runtime::status;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tonic::{Status, Streaming};

/// What the learner says to an actor.
pub(crate) type Outbound = mpsc::Sender<Result<v1::RolloutResponse, Status>>;

/// Leases that an actor may hold, whatever credit it claims.
const MAX_LEASES: usize = 1024;

/// Unusable results after which an actor is sent away.
const MAX_REJECTED: u32 = 3;

/// Results longer than this are decoded away from the threads that serve the network.
const DECODE_INLINE: usize = 32 << 10;

/// How a connection ends.
#[derive(Debug)]
enum End {
    /// The actor closed it, or the network did.
    Left,
    /// The actor said nothing for the time of a lease.
    Silent,
    /// The same process connected again.
    Replaced,
    /// The learner stops.
    Closing,
    /// The learner sends the actor away.
    Refused(Status),
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
    let session = match greet(&shared, address, hello) {
        Ok((session, hello)) => Session::new(shared, session, hello, outbound),
        Err(refusal) => {
            tracing::warn!(reason = refusal.message(), "refused an actor");
            let _ = outbound.send(Err(refusal)).await;
            return;
        }
    };
    session.serve(inbound).await;
}

/// Checks the actor's introduction and puts it on the list.
fn greet(
    shared: &Shared,
    address: String,
    first: v1::RolloutRequest,
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
            last_seen: Instant::now(),
            replaced: replaced.clone(),
        },
    );
    Ok(((id, replaced), hello))
}

struct Session {
    shared: Arc<Shared>,
    id: SessionId,
    actor_id: String,
    replaced: CancellationToken,
    outbound: Outbound,
    credit: usize,
    assembler: Assembler,
    /// Lease whose result is being put together.
    assembling: Option<LeaseId>,
    rejected: u32,
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
        let (actor_id, assembling, credit, rejected) = (hello.actor_id, None, 0, 0);
        Self { shared, id, actor_id, replaced, outbound, credit, assembler, assembling, rejected, last_heard }
    }

    async fn serve(mut self, inbound: Streaming<v1::RolloutRequest>) {
        let end = self.talk(inbound).await;
        let lost = self.shared.with_ledger(|ledger| ledger.drop_actor(self.id));
        lock(&self.shared.actors).remove(&self.id);
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
            End::Closing => {
                let finished = self.shared.finished();
                let reason = self.shared.stop_requested().map_or_else(String::new, |reason| reason.to_string());
                let reason = if finished { "the run is complete".to_owned() } else { reason };
                let drain = v1::RolloutResponse { message: Some(Response::Drain(v1::Drain { reason, finished })) };
                let _ = self.outbound.try_send(Ok(drain));
            }
            End::Refused(refusal) => {
                tracing::warn!(actor, lost, reason = refusal.message(), "sent an actor away");
                let _ = self.outbound.try_send(Err(refusal));
            }
        }
    }

    async fn talk(&mut self, mut inbound: Streaming<v1::RolloutRequest>) -> End {
        // Before the first look at the queue, so that nothing queued later goes unseen.
        let mut work = self.shared.work();
        let closing = self.shared.closing.clone();
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
            tokio::select! {
                message = inbound.message() => {
                    self.heard();
                    let heard = match message {
                        Ok(Some(v1::RolloutRequest { message: Some(message) })) => self.hear(message).await,
                        Ok(Some(_)) => Err(End::Refused(status::invalid_argument("message", "not set or unknown"))),
                        Ok(None) | Err(_) => Err(End::Left),
                    };
                    if let Err(end) = heard {
                        return end;
                    }
                }
                changed = work.changed(), if self.credit > 0 => if changed.is_err() { return End::Closing },
                () = tokio::time::sleep_until(deadline) => return End::Silent,
                () = closing.cancelled() => return End::Closing,
                () = replaced.cancelled() => return End::Replaced,
                () = outbound.closed() => return End::Left,
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
        while self.credit > 0 {
            let Some(lease) = self.shared.with_ledger(|ledger| ledger.lease(self.id)) else { break };
            self.credit -= 1;
            let weights_sha256 = self.shared.board.sha256(lease.shard.version).unwrap_or_default();
            let shard = Some((&lease.shard).into());
            self.say(Response::Lease(v1::Lease { lease_id: lease.id.0, shard, weights_sha256 })).await?;
        }
        Ok(())
    }

    async fn hear(&mut self, message: Request) -> Result<(), End> {
        match message {
            Request::Hello(_) => Err(End::Refused(status::invalid_argument("hello", "said twice"))),
            Request::Ready(ready) => {
                self.credit = (self.credit + ready.credit as usize).min(MAX_LEASES);
                Ok(())
            }
            Request::Heartbeat(_) => Ok(()),
            Request::Failed(failed) => {
                let lease = LeaseId(failed.lease_id);
                tracing::warn!(actor = self.actor_id, reason = failed.reason, "actor gave a lease back");
                self.shared.with_ledger(|ledger| ledger.fail(self.id, lease, &failed.reason, failed.retryable));
                Ok(())
            }
            Request::Part(part) => self.take_part(part).await,
        }
    }

    async fn take_part(&mut self, message: v1::ResultPart) -> Result<(), End> {
        let lease = LeaseId(message.lease_id);
        let Some(part) = message.part else {
            return Err(End::Refused(status::invalid_argument("part", "missing")));
        };
        if part.index == 0 {
            self.assembling = Some(lease);
        } else if self.assembling != Some(lease) {
            // The rest of a result that was refused already.
            return Ok(());
        }
        match self.assembler.push(part) {
            Ok(None) => Ok(()),
            Ok(Some(bytes)) => {
                self.assembling = None;
                self.settle(lease, bytes).await
            }
            Err(error) => {
                self.assembling = None;
                self.reject(lease, format!("part.{error}")).await
            }
        }
    }

    /// Checks a whole result and tells the actor what became of it.
    async fn settle(&mut self, lease: LeaseId, bytes: Bytes) -> Result<(), End> {
        let result = match self.admit(bytes).await {
            Ok(result) => result,
            Err(error) => return self.reject(lease, error.to_string()).await,
        };
        let shard = *result.shard();
        match self.shared.with_ledger(|ledger| ledger.complete(self.id, lease, result)) {
            Verdict::Accepted => {
                if let Some(actor) = lock(&self.shared.actors).get_mut(&self.id) {
                    actor.shards_done += 1;
                }
                self.acknowledge(lease, v1::Verdict::Accepted, String::new()).await
            }
            Verdict::Duplicate => {
                tracing::debug!(actor = self.actor_id, shard = describe(&shard), "dropped a duplicate");
                self.acknowledge(lease, v1::Verdict::Duplicate, String::new()).await
            }
            Verdict::Rejected(reason) => self.turn_away(lease, reason).await,
        }
    }

    async fn admit(&self, bytes: Bytes) -> Result<ShardResult, ConvertError> {
        let shared = self.shared.clone();
        let short = bytes.len() <= DECODE_INLINE;
        let check = move || admit(&shared.limits, &shared.run.run_id, bytes);
        let delivery = if short {
            check()?
        } else {
            let gone = |_| ConvertError::new("result", "the learner stops");
            tokio::task::spawn_blocking(check).await.map_err(gone)??
        };
        let version = delivery.result.shard().version;
        match self.shared.board.sha256(version) {
            Some(own) if own != delivery.weights_sha256 => {
                let theirs = &delivery.weights_sha256;
                let problem = format!("actor used {theirs} as version {version}, learner published {own}");
                Err(ConvertError::new("weights_sha256", problem))
            }
            _ => Ok(delivery.result),
        }
    }

    async fn reject(&mut self, lease: LeaseId, reason: String) -> Result<(), End> {
        self.shared.with_ledger(|ledger| ledger.reject(self.id, lease));
        self.turn_away(lease, reason).await
    }

    async fn turn_away(&mut self, lease: LeaseId, reason: String) -> Result<(), End> {
        self.rejected += 1;
        tracing::warn!(actor = self.actor_id, reason, "rejected a result; the shard will be done again");
        self.acknowledge(lease, v1::Verdict::Rejected, reason.clone()).await?;
        if self.rejected < MAX_REJECTED {
            return Ok(());
        }
        let (field, problem) = reason.split_once(": ").unwrap_or(("result", &reason));
        let problem = format!("{problem} ({MAX_REJECTED} results of this actor were not usable)");
        Err(End::Refused(status::invalid_argument(field, problem)))
    }

    async fn acknowledge(&self, lease: LeaseId, verdict: v1::Verdict, reason: String) -> Result<(), End> {
        self.say(Response::Ack(v1::Ack { lease_id: lease.0, verdict: verdict.into(), reason })).await
    }
}
