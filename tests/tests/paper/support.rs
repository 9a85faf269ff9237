//! What the tests need of the crates.

use candle_core::Tensor;
use magex::local::LocalCollector;
use magex_core::config::{CanonicalOrder, CommanderConfig, CommanderPolicy, RunConfig};
use magex_core::ids::{RunId, Shard};
use magex_core::joint_state::JointState;
use magex_core::rng::{Key, Purpose, Stream};
use magex_core::statics::Statics;
use magex_core::trajectory::{ShardResult, Trajectory};
use magex_learner::collector::Collector;
use magex_learner::run_events::{CollectError, StopReason};
use magex_learner::train::learned::{Learned, Network};
use magex_learner::train::mappo::Mappo;
use magex_learner::trainer::{TrainOutcome, Trainer};
use magex_nets::commander::{Commander, Team};
use magex_nets::executor::{self, Input};
use magex_nets::ops::GraphNoise;
use magex_nets::params::{ParamBuilder, Params};
use magex_proto::weights::Weights;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Parameters of a fresh actor.
pub(crate) fn actor(mappo: &Mappo) -> Params {
    mappo.init().unwrap().into_iter().find(|network| network.name == "actor").unwrap().params
}

/// Parameters and optimiser of a network.
pub(crate) fn network<'a>(learned: &'a Learned, name: &str) -> &'a Network {
    learned.network(name).unwrap()
}

/// Shapes of the tensors of a fresh actor, by name.
pub(crate) fn actor_shapes(config: &RunConfig) -> BTreeMap<String, Vec<usize>> {
    actor(&Mappo::new(config).unwrap()).entries.iter().map(|entry| (entry.name.clone(), entry.shape.clone())).collect()
}

/// [N, A] logits of a fresh actor for one joint state in 2-D, and the memory after the step. Agent i's goal is landmark i.
pub(crate) fn act(config: &RunConfig, positions: &[f32], hidden: &[f32], noise: Option<u64>) -> (Vec<f32>, Vec<f32>) {
    let mappo = Mappo::new(config).unwrap();
    let n = config.task.agents;
    let mut params = ParamBuilder::with(actor(&mappo).tensors().unwrap());
    let network = executor::build(&config.executor, mappo.spec(), (5, 0.01), false, &mut params).unwrap();
    let statics = Statics::landmarks(n, 2, (0..2 * n).map(|k| 0.3 * k as f32).collect());
    let goals: Vec<u32> = (0..n as u32).collect();
    let velocities = vec![0.0; positions.len()];
    let states = JointState {
        positions,
        velocities: &velocities,
        agent_state: &[],
        world_states: &[],
        masks: &[],
        marks: &[],
        statics: statics.view(),
        goals: &goals,
    };
    let noise = noise.map_or(GraphNoise::Off, |key| GraphNoise::Keyed(Arc::new(vec![key])));
    let features = std::sync::Arc::new(mappo.spec().compute(&states));
    let input = Input { steps: 1, sequences: 1, agents: n, features: &features, hidden: hidden.to_vec(), noise };
    let output = network.forward(&input).unwrap();
    let flat = |tensor: &Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    (flat(&output.out), output.states.as_ref().map(flat).unwrap_or_default())
}

/// A fresh scheduler for N agents in 2-D.
pub(crate) fn scheduler(kind: CommanderPolicy, agents: usize) -> Commander {
    let config = CommanderConfig { kind, order: CanonicalOrder::X, ..CommanderConfig::default() };
    let params = Commander::init(&config, agents, 2, 3).unwrap();
    Commander::of(&config, agents, 2, &params).unwrap()
}

pub(crate) fn scores(commander: &Commander, team: &Team<'_>) -> Vec<f32> {
    let instance = commander.instance(team).unwrap();
    commander.scores(&[&instance]).unwrap().flatten_all().unwrap().to_vec1().unwrap()
}

pub(crate) fn stream(k: u32) -> Stream {
    Key::new(7, Purpose::Spawn, &[k]).stream()
}

/// A collector that keeps what was collected.
struct Watching {
    inner: LocalCollector,
    seen: Vec<Trajectory>,
}

impl Collector for Watching {
    fn publish(&mut self, weights: &Arc<Weights>) -> Result<(), CollectError> {
        self.inner.publish(weights)
    }

    fn collect(&mut self, plan: Vec<Shard>) -> Result<Vec<ShardResult>, CollectError> {
        let results = self.inner.collect(plan)?;
        self.seen.extend(results.iter().filter_map(|result| match result {
            ShardResult::Train(trajectory) => Some(trajectory.clone()),
            ShardResult::Eval(_) => None,
        }));
        Ok(results)
    }

    fn stop_requested(&self) -> Option<StopReason> {
        self.inner.stop_requested()
    }
}

/// What a run collected to train on, and what was learned before and after.
pub(crate) fn run(config: &RunConfig) -> (Vec<Trajectory>, Learned, Learned) {
    let folder = tempfile::tempdir().unwrap();
    let mut trainer = Trainer::create(config, RunId("paper".into()), folder.path(), 1).unwrap();
    let before = trainer.learned().clone();
    let inner = LocalCollector::new(config, 1, Arc::new(AtomicBool::new(false)));
    let mut collector = Watching { inner, seen: Vec::new() };
    assert!(matches!(trainer.run(&mut collector).unwrap(), TrainOutcome::Finished(_)));
    (collector.seen, before, trainer.learned().clone())
}
