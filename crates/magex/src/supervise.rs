//! `magex train` with services: a learner, a commander and actors as processes of this machine, watched over.
//!
//! Whatever crashes is started again: the learner continues from its checkpoint on the same port, the others find it
//! again by themselves, and the result is the same. The services hold a pipe to this process and stop when it is gone.

pub(crate) mod service;

use crate::commands::train::{End, Job, trainer};
use crate::failure::coded;
use crate::output::note;
use crate::progress::Progress;
use anyhow::Context as _;
use magex_core::ids::Iteration;
use magex_learner::run_events::{IterationReport, RunEvent};
use magex_proto::v1;
use magex_proto::v1::learner_service_client::LearnerServiceClient;
use magex_proto::v1::watch_run_response::Event;
use magex_runtime::{client, exit, shutdown};
use service::{Service, keep};
use std::process::ExitStatus;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

/// The learner may die this often without completing an iteration in between.
const LIVES: u32 = 4;

/// Rollout threads and processes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Crew {
    /// Actor processes.
    pub(crate) actors: usize,
    /// Threads of each.
    pub(crate) threads: usize,
}

/// Runs a job on services of this machine.
pub(crate) fn run(job: &Job, crew: Crew, progress: &mut Progress) -> anyhow::Result<End> {
    // The run begins, or is checked, here: what is wrong with it is said to the person, not to a log file, and the
    // learner always continues from a checkpoint, the first time like any other.
    drop(trainer(job)?);
    let logs = job.folder.join("logs");
    std::fs::create_dir_all(&logs).with_context(|| logs.display().to_string())?;
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
    let end = runtime.block_on(supervise(job, crew, progress));
    runtime.shutdown_background();
    end
}

async fn supervise(job: &Job, crew: Crew, progress: &mut Progress) -> anyhow::Result<End> {
    let interrupted = shutdown::on_signal()?;
    let logs = job.folder.join("logs");
    let service = |name: &str, arguments: &[&str]| Service::new(name, arguments, &logs);
    let (out, threads) = (job.folder.display().to_string(), job.threads.to_string());
    let learner = |listen: &str, http: Option<&str>| {
        let own: [&str; 8] = ["learner", "--resume", "--out", &out, "--threads", &threads, "--listen", listen];
        let page = http.map(|http| ["--http", http]);
        service("learner", &own.into_iter().chain(page.into_iter().flatten()).collect::<Vec<_>>())
    };
    let mut running = learner("127.0.0.1:0", job.http.as_deref())?.start().await?;
    let (address, http) = (running.address.clone(), running.http.clone());
    if let Some(http) = &http {
        progress.page(http);
    }
    let url = format!("http://{address}");
    let commander = service("commander", &["commander", "--learner", &url, "--listen", "127.0.0.1:0"])?.start().await?;
    let commander_url = format!("http://{}", commander.address);
    tracing::debug!(learner = url, commander = commander_url, "services");

    let stop = CancellationToken::new();
    let mut helpers = JoinSet::new();
    let again = service("commander", &["commander", "--learner", &url, "--listen", &commander.address])?;
    helpers.spawn(keep(again, commander, stop.clone()));
    for index in 0..crew.actors {
        let (name, threads) = (format!("actor-{index}"), crew.threads.to_string());
        let arguments =
            ["actor", "--name", &name, "--learner", &url, "--commander", &commander_url, "--threads", &threads];
        let actor = service(&name, &arguments)?;
        let first = actor.start().await?;
        helpers.spawn(keep(actor, first, stop.clone()));
    }

    let (sender, mut events) = mpsc::channel(64);
    let watching = tokio::spawn(watch(url.clone(), sender));
    let (mut lives, mut draining, mut shown) = (LIVES, false, (0, false));
    let end = loop {
        tokio::select! {
            Some(event) = events.recv() => {
                if is_new(&event, &mut shown) {
                    progress.event(&event);
                    lives = LIVES;
                }
            }
            status = running.wait() => match code_of(status?) {
                (Some(exit::OK), _) => break Ok(End::Finished),
                (Some(exit::TEMPORARY), _) => break Ok(End::Stopped),
                (code, status) => {
                    lives -= 1;
                    let reason = running.last_words(status);
                    if lives == 0 || code.is_some_and(|code| [exit::USAGE, exit::CANNOT_CREATE].contains(&code)) {
                        let code = code.unwrap_or(exit::FAILURE);
                        break Err(coded(code, format!("the learner failed: {reason} (log: {out}/logs/learner.log)")));
                    }
                    tracing::warn!(reason, "the learner died; starting it again from its checkpoint");
                    tokio::time::sleep(Duration::from_millis(200)).await;
                    // A start that fails (killed again, the port still taken) costs a life like any other death.
                    running = loop {
                        match learner(&address, http.as_deref())?.start().await {
                            Ok(running) => break running,
                            Err(error) if lives <= 1 => return Err(error),
                            Err(error) => {
                                lives -= 1;
                                tracing::warn!(%error, "the learner could not be started; trying again");
                                tokio::time::sleep(Duration::from_secs(1)).await;
                            }
                        }
                    };
                }
            },
            Some(helper) = helpers.join_next() => {
                if let Err(error) = helper.map_err(anyhow::Error::from).and_then(|result| result) {
                    running.stop().await;
                    break Err(error);
                }
            }
            () = interrupted.cancelled(), if !draining => {
                draining = true;
                progress.status("finishing the iteration, then writing a checkpoint");
                note("finishing the iteration, then writing a checkpoint");
                if let Err(error) = drain(&url).await {
                    tracing::warn!(%error, "the learner cannot be asked to drain; stopping it");
                    running.terminate();
                }
            }
        }
    };
    // What the learner said last is still on its way.
    let rest = async {
        while let Some(event) = events.recv().await {
            if is_new(&event, &mut shown) {
                progress.event(&event);
            }
        }
    };
    watching_ends(watching, rest).await;
    stop.cancel();
    while helpers.join_next().await.is_some() {}
    end
}

