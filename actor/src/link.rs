//! One connection to the learner: leases in, results out.

use crate::crew::{Crew, Job, Outcome};
use crate::worker::Welcome;
use bytes::Bytes;
use magex_core::ids::RunId;
use magex_proto::v1::rollout_request::Message as Request;
use magex_proto::v1::rollout_response::Message as Response;
use magex_proto::{PROTOCOL_VERSION, convert, parts, v1};
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tonic::{Status, Streaming};

/// How a connection ends.
#[derive(Debug)]
pub(crate) enum End {
    /// The actor was told to stop.
    Shutdown,
    /// The run is complete.
    Finished,
    /// Connect again.
    Broken(String),
    /// Connecting again would not help.
    Refused(String),
}

impl From<Status> for End {
    fn from(status: Status) -> Self {
        use tonic::Code;
        match status.code() {
            Code::FailedPrecondition | Code::InvalidArgument => Self::Refused(status.message().to_owned()),
            code => Self::Broken(format!("{code}: {}", status.message())),
        }
    }
}

/// What an actor did.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ActorReport {
    /// Connections to the learner that were accepted.
    pub sessions: u64,
    /// Results taken into a batch.
    pub accepted: u64,
    /// Results that were known already or no longer wanted.
    pub duplicate: u64,
    /// Results that were not usable.
    pub rejected: u64,
    /// Leases given back.
    pub failed: u64,
}

/// Results that the learner has not settled yet; they are sent again on the next connection.
#[derive(Debug, Default)]
pub(crate) struct Unsettled {
    results: BTreeMap<u64, Bytes>,
}

impl Unsettled {
    pub(crate) fn clear(&mut self) {
        self.results.clear();
    }
}

/// Reads the learner's first message.
pub(crate) async fn welcome(inbound: &mut Streaming<v1::RolloutResponse>) -> Result<Welcome, End> {
    let message = inbound.message().await?.ok_or_else(|| End::Broken("the learner hung up".to_owned()))?;
    let welcome = match message.message {
        Some(Response::Welcome(welcome)) => welcome,
        Some(Response::Drain(drain)) if drain.finished => return Err(End::Finished),
        Some(Response::Drain(drain)) => return Err(End::Broken(drain.reason)),
        _ => return Err(End::Broken("the learner did not answer the hello".to_owned())),
    };
    if welcome.protocol_version != PROTOCOL_VERSION {
        let theirs = welcome.protocol_version;
        return Err(End::Refused(format!("learner speaks protocol {theirs}, actor speaks {PROTOCOL_VERSION}")));
    }
    let lease = Duration::try_from_secs_f64(welcome.lease_seconds)
        .ok()
        .filter(|lease| !lease.is_zero())
        .ok_or_else(|| End::Refused(format!("lease_seconds: {} is not a time", welcome.lease_seconds)))?;
    Ok(Welcome {
        run_id: RunId(welcome.run_id),
        task_fingerprint: welcome.task_fingerprint,
        run_config_toml: welcome.run_config_toml,
        seed: welcome.seed,
        lease,
    })
}

/// A connection after its welcome.
pub(crate) struct Link<'a> {
    pub(crate) crew: &'a mut Crew,
    pub(crate) unsettled: &'a mut Unsettled,
    pub(crate) report: &'a mut ActorReport,
    outbound: mpsc::Sender<v1::RolloutRequest>,
    /// Small messages, which overtake results.
    urgent: VecDeque<Request>,
    /// Results in parts; those of one result follow each other.
    bulk: VecDeque<Request>,
    /// Leases that the learner may still send.
    granted: usize,
}

impl<'a> Link<'a> {
    pub(crate) fn new(
        crew: &'a mut Crew,
        unsettled: &'a mut Unsettled,
        report: &'a mut ActorReport,
        outbound: mpsc::Sender<v1::RolloutRequest>,
    ) -> Self {
        Self { crew, unsettled, report, outbound, urgent: VecDeque::new(), bulk: VecDeque::new(), granted: 0 }
    }

