//! One connection to the learner: leases in, results out. The learner's end is `serve::session`.

use crate::metrics::ActorMetrics;
use crate::rollout_pool::{EncodedResult, LeasedShard, RolloutPool, ShardOutcome};
use crate::worker::WorkError;
use magex_proto::v1::rollout_request::Message as Request;
use magex_proto::v1::rollout_response::Message as Response;
use magex_proto::{PROTOCOL_VERSION, convert, parts, v1};
use magex_runtime::trace;
use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tonic::{Status, Streaming};

/// Leases that a learner may give.
const SHORTEST_LEASE: Duration = Duration::from_millis(100);
const LONGEST_LEASE: Duration = Duration::from_secs(3600);

/// A rollout thread that has a shard and has not moved for this number of leases hangs. Each of its waits (for weights, for goals) ends after
/// one.
const STUCK_LEASES: u32 = 8;
/// Heartbeats per lease.
const BEATS: u32 = 4;

#[derive(Debug)]
pub(crate) enum SessionEnd {
    /// The actor shuts down.
    Shutdown,
    /// The run is complete.
    Finished,
    /// The connection failed: reconnect.
    Broken(String),
    /// A call failed with this status: reconnect.
    Failed(Status),
    /// The learner rejects this actor; reconnecting would not help.
    Refused(String),
    /// The learner evicted this process: its results are invalid, or its shards fail.
    Evicted(String),
    /// This process cannot process any shard.
    Unusable(WorkError),
    /// This rollout thread has not moved for this time.
    Stuck(usize, Duration),
}

impl From<Status> for SessionEnd {
    fn from(status: Status) -> Self {
        use tonic::Code;
        match status.code() {
            // A retry would present the same credentials and settings.
            Code::FailedPrecondition | Code::InvalidArgument | Code::Unauthenticated | Code::PermissionDenied => {
                Self::Refused(status.message().to_owned())
            }
            _ => Self::Failed(status),
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
    /// Results that the learner had already, or no longer needs.
    pub duplicate: u64,
    /// Results that failed the learner's validation.
    pub rejected: u64,
    /// Leases returned without a result.
    pub failed: u64,
}

/// Results that the learner has not acknowledged, by their leases; the next connection sends them again.
pub(crate) type UnacknowledgedResults = BTreeMap<u64, EncodedResult>;

/// Reads the learner's first message, with the time after which a silent actor loses its leases.
pub(crate) async fn welcome(reply: &mut Streaming<v1::RolloutResponse>) -> Result<(v1::Welcome, Duration), SessionEnd> {
    let message =
        reply.message().await?.ok_or_else(|| SessionEnd::Broken("the learner closed the connection".to_owned()))?;
    let welcome = match message.message {
        Some(Response::Welcome(welcome)) => welcome,
        Some(Response::Drain(drain)) if drain.finished => return Err(SessionEnd::Finished),
        Some(Response::Drain(drain)) => return Err(SessionEnd::Broken(drain.reason)),
        _ => return Err(SessionEnd::Broken("the learner did not answer the hello".to_owned())),
    };
    if welcome.protocol_version != PROTOCOL_VERSION {
        let theirs = welcome.protocol_version;
        return Err(SessionEnd::Refused(format!("learner speaks protocol {theirs}, actor speaks {PROTOCOL_VERSION}")));
    }
    let lease = lease_time(welcome.lease_seconds)?;
    Ok((welcome, lease))
}

/// Checks the lease time. Heartbeats cannot keep a lease outside the range that a learner can be started with.
fn lease_time(seconds: f64) -> Result<Duration, SessionEnd> {
    let known = Duration::try_from_secs_f64(seconds).ok();
    known.filter(|lease| (SHORTEST_LEASE..=LONGEST_LEASE).contains(lease)).ok_or_else(|| {
        SessionEnd::Refused(format!(
            "lease_seconds: {seconds} is outside 0.1..=3600; start the learner with another --lease-seconds"
        ))
    })
}

pub(crate) struct Session<'a> {
    pub(crate) pool: &'a mut RolloutPool,
    pub(crate) unacknowledged: &'a mut UnacknowledgedResults,
    pub(crate) report: &'a mut ActorReport,
    metrics: &'a ActorMetrics,
    outbound: mpsc::Sender<v1::RolloutRequest>,
    /// Small messages, which overtake results.
    urgent: VecDeque<Request>,
    /// Results in parts; those of one result follow each other.
    bulk: VecDeque<Request>,
    /// Leases that the learner may still send.
    credit: usize,
    /// An error that every shard would meet here.
    fatal: Option<WorkError>,
}

impl<'a> Session<'a> {
    pub(crate) fn new(
        pool: &'a mut RolloutPool,
        unacknowledged: &'a mut UnacknowledgedResults,
        report: &'a mut ActorReport,
        metrics: &'a ActorMetrics,
        outbound: mpsc::Sender<v1::RolloutRequest>,
    ) -> Self {
        let (urgent, bulk) = (VecDeque::new(), VecDeque::new());
        Self { pool, unacknowledged, report, metrics, outbound, urgent, bulk, credit: 0, fatal: None }
    }

