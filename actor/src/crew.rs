//! The rollout threads of one run.

use crate::cache::{CacheError, WeightsCache};
use crate::gauges::ActorGauges;
use crate::goals::{GrpcGoals, WeightsKey};
use crate::worker::{MakeWorker, Welcome, WorkError, Worker};
use bytes::Bytes;
use magex_core::config::RunConfig;
use magex_core::ids::Shard;
use magex_core::task::TaskConfig;
use magex_proto::convert::encode_result;
use magex_proto::v1::ShardTiming;
use magex_runtime::client::Channel;
use magex_runtime::trace;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, PoisonError, mpsc as blocking};
use std::thread::JoinHandle;
use std::time::Instant;
use tokio::runtime::Handle;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tracing::Span;

/// A leased shard.
#[derive(Debug, Clone)]
pub(crate) struct Job {
    pub(crate) lease_id: u64,
    pub(crate) shard: Shard,
    pub(crate) weights_sha256: String,
    /// When the lease arrived.
    pub(crate) received: Instant,
    /// From the lease to the result's being settled.
    pub(crate) span: Span,
}

/// What became of a job.
#[derive(Debug)]
pub(crate) enum Outcome {
    /// The encoded result.
    Done { lease_id: u64, done: Done },
    /// No result.
    Failed { lease_id: u64, shard: Shard, error: WorkError },
}

/// A shard's result, ready to be sent.
#[derive(Debug, Clone)]
pub(crate) struct Done {
    pub(crate) bytes: Bytes,
    /// Where the time went; travels beside the result, never in it.
    pub(crate) timing: ShardTiming,
    /// When it was ready.
    pub(crate) ready: Instant,
    /// From then until it is settled; ends with this.
    pub(crate) _upload: Span,
}

/// What all threads of a crew use.
#[derive(Clone)]
pub(crate) struct Tools {
    pub(crate) make_worker: MakeWorker,
    pub(crate) cache: Arc<WeightsCache>,
    pub(crate) commander: Channel,
    pub(crate) runtime: Handle,
    pub(crate) gauges: Arc<ActorGauges>,
}

/// Threads that work on one run until the crew is dismissed.
pub(crate) struct Crew {
    pub(crate) welcome: Welcome,
    jobs: Option<blocking::SyncSender<Job>>,
    outcomes: mpsc::Receiver<Outcome>,
    cancelled: CancellationToken,
    cache: Arc<WeightsCache>,
    gauges: Arc<ActorGauges>,
    threads: Vec<JoinHandle<()>>,
    /// Jobs given and not yet returned.
    busy: usize,
}

impl Crew {
    /// Makes the workers and starts a thread for each. Blocks while workers are made.
    pub(crate) fn start(welcome: Welcome, threads: usize, tools: Tools) -> Result<Self, WorkError> {
        let (jobs, queue) = blocking::sync_channel(2 * threads);
        let (results, outcomes) = mpsc::channel(threads);
        let queue = Arc::new(Mutex::new(queue));
        let cancelled = CancellationToken::new();
        let (cache, gauges) = (tools.cache.clone(), tools.gauges.clone());
        // For counting steps only; the workers read the configuration themselves, and complain.
        let task = RunConfig::from_toml(&welcome.run_config_toml).ok().map(|config| config.task);
        gauges.threads.set(threads as f64);
        let (jobs, threads_of_it) = (Some(jobs), Vec::new());
        let mut crew = Self { welcome, jobs, outcomes, cancelled, cache, gauges, threads: threads_of_it, busy: 0 };
        for number in 0..threads {
            let bench = Bench {
                worker: (tools.make_worker)(&crew.welcome)?,
                welcome: crew.welcome.clone(),
                tools: tools.clone(),
                task: task.clone(),
                cancelled: crew.cancelled.clone(),
            };
            let (queue, results) = (queue.clone(), results.clone());
            let thread = std::thread::Builder::new()
                .name(format!("rollout-{number}"))
                .spawn(move || bench.serve(&queue, &results))
                .map_err(|error| WorkError::fatal(format!("cannot start a rollout thread: {error}")))?;
            crew.threads.push(thread);
        }
        Ok(crew)
    }

    /// Rollout threads.
    pub(crate) fn threads(&self) -> usize {
        self.threads.len()
    }

    /// Threads that have nothing to do.
    pub(crate) fn idle(&self) -> usize {
        self.threads.len().saturating_sub(self.busy)
    }

