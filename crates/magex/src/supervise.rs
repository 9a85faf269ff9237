//! `magex train` with services: a learner, a commander and actors as supervised child processes.
//!
//! A service that crashes is restarted: the learner continues from its checkpoint on the same port, the others reconnect,
//! and the result is the same. The services hold a pipe to this process and stop when it ends.

pub mod service;
mod watching;

use crate::external::VARIABLES;
use crate::output::note;
use crate::progress::Progress;
use anyhow::Context as _;
use magex_learner::run_lock::RunLock;
use magex_learner::trainer::TrainError;
use magex_proto::v1;
use magex_proto::v1::learner_service_client::LearnerServiceClient;
use magex_runtime::{client, exit};
use service::{Running, Service, code_of, keep};
use std::os::fd::{AsFd as _, AsRawFd as _};
use std::path::Path;
use std::process::ExitStatus;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio::task::{JoinHandle, JoinSet};
use tokio_util::sync::CancellationToken;
use watching::{is_new, show_shards, watch};

/// The learner may die this often without completing an iteration in between.
const LIVES: u32 = 4;

/// After this time without an event the run says what it waits for.
const SILENCE: Duration = Duration::from_secs(15);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum TrainEnd {
    /// Target reached or budget spent; summary.json exists.
    Finished,
    /// Stopped before the end; the run can be resumed.
    Stopped,
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct ActorPlan {
    pub(crate) actors: usize,
    /// Rollout threads of each.
    pub(crate) threads: usize,
}

/// The run that the services train.
#[derive(Debug)]
pub(crate) struct ServicesPlan<'a> {
    /// Run folder with a checkpoint.
    pub(crate) folder: &'a Path,
    /// The lock of the folder, which the learner gets, too.
    pub(crate) lock: &'a RunLock,
    pub(crate) threads: usize,
    /// Address of the live page, if there is one.
    pub(crate) http: Option<&'a str>,
    pub(crate) actors: ActorPlan,
    /// An actor's options for its environment.
    pub(crate) environment: &'a [String],
    /// Whether there are goals to assign.
    pub(crate) commander: bool,
}

/// Trains on services of this machine until the run is complete or interrupted.
pub(crate) async fn run(
    plan: &ServicesPlan<'_>,
    interrupted: &CancellationToken,
    progress: &mut Progress,
) -> anyhow::Result<TrainEnd> {
    let logs = &plan.folder.join("logs");
    std::fs::create_dir_all(logs).with_context(|| logs.display().to_string())?;
    let (out, threads) = (plan.folder.display().to_string(), plan.threads.to_string());
    let descriptor = plan.lock.as_fd().as_raw_fd().to_string();
    let learner = |listen: &str, http: Option<&str>| {
        let own: [&str; 10] = [
            "learner",
            "--resume",
            "--out",
            &out,
            "--threads",
            &threads,
            "--listen",
            listen,
            "--lock-descriptor",
            &descriptor,
        ];
        let page = http.map(|http| ["--http", http]);
        let arguments: Vec<&str> = own.into_iter().chain(page.into_iter().flatten()).collect();
        Service::new("learner", &arguments, logs).inherit(plan.lock.as_fd())
    };
    if interrupted.is_cancelled() {
        return Ok(TrainEnd::Stopped);
    }
    let mut running = learner("127.0.0.1:0", plan.http).start().await?;
    if interrupted.is_cancelled() {
        running.stop().await;
        return Ok(TrainEnd::Stopped);
    }
    // A restarted learner listens on the same ports, so that the other services and the page find it again.
    let learner = learner(&running.address, running.http.as_deref());
    if let Some(http) = &running.http {
        progress.page(http);
    }
    let url = format!("http://{}", running.address);
    let commander =
        |listen: &str| Service::new("commander", &["commander", "--learner", &url, "--listen", listen], logs);
    let mut lives = LIVES;
    // The commander is ready with the first weights: a learner that ends before (a complete run has no work) never sends any.
    let unbound = commander("127.0.0.1:0");
    let first = loop {
        if !plan.commander {
            break None;
        }
        let status = tokio::select! {
            started = unbound.start() => break Some(started?),
            status = running.wait() => status?,
            () = interrupted.cancelled() => {
                running.stop().await;
                return Ok(TrainEnd::Stopped);
            }
        };
        if let Some(end) = ended(plan, &learner, &running, status, &mut lives)? {
            return Ok(end);
        }
        running = learner.restart(&mut lives, pauses()).await?;
    };
    let commander_url = first.as_ref().map(|first| format!("http://{}", first.address));
    tracing::debug!(learner = url, commander = commander_url, "services");

    let stop = CancellationToken::new();
    let mut services = JoinSet::new();
    if let Some(first) = first {
        services.spawn(keep(commander(&first.address), first, stop.clone()));
    }
    for index in 0..plan.actors.actors {
        let (name, threads) = (format!("actor-{index}"), plan.actors.threads.to_string());
        let mut arguments = vec!["actor", "--name", &name, "--learner", &url, "--threads", &threads];
        arguments.extend(commander_url.iter().flat_map(|url| ["--commander", url]));
        arguments.extend(plan.environment.iter().map(String::as_str));
        let variables: &[&str] = if plan.environment.is_empty() { &[] } else { &VARIABLES };
        let actor = Service::new(&name, &arguments, logs).unawaited().with_variables(variables);
        let first = actor.start().await?;
        services.spawn(keep(actor, first, stop.clone()));
    }

    let (sender, mut events) = mpsc::channel(64);
    let watching = tokio::spawn(watch(url.clone(), sender));
    let showing = progress.live().map(|live| tokio::spawn(show_shards(url.clone(), live)));
    let (mut draining, mut shown) = (false, None);
    let mut quiet = tokio::time::interval(SILENCE);
    quiet.reset();
    let end = loop {
        tokio::select! {
            Some(event) = events.recv() => {
                quiet.reset();
                if is_new(&event, &mut shown) {
                    progress.event(&event);
                    lives = LIVES;
                }
            }
            _ = quiet.tick() => tell_what_is_missing(&url, logs).await,
            status = running.wait() => {
                match ended(plan, &learner, &running, status?, &mut lives) {
                    Ok(None) => {}
                    end => break end.map(|end| end.unwrap_or(TrainEnd::Stopped)),
                }
                running = learner.restart(&mut lives, pauses()).await?;
            },
            Some(ended) = services.join_next() => {
                if let Err(error) = ended.map_err(anyhow::Error::from).and_then(|result| result) {
                    running.stop().await;
                    break Err(error);
                }
            }
            () = interrupted.cancelled(), if !draining => {
                draining = true;
                plan.lock.stopping();
                progress.status("stopping after this iteration");
                note("finishing the iteration, then writing a checkpoint");
                if let Err(error) = drain(&url).await {
                    tracing::warn!(%error, "the drain request failed; stopping the learner");
                    running.terminate();
                }
            }
        }
    };
    // The last events of the learner may still be in transit.
    let rest = async {
        while let Some(event) = events.recv().await {
            if is_new(&event, &mut shown) {
                progress.event(&event);
            }
        }
    };
    let _ = tokio::time::timeout(Duration::from_millis(100), rest).await;
    watching.abort();
    showing.inspect(JoinHandle::abort);
    stop.cancel();
    while services.join_next().await.is_some() {}
    end
}

