//! One connection to the learner: leases in, results out.

use crate::crew::{Crew, Done, Job, Outcome};
use crate::gauges::ActorGauges;
use crate::worker::{Welcome, WorkError};
use magex_core::ids::RunId;
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
    /// The learner cannot use what this process computes.
    SentAway(String),
    /// This process can do no shard.
    Useless(WorkError),
}

impl From<Status> for End {
    fn from(status: Status) -> Self {
        use tonic::Code;
        match status.code() {
            // Who is not let in now will not be let in later: it shows the same token again.
            Code::FailedPrecondition | Code::InvalidArgument | Code::Unauthenticated | Code::PermissionDenied => {
                Self::Refused(status.message().to_owned())
            }
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
    results: BTreeMap<u64, Done>,
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
    let lease = lease_time(welcome.lease_seconds)?;
    Ok(Welcome {
        run_id: RunId(welcome.run_id),
        task_fingerprint: welcome.task_fingerprint,
        run_config_toml: welcome.run_config_toml,
        seed: welcome.seed,
        lease,
    })
}

/// What a learner can be started with: other times are no lease to keep by heartbeats.
fn lease_time(seconds: f64) -> Result<Duration, End> {
    let known = Duration::try_from_secs_f64(seconds).ok();
    known.filter(|lease| (SHORTEST_LEASE..=LONGEST_LEASE).contains(lease)).ok_or_else(|| {
        End::Refused(format!(
            "lease_seconds: {seconds} is outside 0.1..=3600; start the learner with another --lease-seconds"
        ))
    })
}

/// A connection after its welcome.
pub(crate) struct Link<'a> {
    pub(crate) crew: &'a mut Crew,
    pub(crate) unsettled: &'a mut Unsettled,
    pub(crate) report: &'a mut ActorReport,
    gauges: &'a ActorGauges,
    outbound: mpsc::Sender<v1::RolloutRequest>,
    /// Small messages, which overtake results.
    urgent: VecDeque<Request>,
    /// Results in parts; those of one result follow each other.
    bulk: VecDeque<Request>,
    /// Leases that the learner may still send.
    granted: usize,
    /// Why no shard can be done here.
    useless: Option<WorkError>,
}

impl<'a> Link<'a> {
    pub(crate) fn new(
        crew: &'a mut Crew,
        unsettled: &'a mut Unsettled,
        report: &'a mut ActorReport,
        gauges: &'a ActorGauges,
        outbound: mpsc::Sender<v1::RolloutRequest>,
    ) -> Self {
        let (urgent, bulk) = (VecDeque::new(), VecDeque::new());
        Self { crew, unsettled, report, gauges, outbound, urgent, bulk, granted: 0, useless: None }
    }

