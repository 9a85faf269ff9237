//! Everything in one process: the same rollouts, the same goals, the same bits as the cluster, without a network.

use magex_actor::rollout::Roller;
use magex_commander::shard_goals::answer;
use magex_core::config::{CommanderPolicy, RunConfig};
use magex_core::ids::Shard;
use magex_core::trajectory::ShardResult;
use magex_learner::collector::Collector;
use magex_learner::report::metrics_file::IterationMetrics;
use magex_learner::report::observer::RunObserver;
use magex_learner::run_events::{CollectError, IterationReport, RunEvent, StopReason};
use magex_nets::commander::Commander;
use magex_nets::params::ParamError;
use magex_proto::weights::Weights;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex, PoisonError};

/// A version of the weights, ready to roll out.
#[derive(Debug)]
pub struct Crew {
    /// Drives the agents.
    pub roller: Roller,
    /// Hands out the goals.
    pub commander: Commander,
    /// Share of the training episodes with random goals.
    pub random_assignment_fraction: f32,
}

impl Crew {
    /// From a weights file; `scheduler` overrides the configured one with a classical one.
    pub fn new(config: &RunConfig, weights: &[u8], scheduler: Option<CommanderPolicy>) -> Result<Self, ParamError> {
        Ok(Self {
            roller: Roller::new(config, weights)?,
            commander: commander(config, weights, scheduler)?,
            random_assignment_fraction: config.commander.random_assignment_fraction,
        })
    }

    /// Rolls out one shard.
    pub fn work(&self, shard: &Shard) -> Result<ShardResult, CollectError> {
        self.roller
            .rollout(shard, |request| answer(&self.commander, self.random_assignment_fraction, request, &|| true))
            .map_err(|e| CollectError::Shard { shard: *shard, reason: e.to_string() })
    }

    /// Rolls out a plan on `threads` threads; the results are in the order of the plan.
    pub fn work_all(&self, plan: &[Shard], threads: usize) -> Result<Vec<ShardResult>, CollectError> {
        let next = AtomicUsize::new(0);
        let results: Mutex<Vec<Option<Result<ShardResult, CollectError>>>> =
            Mutex::new(plan.iter().map(|_| None).collect());
        std::thread::scope(|scope| {
            for _ in 0..threads.clamp(1, plan.len().max(1)) {
                scope.spawn(|| {
                    while let Some((index, shard)) =
                        Some(next.fetch_add(1, Ordering::Relaxed)).and_then(|i| Some((i, plan.get(i)?)))
                    {
                        let result = self.work(shard);
                        results.lock().unwrap_or_else(PoisonError::into_inner)[index] = Some(result);
                    }
                });
            }
        });
        let results = results.into_inner().unwrap_or_else(PoisonError::into_inner);
        results.into_iter().map(|r| r.unwrap_or_else(|| Err(CollectError::RolloutThread))).collect()
    }
}

/// The configured scheduler with its weights, or a classical one instead.
pub fn commander(
    config: &RunConfig,
    weights: &[u8],
    scheduler: Option<CommanderPolicy>,
) -> Result<Commander, ParamError> {
    let mut chosen = config.commander.clone();
    if let Some(kind) = scheduler {
        chosen.kind = kind;
    }
    match Commander::classical(chosen.kind) {
        Some(classical) => Ok(classical),
        None => Commander::load(&chosen, config.task.agents, config.task.dims(), weights),
    }
}

/// A [`Collector`] whose actors are threads of this process.
#[derive(Debug)]
pub struct LocalCollector {
    config: RunConfig,
    threads: usize,
    crew: Option<Crew>,
    stop: Arc<std::sync::atomic::AtomicBool>,
}

impl LocalCollector {
    /// A set `stop` ends the run after the current iteration.
    pub fn new(config: &RunConfig, threads: usize, stop: Arc<std::sync::atomic::AtomicBool>) -> Self {
        Self { config: config.clone(), threads, crew: None, stop }
    }
}

impl Collector for LocalCollector {
    fn publish(&mut self, weights: &Arc<Weights>) -> Result<(), CollectError> {
        self.crew = Some(Crew::new(&self.config, &weights.bytes, None)?);
        Ok(())
    }

    fn collect(&mut self, plan: Vec<Shard>) -> Result<Vec<ShardResult>, CollectError> {
        match &self.crew {
            Some(crew) => crew.work_all(&plan, self.threads),
            None => Err(CollectError::NoWeights),
        }
    }

    fn stop_requested(&self) -> Option<StopReason> {
        self.stop.load(Ordering::Relaxed).then_some(StopReason::Shutdown)
    }
}

/// Sends the events of a run to another thread. Events after the receiver is gone are dropped.
#[derive(Debug)]
pub struct EventChannel(pub Sender<RunEvent>);

impl RunObserver for EventChannel {
    fn iteration(&mut self, _metrics: &IterationMetrics, report: &IterationReport) {
        self.event(&RunEvent::Iteration(report.clone()));
    }

    fn event(&mut self, event: &RunEvent) {
        let _ = self.0.send(event.clone());
    }
}
