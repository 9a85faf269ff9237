//! Simulated actors: they speak the real protocol over real connections, and send results that were made before.

use super::ingest::weights;
use anyhow::{Context as _, bail};
use bytes::Bytes;
use magex_core::ids::{Iteration, Mode, Shard, ShardKind, WeightsVersion};
use magex_core::metrics_table::METRICS;
use magex_core::rng::{Key, Purpose};
use magex_core::statics::Statics;
use magex_core::task::{Spawn, TaskConfig};
use magex_core::trajectory::{EpisodeMetrics, ShardResult, Trajectory};
use magex_proto::convert::encode_result;
use magex_proto::v1::learner_service_client::LearnerServiceClient;
use magex_proto::v1::rollout_request::Message as Request;
use magex_proto::v1::rollout_response::Message as Response;
use magex_proto::weights::Weights;
use magex_proto::{MAX_MESSAGE_BYTES, PROTOCOL_VERSION, parts, v1};
use magex_runtime::client;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;

/// Shards of a plan: more than there are leases out at any time, so that nobody waits for the next plan.
const PLAN: u32 = 512;
/// Different results; the shards of a plan take turns.
const RESULTS: u32 = 32;
/// Shards that an actor has in hand.
const CREDIT: u32 = 2;
/// Pause between control calls.
const CONTROL: Duration = Duration::from_millis(5);

/// What is sent.
#[derive(Clone)]
pub(super) struct Load {
    pub(super) task: TaskConfig,
    pub(super) weights: Arc<Weights>,
    pub(super) plan: Vec<Shard>,
}

impl Load {
    pub(super) fn new(agents: usize, episodes: u32) -> Self {
        let task = TaskConfig::simple_spread(agents, Spawn::Uniform);
        let plan = (0..PLAN).map(|index| shard(index, episodes)).collect();
        Self { task, weights: weights(64, 0), plan }
    }

    /// The encoded results of the plan.
    fn results(&self) -> Vec<Bytes> {
        let made: Vec<Trajectory> =
            self.plan.iter().take(RESULTS as usize).map(|shard| trajectory(&self.task, shard)).collect();
        let encode = |shard: &Shard| {
            let like = &made[(shard.index % RESULTS) as usize];
            let result = ShardResult::Train(Trajectory { shard: *shard, ..like.clone() });
            encode_result(&self.weights.run_id, &self.weights.sha256, &result)
        };
        self.plan.iter().map(encode).collect()
    }
}

fn shard(index: u32, episodes: u32) -> Shard {
    Shard {
        kind: ShardKind::Train,
        iteration: Iteration(0),
        index,
        episodes,
        first_episode: index * episodes,
        version: WeightsVersion(0),
        mode: Mode::Sampled,
        eval_set: 0,
        record: false,
    }
}

/// Numbers that could be those of an episode.
fn trajectory(task: &TaskConfig, shard: &Shard) -> Trajectory {
    let shape = task.shape(shard.episodes as usize);
    let (t, b, n) = (shape.steps, shape.episodes, shape.agents);
    let mut stream = Key::new(0, Purpose::Action, &[shard.index]).stream();
    let mut numbers = |count: usize| -> Vec<f32> { (0..count).map(|_| stream.uniform32()).collect() };
    // A value that every metric may have.
    let metrics = EpisodeMetrics([1.0; METRICS.len()]);
    Trajectory {
        shard: *shard,
        shape,
        positions: numbers((t + 1) * b * shape.bodies * shape.dims),
        velocities: numbers((t + 1) * b * shape.bodies * shape.dims),
        agent_state: numbers((t + 1) * b * n * shape.agent_state),
        statics: Statics::landmarks(shape.landmarks, shape.dims, numbers(b * shape.landmarks * shape.dims)),
        goals: (0..b).flat_map(|_| 0..n as u32).collect(),
        actions: vec![1; t * b * n * shape.action_components],
        log_probs: numbers(t * b * n).iter().map(|x| -x).collect(),
        rewards: numbers(t * b * n),
        goal_log_probs: vec![-1.0; b * shape.goals_per_agent],
        costs: vec![2.0; b * shape.goals_per_agent],
        exact_costs: vec![1.0; b * shape.goals_per_agent],
        metrics: vec![metrics; b],
    }
}

/// What came of it.
pub(super) struct Pressed {
    pub(super) agent_steps_per_s: f64,
    pub(super) mib_per_s: f64,
    pub(super) shards_per_s: f64,
    /// p50 and p99 of control calls on a connection of their own; zero without.
    pub(super) control_ms: [f64; 2],
    pub(super) control_calls: usize,
}

/// So many actors send as fast as the learner takes it, for so long.
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
    // Nobody leaves before the end, unless something is wrong.
    if let Some(ended) = tasks.try_join_next() {
        ended??;
        bail!("an actor left before the end");
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
    let (say, requests) = mpsc::channel(4);
    let message = |message| v1::RolloutRequest { message: Some(message) };
    let hello = v1::Hello {
        protocol_version: PROTOCOL_VERSION,
        actor_id: format!("simulated-{process_id}"),
        process_id,
        threads: 1,
        ..Default::default()
    };
    say.send(message(Request::Hello(hello))).await?;
    let mut hear = client.rollout(ReceiverStream::new(requests)).await?.into_inner();
    say.send(message(Request::Ready(v1::Ready { credit: CREDIT }))).await?;
    while let Some(heard) = hear.message().await? {
        match heard.message {
            Some(Response::Lease(lease)) => {
                let shard = lease.shard.context("a lease without its shard")?;
                let bytes = results.get(shard.index as usize).context("a shard of another plan")?.clone();
                for part in parts::split(bytes) {
                    let part = v1::ResultPart { lease_id: lease.lease_id, part: Some(part), timing: None };
                    say.send(message(Request::Part(part))).await?;
                }
            }
            Some(Response::Ack(ack)) => {
                match ack.verdict() {
                    v1::Verdict::Accepted => accepted.fetch_add(1, Ordering::Relaxed),
                    other => bail!("{other:?}: {}", ack.reason),
                };
                say.send(message(Request::Ready(v1::Ready { credit: 1 }))).await?;
            }
            Some(Response::Welcome(_)) => {}
            Some(Response::Drain(_)) | None => break,
        }
    }
    Ok(())
}

pub(super) fn quantile(times: &mut [f64], q: f64) -> f64 {
    times.sort_unstable_by(f64::total_cmp);
    let place = (times.len() as f64 * q) as usize;
    times.get(place.min(times.len().saturating_sub(1))).copied().unwrap_or_default()
}