/// Takes in what is left of the events: the stream ends with the learner.
async fn watching_ends(watching: tokio::task::JoinHandle<()>, rest: impl Future<Output = ()>) {
    let _ = tokio::time::timeout(Duration::from_millis(100), rest).await;
    watching.abort();
}

/// The exit code, unless it was killed by a signal.
fn code_of(status: ExitStatus) -> (Option<u8>, ExitStatus) {
    (status.code().and_then(|code| u8::try_from(code).ok()), status)
}

/// A learner that was started again, and a stream that broke, tell of iterations that were shown before.
fn is_new(event: &RunEvent, shown: &mut (u32, bool)) -> bool {
    let RunEvent::Iteration(report) = event else { return true };
    let trained =
        serde_json::from_str::<serde_json::Value>(&report.metrics_json).is_ok_and(|v| !v["executor"].is_null());
    // The last line only evaluates: it has the number of the line before it.
    let place = (report.iteration.0, !trained);
    let new = place > *shown;
    *shown = place.max(*shown);
    new
}

async fn drain(url: &str) -> anyhow::Result<()> {
    let call = async {
        let mut client = LearnerServiceClient::new(client::endpoint(url)?.connect().await?);
        client.drain(v1::DrainRequest { reason: "interrupted".into() }).await?;
        anyhow::Ok(())
    };
    tokio::time::timeout(Duration::from_secs(3), call).await?
}

/// Follows the run, across restarts of the learner.
async fn watch(url: String, events: mpsc::Sender<RunEvent>) {
    while !events.is_closed() {
        if let Err(error) = follow(&url, &events).await {
            tracing::debug!("the learner's events: {error:#}");
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

async fn follow(url: &str, events: &mpsc::Sender<RunEvent>) -> anyhow::Result<()> {
    let mut client = LearnerServiceClient::new(client::endpoint(url)?.connect().await?);
    let opened = tokio::time::timeout(Duration::from_secs(10), client.watch_run(v1::WatchRunRequest {})).await;
    let mut stream = opened??.into_inner();
    while let Some(message) = stream.message().await? {
        let event = match message.event {
            Some(Event::Iteration(e)) => RunEvent::Iteration(IterationReport {
                iteration: Iteration(e.iteration),
                joint_env_steps: e.joint_env_steps,
                success: e.success,
                reward: e.reward,
                metrics_json: e.metrics_json,
            }),
            Some(Event::Log(text)) => RunEvent::Log(text),
            Some(Event::Checkpoint(e)) => RunEvent::Checkpoint { iteration: Iteration(e.iteration), path: e.path },
            Some(Event::Finished(e)) => RunEvent::Finished { summary_json: e.summary_json },
            None => continue,
        };
        events.send(event).await?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn event(iteration: u32, executor: &str) -> RunEvent {
        RunEvent::Iteration(IterationReport {
            iteration: Iteration(iteration),
            joint_env_steps: 0,
            success: None,
            reward: None,
            metrics_json: format!("{{\"executor\":{executor}}}"),
        })
    }

    #[test]
    fn iterations_that_are_done_again_are_shown_once() {
        let mut shown = (0, false);
        let told = [(1, "{}"), (2, "{}"), (1, "{}"), (2, "{}"), (3, "{}"), (3, "null"), (3, "null")];
        let new: Vec<bool> = told.iter().map(|(i, e)| is_new(&event(*i, e), &mut shown)).collect();
        assert_eq!(new, [true, true, false, false, true, true, false]);
    }
}
