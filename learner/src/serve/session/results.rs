//! What becomes of a lease: its result is taken in, or it comes back without one.

use super::{End, Handed, Session};
use crate::serve::ledger::{Failure, LeaseId, Ledger, MAX_FAILURES, Verdict};
use crate::serve::metrics::steps_of;
use crate::serve::validate::{admit, describe};
use bytes::Bytes;
use magex_core::ids::ShardKind;
use magex_core::trajectory::ShardResult;
use magex_proto::convert::ConvertError;
use magex_proto::v1;
use magex_proto::v1::rollout_response::Message as Response;
use magex_runtime::sync::lock;
use magex_runtime::{status, trace};
use std::time::{Duration, Instant};
use tonic::Status;
use tracing::{Instrument as _, Span};

/// Unusable results after which an actor is sent away, and damaged ones after which it is to connect again.
const MAX_REJECTED: u32 = 3;

/// Results longer than this are decoded away from the threads that serve the network.
const DECODE_INLINE: usize = 32 << 10;

/// Characters of an actor's own words that it is shown again.
const QUOTED: usize = 200;

impl Session {
    /// A lease comes back. An actor that cannot do anything it is given is broken: it goes, if there is another to do its
    /// work. The only one stays, so that a shard that nobody can do is found out.
    pub(super) fn take_back(&mut self, failed: &v1::Failed) -> Result<(), End> {
        let lease = LeaseId(failed.lease_id);
        let (reason, retryable) = (failed.reason.as_str(), failed.retryable);
        tracing::warn!(actor = self.actor_id, reason, retryable, "actor gave a lease back");
        self.handed.remove(&lease);
        if retryable {
            self.shared.with_ledger(|ledger| ledger.give_back(self.id, lease));
            return Ok(());
        }
        let present = self.shared.present();
        let failure = Failure { actor: &self.actor_id, process: self.incarnation, reason, present: &present };
        if !self.shared.with_ledger(|ledger| ledger.fail(self.id, lease, &failure)) {
            return Ok(());
        }
        self.failed += 1;
        if self.failed < MAX_FAILURES || !self.shared.send_away_if_others_stay(self.incarnation) {
            return Ok(());
        }
        let quoted: String = reason.chars().take(QUOTED).collect();
        let problem = format!("{quoted} ({} shards in a row could not be done here)", self.failed);
        Err(End::Refused(status::invalid_argument("failed", problem)))
    }

    pub(super) async fn take_part(&mut self, message: v1::ResultPart) -> Result<(), End> {
        let lease = LeaseId(message.lease_id);
        let Some(part) = message.part else {
            return Err(End::Refused(status::invalid_argument("part", "missing")));
        };
        self.shared.gauges.received_bytes.inc_by(part.data.len() as u64);
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
                self.settle(lease, bytes, message.timing).await
            }
            Err(error) => {
                self.assembling = None;
                self.damaged(lease, format!("part.{error}")).await
            }
        }
    }

    /// Checks a whole result and tells the actor what became of it.
    async fn settle(&mut self, lease: LeaseId, bytes: Bytes, said: Option<v1::ShardTiming>) -> Result<(), End> {
        let handed = self.handed.remove(&lease);
        let span = handed.as_ref().map_or_else(
            Span::none,
            |handed| tracing::info_span!(target: trace::TARGET, parent: &handed.span, "ingest", bytes = bytes.len()),
        );
        let result = match self.admit(bytes).instrument(span.clone()).await {
            Ok(result) => result,
            Err(error) => return self.reject(lease, error.to_string()).await,
        };
        let shard = *result.shard();
        let training = shard.kind == ShardKind::Train;
        match self.shared.with_ledger(|ledger| self.complete(ledger, lease, result, handed, training, said)) {
            Verdict::Accepted => {
                self.failed = 0;
                if let Some(actor) = lock(&self.shared.actors).get_mut(&self.id) {
                    actor.shards_done += 1;
                    actor.weights_version = Some(shard.version);
                }
                self.acknowledge(lease, v1::Verdict::Accepted, String::new()).await
            }
            Verdict::Duplicate => {
                self.failed = 0;
                tracing::debug!(actor = self.actor_id, shard = describe(&shard), "dropped a duplicate");
                self.acknowledge(lease, v1::Verdict::Duplicate, String::new()).await
            }
            Verdict::Rejected(reason) => self.turn_away(lease, reason).await,
        }
    }

    /// Into the ledger, and into the books of where the time went: under one lock, because the last result of a plan wakes
    /// the trainer, which reads both.
    fn complete(
        &self,
        ledger: &mut Ledger,
        lease: LeaseId,
        result: ShardResult,
        handed: Option<Handed>,
        training: bool,
        said: Option<v1::ShardTiming>,
    ) -> Verdict {
        let steps = steps_of(&result);
        let verdict = ledger.complete(self.id, lease, result);
        if verdict == Verdict::Accepted {
            let now = Instant::now();
            // Of a lease of an earlier connection the time is not known.
            let since_lease = handed.as_ref().map_or(Duration::ZERO, |handed| now - handed.since);
            let said = said.filter(|_| handed.is_some());
            lock(&self.shared.tally).settled(training, since_lease, said, now);
            self.shared.gauges.accepted(steps);
        }
        verdict
    }

    async fn admit(&self, bytes: Bytes) -> Result<ShardResult, ConvertError> {
        let shared = self.shared.clone();
        let short = bytes.len() <= DECODE_INLINE;
        let check = move || admit(&shared.limits, &shared.run.run_id, bytes);
        let delivery = if short {
            check()?
        } else {
            let gone = || ConvertError::new("result", "the learner stops");
            let _place = self.shared.decoders.acquire().await.map_err(|_| gone())?;
            tokio::task::spawn_blocking(check).await.map_err(|_| gone())??
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

    /// A result that did not arrive as it was sent: not the actor's fault, but that of what is in between. A new connection
    /// may fare better.
    async fn damaged(&mut self, lease: LeaseId, reason: String) -> Result<(), End> {
        self.handed.remove(&lease);
        self.shared.with_ledger(|ledger| ledger.reject(self.id, lease));
        self.damaged += 1;
        tracing::warn!(actor = self.actor_id, reason, "a result arrived damaged; the shard will be done again");
        self.acknowledge(lease, v1::Verdict::Rejected, reason.clone()).await?;
        if self.damaged < MAX_REJECTED {
            return Ok(());
        }
        let problem = format!("{reason} ({MAX_REJECTED} results arrived damaged); connect again");
        Err(End::Refused(Status::data_loss(problem)))
    }

    async fn turn_away(&mut self, lease: LeaseId, reason: String) -> Result<(), End> {
        self.rejected += 1;
        tracing::warn!(actor = self.actor_id, reason, "rejected a result; the shard will be done again");
        self.acknowledge(lease, v1::Verdict::Rejected, reason.clone()).await?;
        if self.rejected < MAX_REJECTED {
            return Ok(());
        }
        self.shared.send_away(self.incarnation);
        let (field, problem) = reason.split_once(": ").unwrap_or(("result", &reason));
        let problem = format!("{problem} ({MAX_REJECTED} results of this actor were not usable)");
        Err(End::Refused(status::invalid_argument(field, problem)))
    }

    async fn acknowledge(&self, lease: LeaseId, verdict: v1::Verdict, reason: String) -> Result<(), End> {
        self.say(Response::Ack(v1::Ack { lease_id: lease.0, verdict: verdict.into(), reason })).await
    }
}
