//! What the page shows, between the training thread that leaves it here and the requests that read it.

use super::curve::Curve;
use super::scene::Scene;
use axum::body::Bytes;
use magex_core::config::RunConfig;
use magex_core::ids::RunId;
use magex_core::trajectory::EvalOutcome;
use magex_proto::v1;
use magex_proto::weights::Weights;
use magex_runtime::sync::lock;
use serde_json::{Value, json};
use std::io::BufRead as _;
use std::path::Path;
use std::sync::Mutex;
use std::time::{Duration, Instant};
use tokio::sync::{Semaphore, watch};

/// Requests that are answered at once; the others are told to come again.
pub(super) const VIEWERS: usize = 64;

/// However many look, the state of the run is put together this often at most.
const FRESH: Duration = Duration::from_millis(100);

/// Whoever looked until the end is told of it, with what else there is to fetch, within this time.
const FAREWELL: Duration = Duration::from_secs(2);
/// A viewer that has not asked for so long has all that it wants, or is gone.
const QUIET: Duration = Duration::from_millis(500);

/// What the training thread is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    /// Not begun.
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

/// What the page says about a run that does not change.
#[derive(Debug, Clone, Default)]
pub struct RunInfo {
    /// Name of the run, for people.
    pub name: String,
    /// Where actors connect to; `None` if everything is in one process.
    pub learner: Option<String>,
    /// An actor that says nothing for so long loses its leases.
    pub lease: Option<Duration>,
}

/// How the run stands, as the training thread sees it.
#[derive(Debug)]
struct Run {
    run_id: String,
    phase: Phase,
    /// How it ended: the state's name, and a reason if there is one.
    end: Option<(&'static str, Option<String>)>,
    version: Option<u32>,
    sha256: String,
    latest: Value,
    summary: Value,
}

/// An episode, ready to be sent.
#[derive(Debug, Clone)]
pub(super) struct Episode {
    pub(super) tag: String,
    pub(super) body: Bytes,
}

#[derive(Debug)]
struct Snapshot {
    made: Instant,
    /// Of a run that has ended.
    over: bool,
    body: Bytes,
}

/// Everything the page shows. See the module's documentation.
#[derive(Debug)]
pub struct LivePage {
    /// Tells a page that the learner was started again.
    process: String,
    started: Instant,
    info: RunInfo,
    task: Value,
    scene: Scene,
    run: Mutex<Run>,
    curve: Mutex<Curve>,
    episode: Mutex<Option<Episode>>,
    snapshot: Mutex<Option<Snapshot>>,
    /// Changes with everything above.
    revision: watch::Sender<u64>,
    pub(super) viewers: Semaphore,
    /// When a viewer was answered last.
    asked: Mutex<Option<Instant>>,
}

impl LivePage {
    /// The page of a run.
    pub fn new(config: &RunConfig, info: RunInfo) -> Self {
        let (task, run) = (&config.task, &config.run);
        let words = json!({
            "name": task.name.to_string(), "agents": task.agents, "spawn": task.spawn.to_string(),
            "horizon": task.horizon, "executor": config.executor.kind.to_string(),
            "scheduler": config.commander.kind.to_string(), "seed": run.seed, "max_steps": run.max_steps,
            "target_success": run.target_success, "eval_every": run.eval_every,
            "max_iterations": config.max_iterations(),
        });
        Self {
            process: format!("{:016x}", magex_runtime::backoff::random_id()),
            started: Instant::now(),
            info,
            task: words,
            scene: Scene::of(task),
            run: Mutex::new(Run {
                run_id: String::new(),
                phase: Phase::Starting,
                end: None,
                version: None,
                sha256: String::new(),
                latest: Value::Null,
                summary: Value::Null,
            }),
            curve: Mutex::default(),
            episode: Mutex::default(),
            snapshot: Mutex::default(),
            revision: watch::Sender::new(1),
            viewers: Semaphore::new(VIEWERS),
            asked: Mutex::default(),
        }
    }

    /// Takes in what the run wrote down before this process. A file that cannot be read leaves the page without it.
    pub(crate) fn begin(&self, run_id: &RunId, folder: &Path) {
        self.change(|run| run.run_id.clone_from(&run_id.0));
        let path = folder.join("metrics.jsonl");
        match std::fs::File::open(&path) {
            Ok(file) => std::io::BufReader::new(file).lines().map_while(Result::ok).for_each(|line| self.line(&line)),
            Err(error) => tracing::warn!(path = %path.display(), %error, "the page begins without earlier curves"),
        }
    }

