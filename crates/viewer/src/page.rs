//! The live page of a run: one HTML file without external assets, and the JSON that its script requests.
//!
//! Training never waits for a viewer: the training thread stores updates in [`LivePage`], and requests copy them. Memory and
//! the number of concurrent requests are bounded.

mod points;
mod routes;
#[cfg(test)]
mod tests;

use crate::scene::Scene;
use axum::body::Bytes;
use magex_core::config::{COLLISIONS_ANY, RunConfig};
use magex_core::ids::RunId;
use magex_core::metrics_table::as_written;
use magex_core::trajectory::EvalOutcome;
use magex_proto::v1;
use magex_proto::weights::Weights;
use magex_runtime::sync::lock;
use points::Points;
use serde::Serialize;
use serde_json::{Value, json};
use std::io::BufRead as _;
use std::path::Path;
use std::sync::Mutex;
use std::time::{Duration, Instant};
use tokio::sync::{Semaphore, watch};

/// Limit of concurrent requests; further ones are rejected with 503 and a retry delay.
const VIEWERS: usize = 64;

/// The state of the run is serialised at most this often, whatever the number of viewers.
const FRESH: Duration = Duration::from_millis(100);

/// Longest wait at the end of a run for viewers to fetch its last state.
const FAREWELL: Duration = Duration::from_secs(2);
/// Viewers that sent no request for this time have fetched everything or have disconnected.
const QUIET: Duration = Duration::from_millis(500);

/// What the training thread is doing.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Phase {
    /// Training has not begun.
    #[default]
    Starting,
    /// Waiting for training episodes.
    Collecting,
    /// Waiting for evaluation episodes.
    Evaluating,
    /// Updating.
    Training,
}

/// How a run ended in this process.
#[derive(Debug, Clone, PartialEq)]
pub enum RunEnd {
    /// Target reached or budget spent; with the content of `summary.json`.
    Finished(Value),
    /// Stopped before the end, with the reason; the run can be resumed.
    Stopped(String),
    /// Failed, with the error.
    Failed(String),
}

/// Properties of a run that do not change.
#[derive(Debug, Clone, Default)]
pub struct RunInfo {
    /// Display name of the run.
    pub name: String,
    /// Address that actors connect to; `None` if everything runs in one process.
    pub learner: Option<String>,
    /// Silence after which an actor loses its leases.
    pub lease: Option<Duration>,
}

/// State of the run as the training thread reports it.
#[derive(Debug, Default)]
struct Run {
    run_id: String,
    folder: String,
    phase: Phase,
    /// How it ended: name of the state, and a reason if there is one.
    end: Option<(&'static str, Option<String>)>,
    version: Option<u32>,
    sha256: String,
    latest: Value,
    summary: Value,
}

/// A serialised episode and its entity tag.
#[derive(Debug, Clone)]
struct Episode {
    tag: String,
    body: Bytes,
}

#[derive(Debug)]
struct Snapshot {
    made: Instant,
    over: bool,
    body: Bytes,
}

/// Everything the page shows; shared by the training thread and the request handlers.
#[derive(Debug)]
pub struct LivePage {
    /// Identifies this process, so that a page notices a restarted learner.
    process: String,
    started: Instant,
    info: RunInfo,
    task: Value,
    scene: Scene,
    run: Mutex<Run>,
    points: Mutex<Points>,
    episode: Mutex<Option<Episode>>,
    snapshot: Mutex<Option<Snapshot>>,
    /// Incremented by every change of the fields above.
    revision: watch::Sender<u64>,
    viewers: Semaphore,
    asked: Mutex<Option<Instant>>,
}

impl LivePage {
    /// The page of a run.
    pub fn new(config: &RunConfig, info: RunInfo) -> Self {
        let (task, run) = (&config.task, &config.run);
        // As it was written; null if the run does not end with it.
        let target = |value: f32, asked: bool| (asked && run.target_success <= 1.0).then(|| as_written(value.into()));
        let words = json!({
            "name": task.name.to_string(),
            "environment": task.external().ok().map(|external| &external.environment), "agents": task.agents, "spawn": task.spawn.to_string(),
            "horizon": task.horizon, "executor": config.executor.kind.to_string(),
            "scheduler": config.commander.kind.to_string(), "seed": run.seed, "max_steps": run.max_steps,
            "target_success": target(run.target_success, run.target_success <= 1.0),
            "target_sampled_success": target(run.target_sampled_success, run.target_sampled_success > 0.0),
            "target_collisions": target(run.target_collisions, run.target_collisions < COLLISIONS_ANY),
            "eval_every": run.eval_every,
            "max_iterations": config.max_iterations(), "steps_per_iteration": config.steps_per_iteration(),
        });
        Self {
            process: format!("{:016x}", magex_runtime::backoff::random_id()),
            started: Instant::now(),
            info,
            task: words,
            scene: Scene::of(task),
            run: Mutex::default(),
            points: Mutex::default(),
            episode: Mutex::default(),
            snapshot: Mutex::default(),
            revision: watch::Sender::new(1),
            viewers: Semaphore::new(VIEWERS),
            asked: Mutex::default(),
        }
    }

