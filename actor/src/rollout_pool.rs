//! The rollout threads of one run.

use crate::goal_client::{GoalError, GrpcGoals, WeightsKey};
use crate::metrics::ActorMetrics;
use crate::pulse::{Pulse, Watch};
use crate::weights_cache::WeightsCache;
use crate::worker::{MakeWorker, WorkError, Worker};
use bytes::Bytes;
use magex_core::config::RunConfig;
use magex_core::ids::{RunId, Shard};
use magex_core::task::TaskConfig;
use magex_proto::convert::encode_result;
use magex_proto::v1::{ShardTiming, Welcome};
use magex_runtime::client::Channel;
use magex_runtime::peer::Remote;
use magex_runtime::sync::lock;
use magex_runtime::trace;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, mpsc as blocking};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use tokio::runtime::Handle;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tracing::Span;

/// A leased shard, as the pool receives it.
#[derive(Debug, Clone)]
pub(crate) struct LeasedShard {
    pub(crate) lease_id: u64,
    pub(crate) shard: Shard,
    pub(crate) weights_sha256: String,
    pub(crate) received: Instant,
    /// From the lease until the learner acknowledges the result.
    pub(crate) span: Span,
}

#[derive(Debug)]
pub(crate) struct ShardOutcome {
    pub(crate) lease_id: u64,
    pub(crate) shard: Shard,
    pub(crate) result: Result<EncodedResult, WorkError>,
}

#[derive(Debug, Clone)]
pub(crate) struct EncodedResult {
    pub(crate) bytes: Bytes,
    /// Where the time went; sent beside the result, never part of it.
    pub(crate) timing: ShardTiming,
    pub(crate) ready: Instant,
    /// From then until the acknowledgement; ends when this is dropped.
    pub(crate) _upload: Span,
}

#[derive(Clone)]
pub(crate) struct PoolContext {
    pub(crate) make_worker: MakeWorker,
    pub(crate) cache: Arc<WeightsCache>,
    pub(crate) channel: Channel,
    pub(crate) commander: Arc<Remote>,
    pub(crate) runtime: Handle,
    pub(crate) metrics: Arc<ActorMetrics>,
}

/// Threads that work on one run until the pool is shut down.
pub(crate) struct RolloutPool {
    pub(crate) welcome: Welcome,
    /// An actor that sends nothing for this time loses its leases.
    pub(crate) lease: Duration,
    shards: Option<blocking::SyncSender<LeasedShard>>,
    outcomes: mpsc::Receiver<ShardOutcome>,
    cancelled: CancellationToken,
    metrics: Arc<ActorMetrics>,
    threads: Vec<JoinHandle<()>>,
    watch: Watch,
    /// Shards submitted whose outcome has not been taken.
    busy: usize,
}

impl RolloutPool {
    /// Makes the workers and starts a thread for each. Blocks while workers are made.
    pub(crate) fn start(
        welcome: Welcome,
        lease: Duration,
        threads: usize,
        context: PoolContext,
    ) -> Result<Self, WorkError> {
        let (shards, queue) = blocking::sync_channel(2 * threads);
        let (results, outcomes) = mpsc::channel(threads);
        let (shards, queue) = (Some(shards), Arc::new(Mutex::new(queue)));
        let (cancelled, metrics) = (CancellationToken::new(), context.metrics.clone());
        // Used to count steps only; the workers parse the configuration themselves and report its errors.
        let task = RunConfig::from_toml(&welcome.run_config_toml).ok().map(|config| config.task);
        metrics.threads.set(threads as f64);
        let pulses: Vec<Pulse> = (0..threads).map(|_| Pulse::default()).collect();
        let watch = Watch::new(pulses.iter().cloned());
        let mut pool =
            Self { welcome, lease, shards, outcomes, cancelled, metrics, threads: Vec::new(), watch, busy: 0 };
        for (number, pulse) in pulses.into_iter().enumerate() {
            let rollout = RolloutThread {
                worker: make_worker(&context, &pool.welcome, &pulse)?,
                pulse,
                welcome: pool.welcome.clone(),
                lease,
                context: context.clone(),
                task: task.clone(),
                cancelled: pool.cancelled.clone(),
            };
            let (queue, results) = (queue.clone(), results.clone());
            let thread = std::thread::Builder::new()
                .name(format!("rollout-{number}"))
                .spawn(move || rollout.run(&queue, &results))
                .map_err(|error| WorkError::fatal(format!("cannot start a rollout thread: {error}")))?;
            pool.threads.push(thread);
        }
        Ok(pool)
    }

    pub(crate) fn threads(&self) -> usize {
        self.threads.len()
    }

    pub(crate) fn idle(&self) -> usize {
        self.threads.len().saturating_sub(self.busy)
    }

    /// The number of a thread that has not moved for this number of calls although it has a shard.
    pub(crate) fn stuck(&mut self, calls: u32) -> Option<usize> {
        self.watch.stuck(calls)
    }

    /// Queues a shard for the first idle thread; false if the queue is full.
    pub(crate) fn submit(&mut self, shard: LeasedShard) -> bool {
        let queued = self.shards.as_ref().is_some_and(|shards| shards.try_send(shard).is_ok());
        self.busy += usize::from(queued);
        self.refresh_metrics();
        queued
    }