    /// Gives a job to the first free thread; gives it back when there are too many.
    pub(crate) fn give(&mut self, job: Job) -> Result<(), Job> {
        let Some(jobs) = &self.jobs else { return Err(job) };
        match jobs.try_send(job) {
            Ok(()) => {
                self.busy += 1;
                self.count();
                Ok(())
            }
            Err(blocking::TrySendError::Full(job) | blocking::TrySendError::Disconnected(job)) => Err(job),
        }
    }

    /// The next outcome. Cancel safe.
    pub(crate) async fn next_outcome(&mut self) -> Option<Outcome> {
        let outcome = self.outcomes.recv().await?;
        self.busy = self.busy.saturating_sub(1);
        self.count();
        Some(outcome)
    }

    fn count(&self) {
        self.gauges.busy.set(self.busy.min(self.threads.len()) as f64);
        self.gauges.queue("jobs", self.busy.saturating_sub(self.threads.len()));
    }

    /// Tells the threads that nobody wants their results, and waits for them in the background.
    pub(crate) fn dismiss(mut self) -> tokio::task::JoinHandle<()> {
        let threads = std::mem::take(&mut self.threads);
        drop(self);
        tokio::task::spawn_blocking(move || {
            for thread in threads {
                // Panics of workers are caught; there is nothing to learn here.
                let _ = thread.join();
            }
        })
    }
}

impl Drop for Crew {
    fn drop(&mut self) {
        self.cancelled.cancel();
        self.jobs = None;
        self.cache.wake();
    }
}

/// One thread's place.
struct Bench {
    worker: Box<dyn Worker>,
    welcome: Welcome,
    tools: Tools,
    task: Option<TaskConfig>,
    cancelled: CancellationToken,
}

impl Bench {
    fn serve(mut self, queue: &Mutex<blocking::Receiver<Job>>, results: &mpsc::Sender<Outcome>) {
        loop {
            // One thread waits for a job, the others for their turn to wait.
            let next = queue.lock().unwrap_or_else(PoisonError::into_inner).recv();
            let Ok(job) = next else { return };
            if self.cancelled.is_cancelled() {
                return;
            }
            let outcome = match self.work(&job) {
                Ok(done) => Outcome::Done { lease_id: job.lease_id, done },
                Err(error) => Outcome::Failed { lease_id: job.lease_id, shard: job.shard, error },
            };
            if results.blocking_send(outcome).is_err() {
                return;
            }
        }
    }

    fn work(&mut self, job: &Job) -> Result<Done, WorkError> {
        let begun = Instant::now();
        let span = tracing::info_span!(target: trace::TARGET, parent: &job.span, "weights wait");
        let run_id = self.welcome.run_id.clone();
        let key = WeightsKey { run_id, version: job.shard.version, sha256: job.weights_sha256.clone() };
        let weights = self.tools.cache.wait(&key, self.welcome.lease, &self.cancelled).map_err(|error| {
            let retryable = matches!(error, CacheError::TimedOut { .. } | CacheError::Cancelled);
            WorkError::Failed { reason: error.to_string(), retryable }
        })?;
        drop(span);
        let weights_wait_seconds = begun.elapsed().as_secs_f64();
        let (runtime, commander) = (self.tools.runtime.clone(), self.tools.commander.clone());
        let mut goals = GrpcGoals::new(runtime, commander, key, self.welcome.lease, self.cancelled.clone());
        goals.trace(&job.span);
        let working = Instant::now();
        let worker = &mut self.worker;
        let result = match catch_unwind(AssertUnwindSafe(|| worker.work(&job.shard, &weights, &mut goals))) {
            Ok(result) => result?,
            Err(panic) => {
                // Whatever state the worker was in, a new one is in none.
                self.worker = (self.tools.make_worker)(&self.welcome)?;
                return Err(WorkError::fatal(format!("the worker panicked: {}", panic_text(panic.as_ref()))));
            }
        };
        if *result.shard() != job.shard {
            return Err(WorkError::fatal("the worker returned the result of another shard"));
        }
        let worked = working.elapsed().as_secs_f64();
        let goals_wait_seconds = goals.waited().as_secs_f64();
        let bytes = encode_result(&self.welcome.run_id, &job.weights_sha256, &result);
        let timing = ShardTiming {
            held_seconds: job.received.elapsed().as_secs_f64(),
            weights_wait_seconds,
            goals_wait_seconds,
            rollout_seconds: (worked - goals_wait_seconds).max(0.0),
        };
        self.tools.gauges.done(&job.shard, self.task.as_ref(), &timing);
        let _upload = tracing::info_span!(target: trace::TARGET, parent: &job.span, "upload", bytes = bytes.len());
        Ok(Done { bytes, timing, ready: Instant::now(), _upload })
    }
}

fn panic_text(panic: &(dyn std::any::Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("without a message")
}