/// The time before each attempt at a restart.
fn pauses() -> impl FnMut() -> Duration {
    let mut millis = 200;
    move || Duration::from_millis(std::mem::replace(&mut millis, 1000))
}

/// How the training ended with its learner; `None` if the learner is to continue from its checkpoint.
fn ended(
    plan: &ServicesPlan<'_>,
    learner: &Service<'_>,
    running: &Running,
    status: ExitStatus,
    lives: &mut u32,
) -> anyhow::Result<Option<TrainEnd>> {
    if !plan.folder.is_dir() {
        return Err(TrainError::Gone(plan.folder.to_owned()).into());
    }
    let (code, reason) = (code_of(status), running.failure(status));
    match code {
        Some(exit::OK) => return Ok(Some(TrainEnd::Finished)),
        Some(exit::TEMPORARY) => return Ok(Some(TrainEnd::Stopped)),
        _ => *lives -= 1,
    }
    if *lives == 0 || matches!(code, Some(exit::USAGE | exit::CANNOT_CREATE)) {
        return Err(learner.gave_up(code, &reason));
    }
    tracing::warn!(reason, "the learner died; restarting it from its checkpoint");
    Ok(None)
}

/// Why nothing has happened for [`SILENCE`], if the learner waits for actors: the last words of an actor.
async fn tell_what_is_missing(url: &str, logs: &Path) {
    let status = async {
        let mut client = LearnerServiceClient::new(client::endpoint(url)?.connect().await?);
        anyhow::Ok(client.get_run(v1::GetRunRequest {}).await?.into_inner().run.unwrap_or_default())
    };
    let waits = match tokio::time::timeout(Duration::from_secs(3), status).await {
        Ok(Ok(status)) if status.state() != v1::RunState::WaitingForActors => return,
        Ok(Ok(_)) => "no actor is connected to the learner".to_owned(),
        Ok(Err(error)) => format!("the learner does not answer: {error:#}"),
        Err(_) => "the learner does not answer".to_owned(),
    };
    let log = std::fs::read_to_string(logs.join("actor-0.log")).unwrap_or_default();
    let (silent_s, actor) = (SILENCE.as_secs(), log.lines().next_back().unwrap_or_default());
    tracing::warn!(silent_s, actor, logs = %logs.display(), "{waits}");
}

async fn drain(url: &str) -> anyhow::Result<()> {
    let call = async {
        let mut client = LearnerServiceClient::new(client::endpoint(url)?.connect().await?);
        client.drain(v1::DrainRequest { reason: "interrupted".into() }).await?;
        anyhow::Ok(())
    };
    tokio::time::timeout(Duration::from_secs(3), call).await?
}