    pub(crate) async fn run(
        mut self,
        mut inbound: Streaming<v1::RolloutResponse>,
        shutdown: &CancellationToken,
    ) -> SessionEnd {
        let again = self.unacknowledged.iter().flat_map(|(&lease_id, result)| in_parts(lease_id, result));
        self.bulk.extend(again);
        let mut heartbeat = tokio::time::interval(self.pool.lease / BEATS);
        heartbeat.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        let outbound = self.outbound.clone();
        loop {
            if self.urgent.is_empty()
                && let Some(error) = self.fatal.take()
            {
                // The learner receives the reason before the connection closes; closing returns the other leases.
                drop((outbound, self.outbound));
                drain_inbound(&mut inbound).await;
                return SessionEnd::Unusable(error);
            }
            self.request_leases();
            self.metrics.queue("unacknowledged", self.unacknowledged.len());
            self.metrics.queue("outbound", self.urgent.len() + self.bulk.len());
            let has_messages = !self.urgent.is_empty() || !self.bulk.is_empty();
            tokio::select! {
                message = inbound.message() => match message {
                    Ok(Some(v1::RolloutResponse { message: Some(message) })) => {
                        if let Err(end) = self.on_message(message) {
                            return end;
                        }
                    }
                    Ok(Some(_)) => tracing::debug!("ignored an unknown message of the learner"),
                    Ok(None) => return SessionEnd::Broken("the learner closed the connection".to_owned()),
                    Err(status) => return session_error(status),
                },
                permit = outbound.reserve(), if has_messages => match permit {
                    Ok(permit) => {
                        let message = self.urgent.pop_front().or_else(|| self.bulk.pop_front());
                        if let Some(Request::Part(v1::ResultPart { part: Some(part), .. })) = &message {
                            self.metrics.upload_bytes.inc_by(part.data.len() as u64);
                        }
                        permit.send(v1::RolloutRequest { message });
                    }
                    // The learner closed the stream; its reason arrives next.
                    Err(_) => return drain_inbound(&mut inbound).await,
                },
                outcome = self.pool.next_outcome() => match outcome {
                    Some(outcome) => self.on_outcome(outcome),
                    None => return SessionEnd::Refused("all rollout threads ended".to_owned()),
                },
                _ = heartbeat.tick() => {
                    if let Some(thread) = self.pool.stuck(STUCK_LEASES * BEATS) {
                        return SessionEnd::Stuck(thread, STUCK_LEASES * self.pool.lease);
                    }
                    if !has_messages {
                        self.urgent.push_back(Request::Heartbeat(v1::Heartbeat {}));
                    }
                }
                () = shutdown.cancelled() => return SessionEnd::Shutdown,
            }
        }
    }

    /// Requests one lease per idle thread, unless too many results are unacknowledged.
    fn request_leases(&mut self) {
        let wanted = self.pool.idle().saturating_sub(self.credit);
        if wanted > 0 && self.fatal.is_none() && self.unacknowledged.len() <= 2 * self.pool.threads() {
            self.credit += wanted;
            self.urgent.push_back(Request::Ready(v1::Ready { credit: wanted as u32 }));
        }
    }

    fn on_message(&mut self, message: Response) -> Result<(), SessionEnd> {
        match message {
            Response::Lease(lease) => {
                self.credit = self.credit.saturating_sub(1);
                self.on_lease(lease);
                Ok(())
            }
            Response::Ack(ack) => {
                if let Some(result) = self.unacknowledged.remove(&ack.lease_id) {
                    self.metrics.upload.observe(result.ready.elapsed().as_secs_f64());
                }
                let (count, outcome) = match ack.verdict() {
                    v1::Verdict::Accepted => (&mut self.report.accepted, "accepted"),
                    v1::Verdict::Duplicate => (&mut self.report.duplicate, "duplicate"),
                    v1::Verdict::Rejected | v1::Verdict::Unspecified => {
                        tracing::error!(reason = ack.reason, "the learner rejected a result");
                        (&mut self.report.rejected, "rejected")
                    }
                };
                *count += 1;
                self.metrics.outcome(outcome);
                Ok(())
            }
            Response::Drain(drain) if drain.finished => Err(SessionEnd::Finished),
            Response::Drain(drain) => Err(SessionEnd::Broken(format!("the learner stops ({})", drain.reason))),
            Response::Welcome(_) => Err(SessionEnd::Broken("the learner sent a second welcome".to_owned())),
        }
    }