    /// Works until the connection ends.
    pub(crate) async fn serve(
        mut self,
        mut inbound: Streaming<v1::RolloutResponse>,
        shutdown: &CancellationToken,
    ) -> End {
        let again: Vec<(u64, Done)> = self.unsettled.results.iter().map(|(id, done)| (*id, done.clone())).collect();
        for (lease_id, done) in again {
            self.queue_result(lease_id, &done);
        }
        let mut heartbeat = tokio::time::interval(self.crew.welcome.lease / 4);
        heartbeat.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        let outbound = self.outbound.clone();
        loop {
            if self.urgent.is_empty()
                && let Some(error) = self.useless.take()
            {
                // The learner hears why before the connection ends, which gives it the other leases back.
                drop((outbound, self.outbound));
                last_words(&mut inbound).await;
                return End::Useless(error);
            }
            self.ask_for_work();
            self.gauges.queue("unsettled", self.unsettled.results.len());
            self.gauges.queue("outbound", self.urgent.len() + self.bulk.len());
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
                    Err(status) => return at_work(status),
                },
                permit = outbound.reserve(), if talkative => match permit {
                    Ok(permit) => {
                        let message = self.urgent.pop_front().or_else(|| self.bulk.pop_front());
                        if let Some(Request::Part(v1::ResultPart { part: Some(part), .. })) = &message {
                            self.gauges.upload_bytes.inc_by(part.data.len() as u64);
                        }
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
        if wanted > 0 && self.useless.is_none() && self.unsettled.results.len() <= 2 * self.crew.threads() {
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
                if let Some(done) = self.unsettled.results.remove(&ack.lease_id) {
                    self.gauges.upload.observe(done.ready.elapsed().as_secs_f64());
                }
                match ack.verdict() {
                    v1::Verdict::Accepted => {
                        self.report.accepted += 1;
                        self.gauges.outcome("accepted");
                    }
                    v1::Verdict::Duplicate => {
                        self.report.duplicate += 1;
                        self.gauges.outcome("duplicate");
                    }
                    v1::Verdict::Rejected | v1::Verdict::Unspecified => {
                        self.report.rejected += 1;
                        self.gauges.outcome("rejected");
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
        let v1::Lease { lease_id, shard, weights_sha256, traceparent } = lease;
        let (problem, retryable) = match convert::shard("lease.shard", shard.as_ref()) {
            Ok(shard) => {
                let (iteration, index) = (shard.iteration.0, shard.index);
                let span = tracing::info_span!(target: trace::TARGET, parent: None, "rollout", iteration, index);
                trace::continue_from(&span, &traceparent);
                match self.crew.give(Job { lease_id, shard, weights_sha256, received: Instant::now(), span }) {
                    Ok(()) => return,
                    // Another actor has room for it.
                    Err(_) => ("more leases than credit".to_owned(), true),
                }
            }
            Err(error) => (error.to_string(), false),
        };
        self.give_back(lease_id, shard, problem, retryable);
    }

    fn finish(&mut self, outcome: Outcome) {
        match outcome {
            Outcome::Done { lease_id, done } => {
                self.queue_result(lease_id, &done);
                self.unsettled.results.insert(lease_id, done);
            }
            Outcome::Failed { lease_id, shard, error } => {
                let (reason, retryable) = (error.to_string(), error.is_retryable());
                tracing::warn!(reason, retryable, "gave a lease back");
                self.give_back(lease_id, Some((&shard).into()), reason, retryable);
                if error.ends_the_actor() {
                    self.useless = Some(error);
                }
            }
        }
    }

    fn give_back(&mut self, lease_id: u64, shard: Option<v1::Shard>, reason: String, retryable: bool) {
        self.report.failed += 1;
        self.gauges.outcome("failed");
        self.urgent.push_back(Request::Failed(v1::Failed { lease_id, shard, reason, retryable }));
    }

    fn queue_result(&mut self, lease_id: u64, done: &Done) {
        let part = |part: v1::Part| {
            let last = part.index + 1 == part.total;
            Request::Part(v1::ResultPart { lease_id, part: Some(part), timing: last.then_some(done.timing) })
        };
        self.bulk.extend(parts::split(done.bytes.clone()).map(part));
    }
}

/// What an error means after the welcome: only what was sent can be wrong now, not who sends it.
fn at_work(status: Status) -> End {
    match status.code() {
        tonic::Code::InvalidArgument => End::SentAway(status.message().to_owned()),
        _ => status.into(),
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
                Err(status) => return at_work(status),
            }
        }
    };
    let silent = |_| End::Broken("the learner closed the stream".to_owned());
    tokio::time::timeout(Duration::from_secs(1), drained).await.unwrap_or_else(silent)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lease_that_no_learner_can_be_started_with_is_refused_with_the_remedy() {
        for seconds in [f64::NAN, f64::INFINITY, -1.0, 0.0, 1e-9, 0.099, 3600.1, 1e300] {
            let Err(End::Refused(reason)) = lease_time(seconds) else { panic!("{seconds}") };
            assert!(reason.contains("lease_seconds: ") && reason.contains("--lease-seconds"), "{reason}");
        }
        for seconds in [0.1, 15.0, 3600.0] {
            assert_eq!(lease_time(seconds).unwrap().as_secs_f64(), seconds);
        }
    }
}
