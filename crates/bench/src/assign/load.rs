//! Clients of the commander: one that measures latency, many that produce load.

use crate::stats::quantile;
use crate::vitals::memory_mib;
use anyhow::{Context as _, bail};
use magex_proto::v1;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use magex_runtime::client;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};
use tonic::Code;
use tonic::transport::Channel;

/// Connections and calls in flight on each, of the throughput rows.
const CONNECTIONS: usize = 4;
const IN_FLIGHT: usize = 8;
/// Clients of the flood, each with a connection of its own.
const FLOODERS: usize = 64;

type Client = CommanderServiceClient<Channel>;

async fn connect(url: &str) -> anyhow::Result<Client> {
    let channel = client::endpoint(url)?.connect().await.with_context(|| format!("connecting to {url}"))?;
    Ok(CommanderServiceClient::new(channel).max_decoding_message_size(64 << 20))
}

/// Median and 99th percentile of the round trip, and the median that the service says it took, milliseconds.
pub(super) async fn one_client(
    url: &str,
    teams: &[v1::AssignRequest],
    calls: u32,
    kind: v1::AssignmentMethod,
) -> anyhow::Result<[f64; 3]> {
    let mut client = connect(url).await?;
    let (mut times, mut inside) = (Vec::new(), Vec::new());
    // The first calls find cold caches; they do not count unless they are all there is.
    let warm = if calls > 100 { 100 } else { 0 };
    for call in 0..warm + calls {
        let request = teams[call as usize % teams.len()].clone();
        let start = Instant::now();
        let reply = client.assign(request).await?.into_inner();
        if call >= warm {
            times.push(start.elapsed().as_secs_f64() * 1e3);
            inside.push(reply.seconds * 1e3);
        }
        if reply.scheduler() != kind {
            bail!("{:?} answered instead of {kind:?}: {}", reply.scheduler(), reply.fallback_reason);
        }
    }
    Ok([quantile(&mut times, 0.5), quantile(&mut times, 0.99), quantile(&mut inside, 0.5)])
}

/// Calls per second with as many clients as the service can serve.
pub(super) async fn saturate(
    url: &str,
    teams: &[v1::AssignRequest],
    seconds: u32,
    kind: v1::AssignmentMethod,
) -> anyhow::Result<f64> {
    let start = Instant::now();
    let until = start + Duration::from_secs(seconds.into());
    let mut tasks = Vec::new();
    for connection in 0..CONNECTIONS {
        let client = connect(url).await?;
        for task in 0..IN_FLIGHT {
            let (mut client, teams) = (client.clone(), teams.to_vec());
            tasks.push(tokio::spawn(async move {
                let mut calls = 0usize;
                while Instant::now() < until {
                    let request = teams[(calls + connection + task) % teams.len()].clone();
                    let reply = client.assign(request).await?.into_inner();
                    if reply.scheduler() != kind {
                        bail!("{:?} answered instead of {kind:?}: {}", reply.scheduler(), reply.fallback_reason);
                    }
                    calls += 1;
                }
                Ok(calls)
            }));
        }
    }
    let mut calls = 0;
    for task in tasks {
        calls += task.await??;
    }
    Ok(calls as f64 / start.elapsed().as_secs_f64())
}

/// Result of a flood.
pub(super) struct Flood {
    pub(super) answered: u64,
    pub(super) exhausted: u64,
    /// Errors of any other kind.
    pub(super) wrong: u64,
    /// 99th percentile of health checks meanwhile, milliseconds.
    pub(super) health_p99: f64,
    /// Memory after a tenth of the time, in the middle and at the end, MiB.
    pub(super) memory: [f64; 3],
}

/// Many clients that call again as soon as the previous call is answered or rejected. `pid` is the process of the service.
pub(super) async fn flood(url: &str, pid: u32, teams: &[v1::AssignRequest], seconds: u32) -> anyhow::Result<Flood> {
    let span = Duration::from_secs(seconds.into());
    let until = Instant::now() + span;
    let counts: Arc<[AtomicU64; 3]> = Arc::default();
    let mut tasks = Vec::new();
    for k in 0..FLOODERS {
        let (mut client, teams, counts) = (connect(url).await?, teams.to_vec(), counts.clone());
        tasks.push(tokio::spawn(async move {
            let mut call = k;
            while Instant::now() < until {
                call += 1;
                let place = match client.assign(teams[call % teams.len()].clone()).await {
                    Ok(_) => 0,
                    Err(status) if status.code() == Code::ResourceExhausted => 1,
                    Err(_) => 2,
                };
                counts[place].fetch_add(1, Ordering::Relaxed);
            }
        }));
    }
    let mut health = tonic_health::pb::health_client::HealthClient::new(client::endpoint(url)?.connect().await?);
    let (mut times, mut memory) = (Vec::new(), [0.0; 3]);
    while Instant::now() < until {
        let start = Instant::now();
        health.check(tonic_health::pb::HealthCheckRequest::default()).await?;
        times.push(start.elapsed().as_secs_f64() * 1e3);
        let left = until.saturating_duration_since(Instant::now());
        for (slot, at) in memory.iter_mut().zip([0.9, 0.5, 0.05]) {
            if *slot == 0.0 && left < span.mul_f64(at) {
                *slot = memory_mib(pid, "VmRSS:");
            }
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    for task in tasks {
        task.await?;
    }
    let count = |place: usize| counts[place].load(Ordering::Relaxed);
    let (answered, exhausted, wrong) = (count(0), count(1), count(2));
    Ok(Flood { answered, exhausted, wrong, health_p99: quantile(&mut times, 0.99), memory })
}