    /// Takes a line of metrics.jsonl.
    pub(crate) fn line(&self, line: &str) {
        let Ok(value) = serde_json::from_str::<Value>(line) else { return };
        lock(&self.curve).push(&value);
        self.change(|run| run.latest = value);
    }

    pub(crate) fn phase(&self, phase: Phase) {
        self.change(|run| run.phase = phase);
    }

    pub(crate) fn published(&self, weights: &Weights) {
        self.change(|run| (run.version, run.sha256) = (Some(weights.version.0), weights.sha256.clone()));
    }

    /// Takes the recorded episode of an evaluation, if there is one among the results.
    pub(crate) fn evaluated(&self, outcomes: &[EvalOutcome]) {
        let Some((outcome, recording)) = outcomes.iter().find_map(|o| Some((o, o.recording.as_ref()?))) else { return };
        let version = outcome.shard.version.0;
        let name = format!("version {version}, episode {}", outcome.shard.first_episode + 1);
        let packed = match self.scene.pack(&name, recording, outcome.metrics.first()) {
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
    pub(crate) fn ended(&self, end: RunEnd) {
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

    /// Waits until those who look have seen the end; with nobody there, not at all. For a run that has ended, before the
    /// server is stopped.
    pub async fn farewell(&self) {
        let start = Instant::now();
        let busy = || {
            self.viewers.available_permits() < VIEWERS || lock(&self.asked).is_some_and(|last| last.elapsed() < QUIET)
        };
        while busy() && start.elapsed() < FAREWELL {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }

    /// A viewer was answered.
    pub(super) fn answered(&self) {
        *lock(&self.asked) = Some(Instant::now());
    }

    fn change(&self, change: impl FnOnce(&mut Run)) {
        change(&mut lock(&self.run));
        self.revision.send_modify(|revision| *revision += 1);
    }

    /// Waits until something is newer than revision `after` and `gap` has passed, and for `hold` at most. The end of the run
    /// is told at once: the process may be gone a moment later.
    pub(super) async fn news(&self, after: u64, gap: Duration, hold: Duration) {
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

    pub(super) fn episode(&self) -> Option<Episode> {
        lock(&self.episode).clone()
    }

    /// The rows of the curves after a line; of another process, all of them.
    pub(super) fn curve(&self, process: &str, after: u64) -> Bytes {
        let after = if process == self.process { after } else { 0 };
        // Copied under the lock, written as text without it: the training thread never waits for that.
        let rows = lock(&self.curve).after(&self.process, after);
        serde_json::to_vec(&rows).unwrap_or_default().into()
    }

    /// How the run stands. `status` is what the learner's connections know; none if everything is in one process.
    pub(super) fn state(&self, status: impl FnOnce() -> Option<v1::RunStatus>) -> Bytes {
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
        // Before everything else: what changes meanwhile is asked for again.
        let revision = self.current();
        let points = lock(&self.curve).last();
        let episode = lock(&self.episode).as_ref().map(|episode| episode.tag.clone());
        let run = lock(&self.run);
        let (state, reason) = match (&run.end, &status) {
            (Some((state, reason)), _) => (*state, reason.clone()),
            (None, Some(status)) => (state_name(status.state()), None),
            (None, None) => (phase_name(run.phase), None),
        };
        let mut value = json!({
            "process": self.process, "revision": revision, "run_id": run.run_id, "name": self.info.name,
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

fn state_name(state: v1::RunState) -> &'static str {
    match state {
        v1::RunState::Unspecified => "starting",
        v1::RunState::WaitingForActors => "waiting_for_actors",
        v1::RunState::Collecting => "collecting",
        v1::RunState::Training => "training",
        v1::RunState::Evaluating => "evaluating",
        v1::RunState::Finished => "finished",
        v1::RunState::Draining => "draining",
    }
}

fn phase_name(phase: Phase) -> &'static str {
    match phase {
        Phase::Starting => "starting",
        Phase::Collecting => "collecting",
        Phase::Evaluating => "evaluating",
        Phase::Training => "training",
    }
}
