//! A learner that only ingests, as a process: the real service, and in place of the trainer a loop that opens one plan after
//! the other and drops the results.

use super::load::Load;
use crate::vitals::memory_mib;
use anyhow::{Context as _, anyhow};
use magex_learner::collector::Collector as _;
use magex_learner::run_events::CollectError;
use magex_learner::run_identity::RunIdentity;
use magex_learner::serve::service::{DEFAULT_LEASE, learner_service};
use magex_learner::serve::validate::Limits;
use magex_runtime::{exit, process, server, shutdown};
use rustix::process::{Pid, Signal, kill_process};
use std::process::Stdio;
use std::time::{Duration, Instant};
use tokio::io::{AsyncBufReadExt as _, BufReader};
use tokio::process::{Child, Command};

/// Options of the hidden role.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct IngestArgs {
    #[arg(long)]
    agents: usize,
    #[arg(long)]
    episodes: u32,
}

/// Serves until it is stopped.
pub(crate) fn serve(args: &IngestArgs) -> anyhow::Result<u8> {
    let load = Load::new(args.agents, args.episodes);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    runtime.block_on(async {
        let stop = shutdown::on_signal()?;
        let run = RunIdentity {
            run_id: load.weights.run_id.clone(),
            name: "ingest".into(),
            task_fingerprint: load.task.fingerprint(),
            run_config_toml: String::new(),
            seed: 0,
            lease: DEFAULT_LEASE,
        };
        let limits = Limits { max_actors: 1024, ..Limits::for_task(&load.task, args.episodes as usize) };
        let (handle, mut collector) = learner_service(run, limits);
        let (incoming, address) = server::bind("127.0.0.1:0").await?;
        process::announce_ready("learner", Some(address), None);
        let serving = tokio::spawn(async move { handle.serve(incoming, stop).await });
        let (weights, plan) = (load.weights.clone(), load.plan.clone());
        let trainer = std::thread::spawn(move || -> Result<(), CollectError> {
            collector.publish(&weights)?;
            loop {
                match collector.collect(plan.clone()) {
                    Ok(results) => drop(results),
                    Err(CollectError::Stopped(_)) => return Ok(()),
                    Err(error) => return Err(error),
                }
            }
        });
        serving.await??;
        trainer.join().map_err(|_| anyhow!("the collecting thread died"))??;
        anyhow::Ok(())
    })?;
    runtime.shutdown_background();
    Ok(exit::OK)
}

/// The learner process.
pub(crate) struct Learner {
    child: Child,
    pub(crate) url: String,
}

impl Learner {
    pub(crate) async fn start(load: &Load) -> anyhow::Result<Self> {
        let (agents, episodes) = (load.task.agents.to_string(), load.plan.first().map_or(1, |shard| shard.episodes));
        let mut child = Command::new(std::env::current_exe()?)
            .args(["ingest", "--agents", &agents, "--episodes", &episodes.to_string()])
            .env("RUST_LOG", "error")
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .kill_on_drop(true)
            .spawn()?;
        let stdout = child.stdout.take().context("it has no standard output")?;
        let line = BufReader::new(stdout).lines().next_line().await?.unwrap_or_default();
        let ready: serde_json::Value = serde_json::from_str(&line).unwrap_or_default();
        let address = ready["address"].as_str().ok_or_else(|| anyhow!("the learner did not start"))?;
        Ok(Self { url: format!("http://{address}"), child })
    }

    /// Peak memory in MiB.
    pub(crate) fn peak_mib(&self) -> f64 {
        memory_mib(self.child.id().unwrap_or_default(), "VmHWM:")
    }

    /// Sends SIGTERM; returns the time until the process ended.
    pub(crate) async fn stop(&mut self) -> anyhow::Result<Duration> {
        let pid = self.child.id().and_then(|id| Pid::from_raw(id as i32)).context("the learner has ended")?;
        let start = Instant::now();
        kill_process(pid, Signal::TERM)?;
        self.child.wait().await?;
        Ok(start.elapsed())
    }
}