    /// The next outcome. Cancel safe.
    pub(crate) async fn next_outcome(&mut self) -> Option<ShardOutcome> {
        let outcome = self.outcomes.recv().await?;
        self.busy = self.busy.saturating_sub(1);
        self.refresh_metrics();
        Some(outcome)
    }

    fn refresh_metrics(&self) {
        self.metrics.busy.set(self.busy.min(self.threads.len()) as f64);
        self.metrics.queue("shards", self.busy.saturating_sub(self.threads.len()));
    }

    /// Cancels the threads' work and joins them in the background.
    pub(crate) fn shut_down(mut self) -> tokio::task::JoinHandle<()> {
        let threads = std::mem::take(&mut self.threads);
        drop(self);
        tokio::task::spawn_blocking(move || {
            for thread in threads {
                // Workers' panics are caught, so there is no result to inspect.
                let _ = thread.join();
            }
        })
    }
}

impl Drop for RolloutPool {
    fn drop(&mut self) {
        self.cancelled.cancel();
        self.shards = None;
    }
}

fn make_worker(context: &PoolContext, welcome: &Welcome, pulse: &Pulse) -> Result<Box<dyn Worker>, WorkError> {
    let mut worker = (context.make_worker)(welcome)?;
    worker.beat(pulse.clone());
    Ok(worker)
}

struct RolloutThread {
    worker: Box<dyn Worker>,
    pulse: Pulse,
    welcome: Welcome,
    lease: Duration,
    context: PoolContext,
    task: Option<TaskConfig>,
    cancelled: CancellationToken,
}

impl RolloutThread {
    fn run(mut self, queue: &Mutex<blocking::Receiver<LeasedShard>>, results: &mpsc::Sender<ShardOutcome>) {
        loop {
            // One thread waits for a shard; the others wait for the lock.
            let next = lock(queue).recv();
            let Ok(leased) = next else { return };
            if self.cancelled.is_cancelled() {
                return;
            }
            self.pulse.set_busy(true);
            let result = self.roll_out(&leased);
            self.pulse.set_busy(false);
            let outcome = ShardOutcome { lease_id: leased.lease_id, shard: leased.shard, result };
            if results.blocking_send(outcome).is_err() {
                return;
            }
        }
    }

    /// Waits for the weights, rolls the shard out and encodes the result.
    fn roll_out(&mut self, leased: &LeasedShard) -> Result<EncodedResult, WorkError> {
        let begun = Instant::now();
        let span = tracing::info_span!(target: trace::TARGET, parent: &leased.span, "weights wait");
        let run_id = RunId(self.welcome.run_id.clone());
        let sha256 = leased.weights_sha256.clone();
        let key = WeightsKey { run_id: run_id.clone(), version: leased.shard.version, sha256 };
        let context = &self.context;
        let (runtime, commander) = (context.runtime.clone(), (context.commander.clone(), context.channel.clone()));
        let arrival = self.context.cache.wait(&key, self.lease);
        let arrived = runtime.block_on(self.cancelled.run_until_cancelled(arrival));
        let cancelled = || WorkError::Retryable(GoalError::Cancelled.to_string());
        let weights = arrived.ok_or_else(cancelled)?.map_err(|late| WorkError::Retryable(late.to_string()))?;
        drop(span);
        self.pulse.beat();
        let weights_wait_seconds = begun.elapsed().as_secs_f64();
        let (cancelled, span) = (self.cancelled.clone(), leased.span.clone());
        let mut goals = GrpcGoals::new(runtime, commander, key, self.lease, cancelled, span);
        let working = Instant::now();
        let worker = &mut self.worker;
        let result = match catch_unwind(AssertUnwindSafe(|| worker.work(&leased.shard, &weights, &mut goals))) {
            Ok(result) => result?,
            Err(panic) => {
                // The panic may have left the worker in an inconsistent state.
                self.worker = make_worker(&self.context, &self.welcome, &self.pulse)?;
                return Err(WorkError::fatal(format!("the worker panicked: {}", panic_text(panic.as_ref()))));
            }
        };
        if *result.shard() != leased.shard {
            return Err(WorkError::fatal("the worker returned the result of another shard"));
        }
        let worked = working.elapsed().as_secs_f64();
        let goals_wait_seconds = goals.waited().as_secs_f64();
        let bytes = encode_result(&run_id, &leased.weights_sha256, &result);
        let timing = ShardTiming {
            held_seconds: leased.received.elapsed().as_secs_f64(),
            weights_wait_seconds,
            goals_wait_seconds,
            rollout_seconds: (worked - goals_wait_seconds).max(0.0),
        };
        self.context.metrics.done(&leased.shard, self.task.as_ref(), &timing);
        let _upload = tracing::info_span!(target: trace::TARGET, parent: &leased.span, "upload", bytes = bytes.len());
        Ok(EncodedResult { bytes, timing, ready: Instant::now(), _upload })
    }
}

fn panic_text(panic: &(dyn std::any::Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("without a message")
}
