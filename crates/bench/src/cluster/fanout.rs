//! Publication of weights to many subscribers, one of which never reads.

use super::load::weights;
use crate::stats::quantile;
use magex_core::task::{Spawn, TaskConfig};
use magex_learner::collector::Collector as _;
use magex_learner::run_identity::RunIdentity;
use magex_learner::serve::service::{DEFAULT_LEASE, learner_service};
use magex_learner::serve::validate::Limits;
use magex_proto::v1::learner_service_client::LearnerServiceClient;
use magex_proto::weights::WeightsAssembler;
use magex_proto::{MAX_MESSAGE_BYTES, v1};
use magex_runtime::{client, server};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

/// Subscribers, the stalled one included.
pub(super) const SUBSCRIBERS: usize = 64;
/// Length of the weights.
const BYTES: usize = 1 << 20;
/// From one version to the next.
const PAUSE: Duration = Duration::from_millis(250);

/// Times from publication to whole and verified weights.
pub(super) struct Fanout {
    /// p50, p95 and worst, milliseconds.
    pub(super) ms: [f64; 3],
    /// Deliveries that a subscriber skipped for a newer version.
    pub(super) skipped: usize,
}

/// The service with threads of its own, the subscribers with theirs, real connections between them.
pub(super) fn measure(versions: u32) -> anyhow::Result<Fanout> {
    let threads = || tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
    let (serving, receiving) = (threads()?, threads()?);
    let task = TaskConfig::simple_spread(50, Spawn::Uniform);
    let run = RunIdentity {
        run_id: weights(1, 0).run_id.clone(),
        name: "fanout".into(),
        task_fingerprint: task.fingerprint(),
        run_config_toml: String::new(),
        seed: 0,
        lease: DEFAULT_LEASE,
    };
    let (handle, mut collector) = learner_service(run, Limits::for_task(&task, 1));
    let (incoming, address) = serving.block_on(server::bind("127.0.0.1:0"))?;
    let (stop, url) = (CancellationToken::new(), format!("http://{address}"));
    let server = serving.spawn({
        let stop = stop.clone();
        async move { handle.serve(incoming, stop).await }
    });
    collector.publish(&weights(BYTES, 0))?;

    let published: Arc<Mutex<Vec<Option<Instant>>>> = Arc::new(Mutex::new(vec![None; versions as usize + 1]));
    let (arrived, mut arrivals) = mpsc::unbounded_channel();
    let (ready, mut readiness) = mpsc::unbounded_channel();
    for _ in 1..SUBSCRIBERS {
        receiving.spawn(subscribe(url.clone(), published.clone(), arrived.clone(), ready.clone()));
    }
    drop((arrived, ready));
    // The stalled one has its stream and lets it fill.
    let stalled = receiving.block_on(async {
        let mut client = LearnerServiceClient::new(client::endpoint(&url)?.connect().await?);
        anyhow::Ok(client.watch_weights(v1::WatchWeightsRequest::default()).await?.into_inner())
    })?;
    receiving.block_on(async {
        for _ in 1..SUBSCRIBERS {
            readiness.recv().await;
        }
    });
    for version in 1..=versions {
        let next = weights(BYTES, version);
        published.lock().unwrap_or_else(PoisonError::into_inner)[version as usize] = Some(Instant::now());
        collector.publish(&next)?;
        std::thread::sleep(PAUSE);
    }
    std::thread::sleep(Duration::from_secs(1));
    stop.cancel();
    drop(stalled);
    serving.block_on(server)??;
    receiving.shutdown_background();
    serving.shutdown_background();
    let mut times = Vec::new();
    while let Ok(time) = arrivals.try_recv() {
        times.push(time);
    }
    let skipped = (SUBSCRIBERS - 1) * versions as usize - times.len();
    let ms = [quantile(&mut times, 0.5), quantile(&mut times, 0.95), times.last().copied().unwrap_or_default()];
    Ok(Fanout { ms, skipped })
}

/// As an actor does it: every version put together and its hash checked.
async fn subscribe(
    url: String,
    published: Arc<Mutex<Vec<Option<Instant>>>>,
    arrived: mpsc::UnboundedSender<f64>,
    ready: mpsc::UnboundedSender<()>,
) -> anyhow::Result<()> {
    let mut client = LearnerServiceClient::new(client::endpoint(&url)?.connect().await?)
        .max_decoding_message_size(MAX_MESSAGE_BYTES);
    let mut stream = client.watch_weights(v1::WatchWeightsRequest::default()).await?.into_inner();
    let mut assembler = WeightsAssembler::default();
    while let Some(message) = stream.message().await? {
        let Some((weights, _)) = assembler.push(message)? else { continue };
        let start = published.lock().unwrap_or_else(PoisonError::into_inner)[weights.version.0 as usize];
        match start {
            Some(start) => arrived.send(start.elapsed().as_secs_f64() * 1e3)?,
            // The version that is there from the start.
            None => ready.send(())?,
        }
    }
    Ok(())
}