    /// Loads the metrics that earlier processes of the run wrote. If the file cannot be read, the curves start empty.
    pub fn begin(&self, run_id: &RunId, folder: &Path) {
        self.change(|run| {
            run.run_id.clone_from(&run_id.0);
            run.folder = folder.display().to_string();
        });
        let path = folder.join("metrics.jsonl");
        match std::fs::File::open(&path) {
            Ok(file) => std::io::BufReader::new(file).lines().map_while(Result::ok).for_each(|line| self.line(&line)),
            Err(error) => {
                tracing::warn!(path = %path.display(), %error, "metrics of earlier processes cannot be read; the curves start empty")
            }
        }
    }

    /// Adds a line of metrics.jsonl.
    pub fn line(&self, line: &str) {
        let Ok(value) = serde_json::from_str::<Value>(line) else { return };
        lock(&self.points).push(&value);
        self.change(|run| run.latest = value);
    }

    /// Sets what the training thread is doing.
    pub fn phase(&self, phase: Phase) {
        self.change(|run| run.phase = phase);
    }

    /// Sets the version of the weights that actors use.
    pub fn published(&self, weights: &Weights) {
        self.change(|run| (run.version, run.sha256) = (Some(weights.version.0), weights.sha256.clone()));
    }

    /// Shows the first recorded episode among the outcomes, if there is one.
    pub fn evaluated(&self, outcomes: &[EvalOutcome]) {
        let Some((outcome, recording)) = outcomes.iter().find_map(|o| Some((o, o.recording.as_ref()?))) else { return };
        let version = outcome.shard.version.0;
        let name = format!("version {version}, episode {}", outcome.shard.first_episode + 1);
        let packed = match self.scene.pack(name, recording, outcome.metrics.first()) {
            Ok(packed) => packed,
            Err(error) => {
                tracing::warn!(%error, "an evaluation episode cannot be drawn");
                return;
            }
        };
        let tag = format!("{}-{version}-{}", self.process, outcome.shard.eval_set);
        let value = json!({ "tag": tag, "version": version, "scene": self.scene, "episode": packed });
        *lock(&self.episode) = Some(Episode { tag, body: value.to_string().into() });
        self.change(|_| ());
    }

    /// Shows how the run ended.
    pub fn ended(&self, end: RunEnd) {
        self.change(|run| {
            run.end = Some(match end {
                RunEnd::Finished(summary) => {
                    run.summary = summary;
                    ("finished", None)
                }
                RunEnd::Stopped(reason) => ("stopped", Some(reason)),
                RunEnd::Failed(error) => ("failed", Some(error)),
            });
        });
    }

