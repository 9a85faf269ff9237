//! The first message of a connection: the hello of an actor.

use super::{Outbound, Session};
use crate::serve::ledger::SessionId;
use crate::serve::roster::ActorEntry;
use crate::serve::shared::Shared;
use magex_proto::v1::rollout_request::Message as Request;
use magex_proto::v1::rollout_response::Message as Response;
use magex_proto::{PROTOCOL_VERSION, v1};
use magex_runtime::status;
use std::sync::Arc;
use std::time::Instant;
use tokio_util::sync::CancellationToken;
use tonic::{Status, Streaming};

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
    let refusal = match first {
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
    let _ = outbound.send(refusal).await;
}

pub(super) fn run_is_complete() -> v1::RolloutResponse {
    let drain = v1::Drain { reason: "the run is complete".to_owned(), finished: true };
    v1::RolloutResponse { message: Some(Response::Drain(drain)) }
}

/// Checks the hello and registers the session: its id, and the signal that another session of the process replaces it.
pub(super) fn handshake(
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
            "task_fingerprint: actor requires task {}, learner runs task {own}; start the actor with the run's \
             configuration, or without one to accept the learner's",
            hello.task_fingerprint
        )));
    }
    let replaced = CancellationToken::new();
    let id = shared.roster.join(ActorEntry {
        actor_id: hello.actor_id.clone(),
        process_id: hello.process_id,
        address,
        threads: hello.threads,
        shards_done: 0,
        weights_version: None,
        last_seen: Instant::now(),
        replaced: replaced.clone(),
        outbound: outbound.downgrade(),
    })?;
    Ok(((id, replaced), hello))
}
