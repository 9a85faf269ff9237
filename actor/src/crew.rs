//! The rollout threads of one run.

use crate::cache::{CacheError, WeightsCache};
use crate::goals::{GrpcGoals, WeightsKey};
use crate::worker::{MakeWorker, Welcome, WorkError, Worker};
use bytes::Bytes;
use magex_core::ids::Shard;
use magex_proto::convert::encode_result;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, PoisonError, mpsc as blocking};
use std::thread::JoinHandle;
use tokio::runtime::Handle;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tonic::transport::Channel;

/// A leased shard.
#[derive(Debug, Clone)]
pub(crate) struct Job {
    pub(crate) lease_id: u64,
    pub(crate) shard: Shard,
    pub(crate) weights_sha256: String,
}

/// What became of a job.
#[derive(Debug)]
pub(crate) enum Outcome {
    /// The encoded result.
    Done { lease_id: u64, bytes: Bytes },
    /// No result.
    Failed { lease_id: u64, shard: Shard, reason: String, retryable: bool },
}

/// What all threads of a crew use.
#[derive(Clone)]
pub(crate) struct Tools {
    pub(crate) make_worker: MakeWorker,
    pub(crate) cache: Arc<WeightsCache>,
    pub(crate) commander: Channel,
    pub(crate) runtime: Handle,
}

/// Threads that work on one run until the crew is dismissed.
pub(crate) struct Crew {
    pub(crate) welcome: Welcome,
    jobs: Option<blocking::SyncSender<Job>>,
    outcomes: mpsc::Receiver<Outcome>,
    cancelled: CancellationToken,
    cache: Arc<WeightsCache>,
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
        let cache = tools.cache.clone();
        let mut crew = Self { welcome, jobs: Some(jobs), outcomes, cancelled, cache, threads: Vec::new(), busy: 0 };
        for number in 0..threads {
            let bench = Bench {
                worker: (tools.make_worker)(&crew.welcome)?,
                welcome: crew.welcome.clone(),
                tools: tools.clone(),
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
                Ok(())
            }
            Err(blocking::TrySendError::Full(job) | blocking::TrySendError::Disconnected(job)) => Err(job),
        }
    }

    /// The next outcome. Cancel safe.
    pub(crate) async fn next_outcome(&mut self) -> Option<Outcome> {
        let outcome = self.outcomes.recv().await?;
        self.busy = self.busy.saturating_sub(1);
        Some(outcome)
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
                Ok(bytes) => Outcome::Done { lease_id: job.lease_id, bytes },
                Err(error) => Outcome::Failed {
                    lease_id: job.lease_id,
                    shard: job.shard,
                    reason: error.to_string(),
                    retryable: error.is_retryable(),
                },
            };
            if results.blocking_send(outcome).is_err() {
                return;
            }
        }
    }

    fn work(&mut self, job: &Job) -> Result<Bytes, WorkError> {
        let run_id = self.welcome.run_id.clone();
        let key = WeightsKey { run_id, version: job.shard.version, sha256: job.weights_sha256.clone() };
        let weights = self.tools.cache.wait(&key, self.welcome.lease, &self.cancelled).map_err(|error| {
            let retryable = matches!(error, CacheError::TimedOut { .. } | CacheError::Cancelled);
            WorkError::Failed { reason: error.to_string(), retryable }
        })?;
        let (runtime, commander) = (self.tools.runtime.clone(), self.tools.commander.clone());
        let mut goals = GrpcGoals::new(runtime, commander, key, self.welcome.lease, self.cancelled.clone());
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
        Ok(encode_result(&self.welcome.run_id, &job.weights_sha256, &result))
    }
}

fn panic_text(panic: &(dyn std::any::Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("without a message")
}