    fn on_lease(&mut self, lease: v1::Lease) {
        let v1::Lease { lease_id, shard, weights_sha256, traceparent } = lease;
        let (problem, retryable) = match convert::shard("lease.shard", shard.as_ref()) {
            Ok(shard) => {
                let (iteration, index) = (shard.iteration.0, shard.index);
                let span = tracing::info_span!(target: trace::TARGET, parent: None, "rollout", iteration, index);
                trace::continue_from(&span, &traceparent);
                if self.pool.submit(LeasedShard { lease_id, shard, weights_sha256, received: Instant::now(), span }) {
                    return;
                }
                // Another actor may have an idle thread.
                ("more leases than credit".to_owned(), true)
            }
            Err(error) => (error.to_string(), false),
        };
        self.return_lease(lease_id, shard, problem, retryable);
    }

    fn on_outcome(&mut self, ShardOutcome { lease_id, shard, result }: ShardOutcome) {
        match result {
            Ok(result) => {
                self.bulk.extend(in_parts(lease_id, &result));
                self.unacknowledged.insert(lease_id, result);
            }
            Err(error) => {
                let (reason, retryable) = (error.to_string(), error.is_retryable());
                tracing::warn!(reason, retryable, "returned a lease");
                self.return_lease(lease_id, Some((&shard).into()), reason, retryable);
                if error.is_fatal_to_actor() {
                    self.fatal = Some(error);
                }
            }
        }
    }

    fn return_lease(&mut self, lease_id: u64, shard: Option<v1::Shard>, reason: String, retryable: bool) {
        self.report.failed += 1;
        self.metrics.outcome("failed");
        self.urgent.push_back(Request::Failed(v1::Failed { lease_id, shard, reason, retryable }));
    }
}

/// The messages of a result; the last one has its timing.
fn in_parts(lease_id: u64, result: &EncodedResult) -> impl Iterator<Item = Request> + use<> {
    let timing = result.timing;
    parts::split(result.bytes.clone()).map(move |part| {
        let last = part.index + 1 == part.total;
        Request::Part(v1::ResultPart { lease_id, part: Some(part), timing: last.then_some(timing) })
    })
}

/// What an error means after the welcome: the handshake is over, so an invalid argument is an invalid result.
fn session_error(status: Status) -> SessionEnd {
    match status.code() {
        tonic::Code::InvalidArgument => SessionEnd::Evicted(status.message().to_owned()),
        _ => status.into(),
    }
}

/// Reads what the learner sent before it closed the stream: the reason.
async fn drain_inbound(inbound: &mut Streaming<v1::RolloutResponse>) -> SessionEnd {
    let drained = async {
        loop {
            match inbound.message().await {
                Ok(Some(v1::RolloutResponse { message: Some(Response::Drain(drain)) })) if drain.finished => {
                    return SessionEnd::Finished;
                }
                Ok(Some(_)) => {}
                Ok(None) => return SessionEnd::Broken("the learner closed the connection".to_owned()),
                Err(status) => return session_error(status),
            }
        }
    };
    let silent = |_| SessionEnd::Broken("the learner closed the stream".to_owned());
    tokio::time::timeout(Duration::from_secs(1), drained).await.unwrap_or_else(silent)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lease_time_outside_the_learners_range_is_rejected_with_the_remedy() {
        for seconds in [f64::NAN, f64::INFINITY, -1.0, 0.0, 1e-9, 0.099, 3600.1, 1e300] {
            let Err(SessionEnd::Refused(reason)) = lease_time(seconds) else { panic!("{seconds}") };
            assert!(reason.contains("lease_seconds: ") && reason.contains("--lease-seconds"), "{reason}");
        }
        for seconds in [0.1, 15.0, 3600.0] {
            assert_eq!(lease_time(seconds).unwrap().as_secs_f64(), seconds);
        }
    }
}
