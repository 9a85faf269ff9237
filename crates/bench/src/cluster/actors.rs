//! Simulated actors: they speak the real protocol over real connections, and send results that were made before.

use super::load::Load;
use crate::stats::quantile;
use anyhow::{Context as _, bail};
use bytes::Bytes;
use magex_proto::v1::learner_service_client::LearnerServiceClient;
use magex_proto::v1::rollout_request::Message as Request;
use magex_proto::v1::rollout_response::Message as Response;
use magex_proto::{MAX_MESSAGE_BYTES, PROTOCOL_VERSION, parts, v1};
use magex_runtime::client;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;

/// Shards that an actor has in hand.
const CREDIT: u32 = 2;
/// Pause between control calls.
const CONTROL: Duration = Duration::from_millis(5);

/// Throughput and latency under load.
pub(super) struct Pressed {
    pub(super) agent_steps_per_s: f64,
    pub(super) mib_per_s: f64,
    pub(super) shards_per_s: f64,
    /// p50 and p99 of control calls on a connection of their own; zero without.
    pub(super) control_ms: [f64; 2],
    pub(super) control_calls: usize,
}

/// `actors` simulated actors send as fast as the learner accepts, for `span`.
pub(super) async fn press(
    url: &str,
    load: &Load,
    actors: usize,
    span: Duration,
    control: bool,
) -> anyhow::Result<Pressed> {
    let results = Arc::new(load.results());
    let bytes = results.iter().map(Bytes::len).sum::<usize>() as f64 / results.len() as f64;
    let accepted = Arc::new(AtomicU64::new(0));
    let mut tasks = tokio::task::JoinSet::new();
    for number in 0..actors {
        tasks.spawn(send(url.to_owned(), number as u64 + 1, results.clone(), accepted.clone()));
    }
    // The first second finds cold caches and growing windows.
    tokio::time::sleep(Duration::from_secs(1)).await;
    let (start, before) = (Instant::now(), accepted.load(Ordering::Relaxed));
    let mut times = Vec::new();
    if control {
        let mut client = LearnerServiceClient::new(client::endpoint(url)?.connect().await?);
        while start.elapsed() < span {
            let clock = Instant::now();
            client.get_run(v1::GetRunRequest {}).await?;
            times.push(clock.elapsed().as_secs_f64() * 1e3);
            tokio::time::sleep(CONTROL).await;
        }
    } else {
        tokio::time::sleep(span).await;
    }
    let seconds = start.elapsed().as_secs_f64();
    let shards = (accepted.load(Ordering::Relaxed) - before) as f64 / seconds;
    // An actor that ended before this point has failed.
    if let Some(ended) = tasks.try_join_next() {
        ended??;
        bail!("an actor disconnected before the end");
    }
    tasks.shutdown().await;
    let shape = load.task.shape(load.plan.first().map_or(0, |shard| shard.episodes as usize));
    let steps = (shape.steps * shape.episodes * shape.agents) as f64;
    let control_calls = times.len();
    let control_ms = [quantile(&mut times, 0.5), quantile(&mut times, 0.99)];
    Ok(Pressed {
        agent_steps_per_s: shards * steps,
        mib_per_s: shards * bytes / f64::from(1 << 20),
        shards_per_s: shards,
        control_ms,
        control_calls,
    })
}

/// One actor, until it is cancelled.
async fn send(url: String, process_id: u64, results: Arc<Vec<Bytes>>, accepted: Arc<AtomicU64>) -> anyhow::Result<()> {
    let channel = client::endpoint(&url)?.connect().await?;
    let mut client = LearnerServiceClient::new(channel).max_decoding_message_size(MAX_MESSAGE_BYTES);
    let (sender, requests) = mpsc::channel(4);
    let message = |message| v1::RolloutRequest { message: Some(message) };
    let hello = v1::Hello {
        protocol_version: PROTOCOL_VERSION,
        actor_id: format!("simulated-{process_id}"),
        process_id,
        threads: 1,
        ..Default::default()
    };
    sender.send(message(Request::Hello(hello))).await?;
    let mut responses = client.rollout(ReceiverStream::new(requests)).await?.into_inner();
    sender.send(message(Request::Ready(v1::Ready { credit: CREDIT }))).await?;
    while let Some(response) = responses.message().await? {
        match response.message {
            Some(Response::Lease(lease)) => {
                let shard = lease.shard.context("a lease without its shard")?;
                let bytes = results.get(shard.index as usize).context("a shard of another plan")?.clone();
                for part in parts::split(bytes) {
                    let part = v1::ResultPart { lease_id: lease.lease_id, part: Some(part), timing: None };
                    sender.send(message(Request::Part(part))).await?;
                }
            }
            Some(Response::Ack(ack)) => {
                match ack.verdict() {
                    v1::Verdict::Accepted => {
                        accepted.fetch_add(1, Ordering::Relaxed);
                    }
                    // A second computation, or the slower one of a hedged lease.
                    v1::Verdict::Duplicate => {}
                    other => bail!("{other:?}: {}", ack.reason),
                }
                sender.send(message(Request::Ready(v1::Ready { credit: 1 }))).await?;
            }
            Some(Response::Welcome(_)) => {}
            Some(Response::Drain(_)) | None => break,
        }
    }
    Ok(())
}
