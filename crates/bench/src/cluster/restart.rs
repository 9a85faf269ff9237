//! A learner that is killed while real processes train, and started again.

use crate::fleet::Fleet;
use magex_core::config::{ExecutorKind, RunConfig};
use magex_core::task::{Spawn, TaskConfig};
use magex_proto::v1;
use magex_proto::v1::learner_service_client::LearnerServiceClient;
use magex_proto::v1::watch_run_response::Event;
use magex_runtime::client;
use std::path::Path;
use std::time::{Duration, Instant};

/// Iterations between two kills.
const BETWEEN: u32 = 5;

/// Seconds from each SIGKILL to the first iteration that the next process completes; it is started at once.
pub(super) fn measure(place: &Path, kills: u32) -> anyhow::Result<Vec<f64>> {
    let mut config = RunConfig { task: TaskConfig::simple_spread(50, Spawn::Lines(None)), ..RunConfig::default() };
    config.executor.kind = ExecutorKind::Magex;
    // Never done.
    (config.run.target_success, config.run.max_steps) = (2.0, 1_000_000_000);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
    let times = runtime.block_on(async {
        let mut fleet = Fleet::start(&config, place, 2).await?;
        let mut times = Vec::new();
        iterations(fleet.learner_url(), BETWEEN).await?;
        for _ in 0..kills {
            let start = Instant::now();
            fleet.kill_learner().await?;
            fleet.resume_learner().await?;
            iterations(fleet.learner_url(), 1).await?;
            times.push(start.elapsed().as_secs_f64());
            iterations(fleet.learner_url(), BETWEEN).await?;
        }
        fleet.stop().await;
        anyhow::Ok(times)
    });
    runtime.shutdown_background();
    times
}

/// Waits for `count` iterations of the learner at `url`.
async fn iterations(url: String, count: u32) -> anyhow::Result<()> {
    let watching = async {
        let mut client = LearnerServiceClient::new(client::endpoint(&url)?.connect().await?);
        let mut events = client.watch_run(v1::WatchRunRequest {}).await?.into_inner();
        let mut seen = 0;
        while seen < count {
            match events.message().await? {
                Some(message) => seen += u32::from(matches!(message.event, Some(Event::Iteration(_)))),
                None => anyhow::bail!("the learner ended"),
            }
        }
        Ok(())
    };
    tokio::time::timeout(Duration::from_secs(120), watching).await?
}