    /// Works until the connection ends.
    pub(crate) async fn serve(
        mut self,
        mut inbound: Streaming<v1::RolloutResponse>,
        shutdown: &CancellationToken,
    ) -> End {
        let again: Vec<(u64, Bytes)> = self.unsettled.results.iter().map(|(id, bytes)| (*id, bytes.clone())).collect();
        for (lease_id, bytes) in again {
            self.queue_result(lease_id, bytes);
        }
        let mut heartbeat = tokio::time::interval(self.crew.welcome.lease / 4);
        heartbeat.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        let outbound = self.outbound.clone();
        loop {
            self.ask_for_work();
            let talkative = !self.urgent.is_empty() || !self.bulk.is_empty();
            tokio::select! {
                message = inbound.message() => match message {
                    Ok(Some(v1::RolloutResponse { message: Some(message) })) => {
                        if let Err(end) = self.hear(message) {
                            return end;
                        }
                    }
                    Ok(Some(_)) => tracing::debug!("the learner said something unknown"),
                    Ok(None) => return End::Broken("the learner hung up".to_owned()),
                    Err(status) => return status.into(),
                },
                permit = outbound.reserve(), if talkative => match permit {
                    Ok(permit) => {
                        let message = self.urgent.pop_front().or_else(|| self.bulk.pop_front());
                        permit.send(v1::RolloutRequest { message });
                    }
                    // The reason is about to come in.
                    Err(_) => return last_words(&mut inbound).await,
                },
                outcome = self.crew.next_outcome() => match outcome {
                    Some(outcome) => self.finish(outcome),
                    None => return End::Refused("all rollout threads ended".to_owned()),
                },
                _ = heartbeat.tick() => if !talkative {
                    self.urgent.push_back(Request::Heartbeat(v1::Heartbeat {}));
                },
                () = shutdown.cancelled() => return End::Shutdown,
            }
        }
    }

    /// Asks for as many shards as there are idle threads, unless too many results wait to be settled.
    fn ask_for_work(&mut self) {
        let wanted = self.crew.idle().saturating_sub(self.granted);
        if wanted > 0 && self.unsettled.results.len() <= 2 * self.crew.threads() {
            self.granted += wanted;
            self.urgent.push_back(Request::Ready(v1::Ready { credit: wanted as u32 }));
        }
    }

    fn hear(&mut self, message: Response) -> Result<(), End> {
        match message {
            Response::Lease(lease) => {
                self.granted = self.granted.saturating_sub(1);
                self.begin(lease);
                Ok(())
            }
            Response::Ack(ack) => {
                self.unsettled.results.remove(&ack.lease_id);
                match ack.verdict() {
                    v1::Verdict::Accepted => self.report.accepted += 1,
                    v1::Verdict::Duplicate => self.report.duplicate += 1,
                    v1::Verdict::Rejected | v1::Verdict::Unspecified => {
                        self.report.rejected += 1;
                        tracing::error!(reason = ack.reason, "the learner rejected a result");
                    }
                }
                Ok(())
            }
            Response::Drain(drain) if drain.finished => Err(End::Finished),
            Response::Drain(drain) => Err(End::Broken(format!("the learner stops ({})", drain.reason))),
            Response::Welcome(_) => Err(End::Broken("the learner said welcome twice".to_owned())),
        }
    }

    fn begin(&mut self, lease: v1::Lease) {
        let v1::Lease { lease_id, shard, weights_sha256 } = lease;
        let problem = match convert::shard("lease.shard", shard.as_ref()) {
            Ok(shard) => match self.crew.give(Job { lease_id, shard, weights_sha256 }) {
                Ok(()) => return,
                Err(_) => "more leases than credit".to_owned(),
            },
            Err(error) => error.to_string(),
        };
        self.give_back(lease_id, shard, problem, false);
    }

    fn finish(&mut self, outcome: Outcome) {
        match outcome {
            Outcome::Done { lease_id, bytes } => {
                self.unsettled.results.insert(lease_id, bytes.clone());
                self.queue_result(lease_id, bytes);
            }
            Outcome::Failed { lease_id, shard, reason, retryable } => {
                tracing::warn!(reason, retryable, "gave a lease back");
                self.give_back(lease_id, Some((&shard).into()), reason, retryable);
            }
        }
    }

    fn give_back(&mut self, lease_id: u64, shard: Option<v1::Shard>, reason: String, retryable: bool) {
        self.report.failed += 1;
        self.urgent.push_back(Request::Failed(v1::Failed { lease_id, shard, reason, retryable }));
    }

    fn queue_result(&mut self, lease_id: u64, bytes: Bytes) {
        let part = |part| Request::Part(v1::ResultPart { lease_id, part: Some(part) });
        self.bulk.extend(parts::split(bytes).map(part));
    }
}

/// Why the learner closed the stream.
async fn last_words(inbound: &mut Streaming<v1::RolloutResponse>) -> End {
    let drained = async {
        loop {
            match inbound.message().await {
                Ok(Some(v1::RolloutResponse { message: Some(Response::Drain(drain)) })) if drain.finished => {
                    return End::Finished;
                }
                Ok(Some(_)) => {}
                Ok(None) => return End::Broken("the learner hung up".to_owned()),
                Err(status) => return status.into(),
            }
        }
    };
    let silent = |_| End::Broken("the learner closed the stream".to_owned());
    tokio::time::timeout(Duration::from_secs(1), drained).await.unwrap_or_else(silent)
}