    /// Waits until connected viewers have fetched the end of the run; without viewers it returns at once. Call it after
    /// [`Self::ended`] and before the server stops.
    pub async fn farewell(&self) {
        let start = Instant::now();
        let busy = || {
            self.viewers.available_permits() < VIEWERS || lock(&self.asked).is_some_and(|last| last.elapsed() < QUIET)
        };
        while busy() && start.elapsed() < FAREWELL {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }

    fn change(&self, change: impl FnOnce(&mut Run)) {
        change(&mut lock(&self.run));
        self.revision.send_modify(|revision| *revision += 1);
    }

    /// Waits for a revision newer than `after`: at least `gap`, at most `hold`. Returns at once when the run has ended,
    /// because the process may exit a moment later.
    async fn news(&self, after: u64, gap: Duration, hold: Duration) {
        let mut revision = self.revision.subscribe();
        let over = |_: &u64| lock(&self.run).end.is_some();
        if self.current() > after && over(&after) {
            return;
        }
        let start = tokio::time::Instant::now();
        let _ = tokio::time::timeout_at(start + gap, revision.wait_for(over)).await;
        let _ = tokio::time::timeout_at(start + hold, revision.wait_for(|&now| now > after)).await;
    }

    fn current(&self) -> u64 {
        *self.revision.borrow()
    }

    /// The rows of the curves after line `after`; all of them if `process` is not this process.
    fn curve(&self, process: &str, after: u64) -> Bytes {
        let after = if process == self.process { after } else { 0 };
        // Copied under the lock and serialised without it, so that the training thread does not wait.
        let rows = lock(&self.points).after(&self.process, after);
        serde_json::to_vec(&rows).unwrap_or_default().into()
    }

    /// State of the run as JSON. `status` comes from the learner's service; `None` if everything runs in one process.
    fn state(&self, status: impl FnOnce() -> Option<v1::RunStatus>) -> Bytes {
        let over = lock(&self.run).end.is_some();
        let mut snapshot = lock(&self.snapshot);
        if let Some(last) = snapshot.as_ref().filter(|last| last.over == over && last.made.elapsed() < FRESH) {
            return last.body.clone();
        }
        let body = Bytes::from(self.describe(status()).to_string());
        *snapshot = Some(Snapshot { made: Instant::now(), over, body: body.clone() });
        body
    }

    fn describe(&self, status: Option<v1::RunStatus>) -> Value {
        // Read first: a change during this function yields a newer revision, which the page requests again.
        let revision = self.current();
        let points = lock(&self.points).last();
        let episode = lock(&self.episode).as_ref().map(|episode| episode.tag.clone());
        let run = lock(&self.run);
        let (state, reason) = match (&run.end, &status) {
            (Some((state, reason)), _) => (json!(state), reason.clone()),
            (None, Some(status)) => (json!(state_name(status.state())), None),
            (None, None) => (json!(run.phase), None),
        };
        let mut value = json!({
            "process": self.process, "revision": revision, "run_id": run.run_id, "folder": run.folder, "name": self.info.name,
            "learner": self.info.learner, "lease_s": self.info.lease.map(|lease| lease.as_secs_f64()),
            "task": self.task, "state": state, "reason": reason, "version": run.version, "weights_sha256": run.sha256,
            "uptime_s": self.started.elapsed().as_secs_f64(), "latest": run.latest, "summary": run.summary,
            "points": points, "episode": episode, "actors": null, "ledger": null, "shards_done": null, "shards_total": null,
        });
        if let Some(status) = status {
            value["actors"] = status.actors.iter().map(|actor| describe_actor(actor, run.version)).collect();
            value["ledger"] = status.ledger.as_ref().map_or(Value::Null, describe_ledger);
            value["shards_done"] = json!(status.shards_done);
            value["shards_total"] = json!(status.shards_total);
        }
        value
    }
}

fn describe_actor(actor: &v1::ActorStatus, version: Option<u32>) -> Value {
    let lag = version.zip(actor.weights_version).map(|(now, then)| now.saturating_sub(then));
    json!({
        "id": actor.actor_id, "address": actor.address, "threads": actor.threads, "leases": actor.leases,
        "shards_done": actor.shards_done, "last_seen_ms": actor.last_seen_ms, "lag": lag,
    })
}

fn describe_ledger(ledger: &v1::LedgerStatus) -> Value {
    let ended = [ledger.trained, ledger.duplicate, ledger.expired, ledger.rejected, ledger.failed, ledger.outstanding];
    let residual = i128::from(ledger.leased) - ended.into_iter().map(i128::from).sum::<i128>();
    json!({
        "leased": ledger.leased, "trained": ledger.trained, "duplicate": ledger.duplicate, "expired": ledger.expired,
        "rejected": ledger.rejected, "failed": ledger.failed, "outstanding": ledger.outstanding,
        "residual": residual as f64,
    })
}

/// The name of a state: `RUN_STATE_TRAINING` is `training`.
fn state_name(state: v1::RunState) -> String {
    match state {
        v1::RunState::Unspecified => "starting".to_owned(),
        state => state.as_str_name().trim_start_matches("RUN_STATE_").to_lowercase(),
    }
}
