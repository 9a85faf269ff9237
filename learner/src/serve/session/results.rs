//! The end of a lease: its result arrives, or the actor returns it without one.

use super::{PROBE, Session, SessionEnd};
use crate::origin::Origin;
use crate::run_events::describe;
use crate::serve::ledger::{LeaseId, MAX_FAILURES, ShardFailure};
use crate::serve::metrics::{Rejection, steps_of};
use crate::serve::validate::validate;
use bytes::Bytes;
use magex_core::error::FieldError;
use magex_core::ids::ShardKind;
use magex_core::trajectory::ShardResult;
use magex_proto::v1;
use magex_proto::v1::rollout_response::Message as Response;
use magex_runtime::{status, trace};
use std::time::Duration;
use tokio::time::Instant;
use tonic::Status;
use tracing::{Instrument as _, Span};

/// Invalid results after which an actor is evicted, and damaged results after which it must reconnect.
const MAX_REJECTED: u32 = 3;

/// Longer results are decoded on a blocking thread, bytes.
const DECODE_INLINE: usize = 32 << 10;

/// Limit of the characters of an actor's own message that are quoted to it.
const MAX_QUOTED: usize = 200;

impl Session {
    /// The actor returns a lease. An actor at which every shard fails is evicted if other actors are connected. The last actor
    /// stays, so that a shard that fails at every actor ends the run with its reason.
    pub(super) fn on_failed(&mut self, failed: &v1::Failed) -> Result<(), SessionEnd> {
        let lease = LeaseId(failed.lease_id);
        let (reason, retryable) = (failed.reason.as_str(), failed.retryable);
        if self.hand_backs < 2 {
            tracing::warn!(actor = &*self.actor_id, reason, retryable, "actor returned a lease");
        } else {
            tracing::debug!(actor = &*self.actor_id, reason, retryable, "actor returned a lease");
        }
        self.granted.remove(&lease);
        if retryable {
            if self.shared.work.with_ledger(|ledger| ledger.give_back(self.id, lease)) {
                self.on_hand_back(reason);
            }
            return Ok(());
        }
        let connected = self.shared.roster.connected_processes();
        let failure = ShardFailure { actor: &self.actor_id, process: self.process_id, reason, connected: &connected };
        if !self.shared.work.with_ledger(|ledger| ledger.fail(self.id, lease, &failure)) {
            return Ok(());
        }
        self.failed += 1;
        if self.failed < MAX_FAILURES || !self.shared.roster.evict_if_others_remain(self.process_id) {
            return Ok(());
        }
        let quoted: String = reason.chars().take(MAX_QUOTED).collect();
        let problem = format!("{quoted} ({} shards in a row failed at this actor)", self.failed);
        Err(SessionEnd::Refused(status::invalid_argument("failed", problem)))
    }

    /// An actor that gives its leases back computes nothing, but each of them costs the others time.
    fn on_hand_back(&mut self, reason: &str) {
        self.hand_backs = self.hand_backs.saturating_add(1);
        if self.hand_backs < 2 {
            return;
        }
        let pause = PROBE.min(self.shared.lease_time());
        self.probe = Some(Instant::now() + pause);
        if self.hand_backs == 2 {
            tracing::warn!(
                actor = &*self.actor_id,
                reason,
                pause_s = pause.as_secs_f64(),
                "an actor gives its leases back; it gets one at a time, after a pause, until it delivers"
            );
        }
    }

    /// The actor has delivered.
    fn on_delivery(&mut self) {
        self.failed = 0;
        if self.hand_backs >= 2 {
            tracing::info!(actor = &*self.actor_id, given_back = self.hand_backs, "an actor delivers again");
        }
        (self.hand_backs, self.probe) = (0, None);
    }

    pub(super) async fn on_part(&mut self, message: v1::ResultPart) -> Result<(), SessionEnd> {
        let lease = LeaseId(message.lease_id);
        let missing = || SessionEnd::Refused(status::invalid_argument("part", "missing"));
        let part = message.part.ok_or_else(missing)?;
        self.shared.metrics.received_bytes.inc_by(part.data.len() as u64);
        if part.index == 0 {
            self.assembling = Some(lease);
        } else if self.assembling != Some(lease) {
            // The rest of a result that was rejected already.
            return Ok(());
        }
        match self.assembler.push(part) {
            Ok(None) => Ok(()),
            Ok(Some(bytes)) => {
                self.assembling = None;
                self.on_result(lease, bytes, message.timing).await
            }
            Err(error) => {
                self.assembling = None;
                self.on_damaged(lease, format!("part.{error}")).await
            }
        }
    }

