//! Rollouts in this process: the same episodes, goals and bits as in the cluster, without a network.

use crate::parallel;
use crate::progress::LiveLine;
use magex_actor::environment::Environments;
use magex_actor::rollout::Roller;
use magex_commander::shard_goals::answer;
use magex_core::config::{CommanderPolicy, RunConfig};
use magex_core::ids::Shard;
use magex_core::trajectory::ShardResult;
use magex_learner::collector::Collector;
use magex_learner::run_events::{CollectError, StopReason};
use magex_learner::serve::judge::Compute;
use magex_nets::commander::Commander;
use magex_nets::params::ParamError;
use magex_proto::weights::Weights;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

/// One version of the weights, loaded for rollouts.
#[derive(Debug)]
pub(crate) struct LoadedPolicy {
    pub(crate) roller: Roller,
    pub(crate) commander: Commander,
    pub(crate) random_assignment_fraction: f32,
}

impl LoadedPolicy {
    fn new(config: &RunConfig, weights: &[u8], environments: Option<Arc<Environments>>) -> Result<Self, ParamError> {
        let mut roller = Roller::new(config, weights)?;
        roller.environments = environments;
        Ok(Self {
            roller,
            commander: commander(config, weights, None)?,
            random_assignment_fraction: config.commander.random_assignment_fraction,
        })
    }

    /// Rolls out a plan on `threads` threads; the results are in the order of the plan. Calls `done` after each shard.
    pub(crate) fn rollout_all(
        &self,
        plan: &[Shard],
        threads: usize,
        done: impl Fn(&Shard) + Sync,
    ) -> Result<Vec<ShardResult>, CollectError> {
        let goals = |request: &_| answer(&self.commander, self.random_assignment_fraction, request, &|| true);
        let rollout = |index: usize| {
            let result = self.roller.rollout(&plan[index], goals);
            done(&plan[index]);
            result.map_err(|error| CollectError::Shard { shard: plan[index], reason: error.to_string() })
        };
        let results = parallel::in_order(threads, plan.len(), rollout).map_err(|_| CollectError::RolloutThread)?;
        results.into_iter().collect()
    }
}

/// The configured commander with its weights, or the classical one that `scheduler` names.
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
        Some(classical) => Ok(classical.with_power(chosen.power)),
        None => Commander::load(&chosen, config.task.agents, config.task.dims(), weights),
    }
}

/// Computes single shards as actors and commander together do: for a learner whose actors disagree.
pub(crate) fn judge(config: &RunConfig) -> Compute {
    let (config, mut loaded) = (config.clone(), None::<(String, LoadedPolicy)>);
    Box::new(move |shard, weights| {
        if let Ok(external) = config.task.external() {
            return Err(format!(
                "this host has no {}; if no actor is to blame, the environment is not a function of its seed: with \
                 serve(deterministic=False) its runs are not checked",
                external.environment
            ));
        }
        let policy = match loaded.take() {
            Some((sha256, policy)) if sha256 == weights.sha256 => policy,
            _ => LoadedPolicy::new(&config, &weights.bytes, None).map_err(|error| error.to_string())?,
        };
        let (_, policy) = loaded.insert((weights.sha256.clone(), policy));
        let results = policy.rollout_all(std::slice::from_ref(shard), 1, |_| {}).map_err(|error| error.to_string())?;
        results.into_iter().next().ok_or_else(|| "no result".to_owned())
    })
}

/// A [`Collector`] whose actors are threads of this process.
#[derive(Debug)]
pub struct LocalCollector {
    config: RunConfig,
    threads: usize,
    policy: Option<LoadedPolicy>,
    stop: Arc<AtomicBool>,
    live: Option<LiveLine>,
    environments: Option<Arc<Environments>>,
}

impl LocalCollector {
    /// Setting `stop` ends the run after the current iteration.
    pub fn new(config: &RunConfig, threads: usize, stop: Arc<AtomicBool>) -> Self {
        Self { config: config.clone(), threads, policy: None, stop, live: None, environments: None }
    }

    /// Rolls out in these environments, if the task is external.
    pub(crate) fn in_environments(self, environments: Option<Arc<Environments>>) -> Self {
        Self { environments, ..self }
    }

    /// Shows the shards that are done in a status line.
    pub(crate) fn showing(self, live: Option<LiveLine>) -> Self {
        Self { live, ..self }
    }
}

impl Collector for LocalCollector {
    fn publish(&mut self, weights: &Arc<Weights>) -> Result<(), CollectError> {
        self.policy = Some(LoadedPolicy::new(&self.config, &weights.bytes, self.environments.clone())?);
        Ok(())
    }

    fn collect(&mut self, plan: Vec<Shard>) -> Result<Vec<ShardResult>, CollectError> {
        let (total, done) = (plan.len() as u64, AtomicU64::new(0));
        let show = |_: &Shard| {
            if let Some(live) = &self.live {
                live.shards(done.fetch_add(1, Ordering::Relaxed) + 1, total);
            }
        };
        let policy = self.policy.as_ref().ok_or(CollectError::NoWeights)?;
        let results = policy.rollout_all(&plan, self.threads, show)?;
        if let Some(live) = &self.live {
            live.doing("updating");
        }
        Ok(results)
    }

    fn stop_requested(&self) -> Option<StopReason> {
        self.stop.load(Ordering::Relaxed).then_some(StopReason::Shutdown)
    }
}
