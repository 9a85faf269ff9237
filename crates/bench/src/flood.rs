//! Many clients that call again as soon as the previous call is answered or rejected: what the service does under load.

use crate::report::Report;
use crate::stats::quantile;
use crate::vitals::memory_mib;
use magex::output::{note, thousands};
use magex_runtime::client;
use serde_json::json;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};
use tonic::transport::Channel;
use tonic::{Code, Status};

/// Clients, each with a connection of its own.
const CLIENTS: usize = 64;

/// What the clients and a check of the service's health saw.
pub(crate) struct Flood {
    answered: u64,
    exhausted: u64,
    /// Errors of any other kind.
    wrong: u64,
    /// 99th percentile of health checks meanwhile, milliseconds.
    health_p99: f64,
    /// Memory of the service after a tenth of the time, in the middle and at the end, MiB.
    memory: [f64; 3],
}

/// Floods for some seconds with `call`, which gets the channel and the number of the call. `pid` is the process of the service.
pub(crate) async fn flood<F>(
    url: &str,
    pid: u32,
    seconds: u32,
    call: impl Fn(Channel, usize) -> F + Clone + Send + 'static,
) -> anyhow::Result<Flood>
where
    F: Future<Output = Result<(), Status>> + Send,
{
    let span = Duration::from_secs(seconds.into());
    let until = Instant::now() + span;
    let counts: Arc<[AtomicU64; 3]> = Arc::default();
    let mut tasks = Vec::new();
    for k in 0..CLIENTS {
        let (channel, call, counts) = (client::endpoint(url)?.connect().await?, call.clone(), counts.clone());
        tasks.push(tokio::spawn(async move {
            let mut number = k;
            while Instant::now() < until {
                number += 1;
                let place = match call(channel.clone(), number).await {
                    Ok(()) => 0,
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

impl Flood {
    /// Adds a row of `what` was flooded with; errors of other kinds fail the report.
    pub(crate) fn report(&self, report: &mut Report, what: &str, seconds: u32) {
        let Self { answered, exhausted, wrong, health_p99, memory } = self;
        let [begin, middle, end] = memory;
        let measured = format!(
            "{} answers, {} RESOURCE_EXHAUSTED, {wrong} other errors; {begin:.0} → {middle:.0} → {end:.0} MiB; health p99 {health_p99:.1} ms",
            thousands(*answered as f64),
            thousands(*exhausted as f64),
        );
        let what = format!("{what}, {CLIENTS} clients for {seconds} s");
        note(format!("{what}: {measured}"));
        report.failed |= *wrong > 0;
        let value = json!({
            "what": what, "answered": answered, "exhausted": exhausted, "wrong": wrong, "health_p99_ms": health_p99, "mib": memory,
        });
        report.row(vec![what, measured, "0 others, flat, 25 ms".to_owned(), String::new()], value);
    }
}