    async fn on_result(
        &mut self,
        lease: LeaseId,
        bytes: Bytes,
        timing: Option<v1::ShardTiming>,
    ) -> Result<(), SessionEnd> {
        let granted = self.granted.remove(&lease);
        let span = granted.as_ref().map_or_else(
            Span::none,
            |granted| tracing::info_span!(target: trace::TARGET, parent: &granted.span, "ingest", bytes = bytes.len()),
        );
        let (result, origin) = match self.validate(bytes).instrument(span.clone()).await {
            Ok(Some(valid)) => valid,
            Ok(None) => {
                // Made with weights that the run has gone back on.
                self.shared.work.with_ledger(|ledger| ledger.withdraw(self.id, lease));
                return self.acknowledge(lease, v1::Verdict::Duplicate, String::new()).await;
            }
            Err(error) => {
                self.shared.work.with_ledger(|ledger| ledger.reject(self.id, lease));
                return self.reject(lease, error).await;
            }
        };
        let (shard, steps) = (*result.shard(), steps_of(&result));
        // The ledger and the timing change under one lock, because the last result of a plan wakes the training thread, which
        // reads both.
        let verdict = self.shared.work.update(|open| {
            let now = Instant::now();
            let verdict = open.ledger.complete(self.id, lease, result, (origin, now));
            if verdict == Ok(v1::Verdict::Accepted) {
                // The grant of a lease of an earlier session is unknown, and so is its duration.
                let since_grant = granted.as_ref().map_or(Duration::ZERO, |granted| now - granted.since);
                let reported = timing.filter(|_| granted.is_some());
                open.timing.result_accepted(shard.kind == ShardKind::Train, since_grant, reported, now.into_std());
                self.shared.status.progressed();
                self.shared.metrics.accepted(steps);
            }
            verdict
        });
        let verdict = match verdict {
            Ok(verdict) => verdict,
            Err(error) => return self.reject(lease, error).await,
        };
        self.on_delivery();
        if verdict == v1::Verdict::Accepted {
            self.shared.roster.update(self.id, |actor| {
                actor.status.shards_done += 1;
                actor.status.weights_version = Some(shard.version.0);
            });
        } else {
            tracing::debug!(actor = &*self.actor_id, shard = describe(&shard), "dropped a duplicate");
        }
        self.acknowledge(lease, verdict, String::new()).await
    }

    /// A valid result with its origin; `None` if it was made with weights that the run has gone back on.
    async fn validate(&self, bytes: Bytes) -> Result<Option<(ShardResult, Origin)>, FieldError> {
        let shared = self.shared.clone();
        let short = bytes.len() <= DECODE_INLINE;
        let check = move || {
            let digest = Origin::digest_of(&bytes);
            validate(&shared.limits, &shared.run.run_id, bytes).map(|delivery| (delivery, digest))
        };
        let (delivery, digest) = if short {
            check()
        } else {
            let stopping = || FieldError::new("result", "the learner is shutting down");
            let _permit = self.shared.decoders.acquire().await.map_err(|_| stopping())?;
            tokio::task::spawn_blocking(check).await.map_err(|_| stopping())?
        }?;
        let version = delivery.result.shard().version;
        match self.shared.board.sha256(version) {
            Some(own) if own != delivery.weights_sha256 => {
                if self.shared.board.is_withdrawn(&delivery.weights_sha256) {
                    return Ok(None);
                }
                let theirs = &delivery.weights_sha256;
                let problem = format!("actor used {theirs} as version {version}, learner published {own}");
                Err(FieldError::new("weights_sha256", problem))
            }
            _ => {
                let origin = Origin { actor: self.actor_id.clone(), process: self.process_id, digest };
                Ok(Some((delivery.result, origin)))
            }
        }
    }

    /// A result did not arrive as it was sent. The connection is at fault, not the actor, so the actor may reconnect.
    async fn on_damaged(&mut self, lease: LeaseId, reason: String) -> Result<(), SessionEnd> {
        self.granted.remove(&lease);
        self.shared.work.with_ledger(|ledger| ledger.reject(self.id, lease));
        self.damaged += 1;
        self.shared.metrics.rejected(Rejection::Damaged);
        tracing::warn!(actor = &*self.actor_id, reason, "a result arrived damaged; its shard is queued again");
        self.acknowledge(lease, v1::Verdict::Rejected, reason.clone()).await?;
        if self.damaged < MAX_REJECTED {
            return Ok(());
        }
        let problem = format!("{reason} ({MAX_REJECTED} results arrived damaged); reconnect");
        Err(SessionEnd::Refused(Status::data_loss(problem)))
    }

    async fn reject(&mut self, lease: LeaseId, error: FieldError) -> Result<(), SessionEnd> {
        self.rejected += 1;
        self.shared.metrics.rejected(Rejection::Receipt);
        tracing::warn!(actor = &*self.actor_id, reason = %error, "rejected a result; its shard is queued again");
        self.acknowledge(lease, v1::Verdict::Rejected, error.to_string()).await?;
        if self.rejected < MAX_REJECTED {
            return Ok(());
        }
        self.shared.roster.evict(self.process_id);
        let problem = format!("{} ({MAX_REJECTED} results of this actor were invalid)", error.problem);
        Err(SessionEnd::Refused(status::invalid_argument(error.field, problem)))
    }

    async fn acknowledge(&self, lease: LeaseId, verdict: v1::Verdict, reason: String) -> Result<(), SessionEnd> {
        self.send(Response::Ack(v1::Ack { lease_id: lease.0, verdict: verdict.into(), reason })).await
    }
}
