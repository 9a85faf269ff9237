//! Clients of the commander: one that measures latency, many that produce load.

use crate::stats::quantile;
use anyhow::{Context as _, bail};
use magex_proto::v1;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use magex_runtime::client;
use std::time::{Duration, Instant};
use tonic::transport::Channel;

/// Connections and calls in flight on each, of the throughput rows.
const CONNECTIONS: usize = 4;
const IN_FLIGHT: usize = 8;

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
