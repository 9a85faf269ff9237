//! What the tests across crates and processes share.

#![allow(clippy::expect_used, clippy::panic, reason = "tests stop where something is not as it should be")]

pub mod decoders;
pub mod forgetful;
pub mod proxy;
pub mod raw;
pub mod relay;
pub mod sandbox;
pub mod small_disk;
pub mod wall;

use magex::local::LocalCollector;
use magex_core::config::{Algorithm, ExecutorKind, MappoConfig, RunConfig};
use magex_core::ids::RunId;
use magex_core::task::{RewardTarget, Spawn, TaskConfig, TaskName};
use magex_learner::run_events::RunEvent;
use magex_learner::trainer::{TrainOutcome, Trainer};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::{Receiver, channel};

/// A run that takes a second: N agents, few and short episodes, every part of the system in use. Baselines without goals get the
/// team's reward, `flat` has a memory.
pub fn small(kind: ExecutorKind, agents: usize, iterations: u64) -> RunConfig {
    let target = if kind.flat() { "team" } else { "goals" };
    let recurrent = if kind == ExecutorKind::Flat { "recurrent = true\n" } else { "" };
    let text = format!(
        "[run]\nseed = 5\nmax_steps = {}\ntarget_success = 2.0\neval_every = 2\neval_episodes = 6\nfinal_episodes = 6\n\
         checkpoint_every = 2\n[task]\nname = 'simple-spread'\nagents = {agents}\nhorizon = 20\nspawn = 'uniform'\n\
         reward_target = '{target}'\n[executor]\nkind = '{kind}'\nhidden = 32\nneighbours = 3\n{recurrent}\
         [collect]\nepisodes_per_iteration = 8\nshards_per_iteration = 4\n\
         [mappo]\nepochs = 2\nminibatch_size = 200\nchunk_length = 5\n",
        iterations * 8 * 20
    );
    RunConfig::from_toml(&text).unwrap_or_else(|e| panic!("the test's configuration: {e}"))
}

/// [`small`] for another task.
pub fn small_task(name: TaskName, kind: ExecutorKind, agents: usize, iterations: u64) -> RunConfig {
    let mut config = small(kind, agents, iterations);
    let TaskConfig { horizon, reward_target, .. } = config.task;
    config.task = TaskConfig { horizon, reward_target, ..TaskConfig::of(name, agents, Spawn::Uniform) };
    config.commander.random_assignment_fraction = 0.5;
    config.validated().unwrap_or_else(|e| panic!("the test's configuration: {e}"))
}

/// A small run's QMIX or MASER, with a buffer that is full after two iterations and a half.
pub fn off_policy(algorithm: Algorithm, base: RunConfig) -> RunConfig {
    let mut config = base;
    config.run.algorithm = algorithm;
    config.task.reward_target = RewardTarget::Team;
    (config.executor.kind, config.executor.recurrent, config.executor.hidden) = (ExecutorKind::Flat, true, 32);
    config.executor.neighbours = 6;
    config.mappo = MappoConfig::default();
    let q = &mut config.qmix;
    (q.buffer_episodes, q.batch_episodes, q.episodes_per_gradient_step) = (20, 6, 2);
    (q.target_update_every, q.epsilon_steps, q.gradient_slices) = (10, 400, 3);
    config.validated().unwrap_or_else(|e| panic!("the test's configuration: {e}"))
}

/// How a run in this process ended, and the SHA-256 of what it learned.
#[derive(Debug)]
pub struct Ran {
    /// Finished or stopped.
    pub outcome: TrainOutcome,
    /// Hash of actor, critic and commander.
    pub sha256: String,
    /// Events in order.
    pub events: Vec<RunEvent>,
}

/// Trains in this process, in a new folder.
pub fn train(config: &RunConfig, folder: &Path, actors: usize, threads: usize) -> Ran {
    let trainer = Trainer::create(config, RunId("test".into()), folder, threads).expect("a new run");
    drive(trainer, config, actors, &Arc::new(AtomicBool::new(false)))
}

/// Drives a trainer to its end or until `stop` is set.
pub fn drive(mut trainer: Trainer, config: &RunConfig, actors: usize, stop: &Arc<AtomicBool>) -> Ran {
    let (sender, receiver): (_, Receiver<RunEvent>) = channel();
    trainer.observe(sender);
    let mut collector = LocalCollector::new(config, actors, stop.clone());
    let outcome = trainer.run(&mut collector).expect("training");
    let learned = trainer.learned();
    let sha256 = magex_core::sha256::hex(&learned.weights().expect("weights"));
    // The channel ends with its sender.
    drop(trainer);
    Ran { outcome, sha256, events: receiver.iter().collect() }
}

/// The `executor` part of every metrics line.
pub fn updates(events: &[RunEvent]) -> Vec<serde_json::Value> {
    events
        .iter()
        .filter_map(|event| match event {
            RunEvent::Iteration(report) => serde_json::from_str::<serde_json::Value>(&report.metrics_json).ok(),
            _ => None,
        })
        .collect()
}
