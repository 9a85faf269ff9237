//! Rolling out a shard: a pure function of the shard, the run's seed and task, the weights it names, and the goals that
//! the commander hands out. Nothing here knows a clock, a thread or an address.

mod buffers;
mod external;
mod policy;

use self::policy::{Carried, KeyedChooser};
use crate::environment::{EnvironmentError, Environments};
use crate::pulse::Pulse;
use buffers::{Buffers, chain};
use external::Ended;
use magex_core::config::RunConfig;
use magex_core::error::FieldError;
use magex_core::ids::{Shard, ShardKind};
use magex_core::keys::episode_keys;
use magex_core::metrics_table::{COST_RATIO, SECOND_COST_RATIO};
use magex_core::rng::Key;
use magex_core::statics::Statics;
use magex_core::task::{ActionCode, TaskConfig};
use magex_core::trajectory::{EpisodeMetrics, EvalOutcome, Recording, Shape, ShardResult, Trajectory};
use magex_env::{Controller, Env, new_env};
use magex_nets::executor::{Act, Model};
use magex_nets::features::Symmetry;
use magex_nets::params::ParamError;
use magex_proto::goals::{GoalReply, GoalRequest};
use std::sync::Arc;

/// Why a shard could not be rolled out. E is the error of the commander's client.
#[derive(Debug, thiserror::Error)]
pub enum RolloutError<E> {
    /// The environment refused.
    #[error(transparent)]
    Env(#[from] FieldError),
    /// The weights do not fit, or the tensor library refused.
    #[error(transparent)]
    Weights(#[from] ParamError),
    /// No goals.
    #[error("goals: {0}")]
    Goals(E),
    /// The external environment.
    #[error(transparent)]
    Environment(EnvironmentError),
    /// The policy's outputs are not finite.
    #[error("policy: logits[{place}] is not finite at step {step}: the weights of version {version} are broken")]
    NotFinite {
        /// Index into the logits [B·N, A].
        place: usize,
        /// Joint step.
        step: usize,
        /// Version of the weights.
        version: u32,
    },
}

/// What drives the agents of a shard.
enum Driver<'a> {
    Policy(&'a dyn Act, Carried),
    Controller(Box<dyn Controller>),
}

/// Makes the controller of a shard, given the task and one key per episode.
pub type MakeController = Box<dyn Fn(&TaskConfig, &[Key]) -> Result<Box<dyn Controller>, FieldError> + Send + Sync>;

/// Where the drivers of shards come from.
enum Source {
    Policy(Box<dyn Act>),
    Controller(MakeController),
    /// Any action, in an external environment.
    Random,
}

/// Everything that is the same for all shards of a version of the weights.
pub struct Roller {
    config: RunConfig,
    model: Model,
    source: Source,
    /// For a task that is simulated by a program of its own.
    pub environments: Option<Arc<Environments>>,
    /// Beats once per joint step.
    pub pulse: Pulse,
}

impl std::fmt::Debug for Roller {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Roller").field("task", &self.config.task).finish_non_exhaustive()
    }
}

impl Roller {
    /// With the policy of a weights file. `config.task` may have another team size than the one the weights were trained
    /// with, if the architecture allows it.
    pub fn new(config: &RunConfig, weights: &[u8]) -> Result<Self, ParamError> {
        let model = Model::new(config)?;
        let source = Source::Policy(model.load_policy(weights)?);
        Ok(Self { config: config.clone(), model, source, environments: None, pulse: Pulse::default() })
    }

    /// With a controller instead of a policy (evaluation only).
    pub fn with_controller(config: &RunConfig, make: MakeController) -> Result<Self, ParamError> {
        let source = Source::Controller(make);
        let (config, model) = (config.clone(), Model::new(config)?);
        Ok(Self { config, model, source, environments: None, pulse: Pulse::default() })
    }

    /// With random actions in an external environment.
    pub fn at_random(config: &RunConfig) -> Result<Self, ParamError> {
        let (config, model) = (config.clone(), Model::new(config)?);
        Ok(Self { config, model, source: Source::Random, environments: None, pulse: Pulse::default() })
    }

    /// Share of random actions of action values; `None` for a policy, which is sampled. Evaluations know no iteration: they explore as
    /// little as training does in the end.
    fn epsilon(&self, shard: &Shard) -> Option<f32> {
        let (config, qmix) = (&self.config, &self.config.qmix);
        let steps = u64::from(shard.iteration.0) * config.steps_per_iteration();
        config.run.algorithm.off_policy().then(|| match shard.kind {
            ShardKind::Train => qmix.epsilon(steps),
            ShardKind::Eval => qmix.epsilon_end,
        })
    }

    /// Rolls out all episodes of a shard side by side. `assign` is asked once for the goals of all of them.
    pub fn rollout<E>(
        &self,
        shard: &Shard,
        assign: impl FnOnce(&GoalRequest) -> Result<GoalReply, E>,
    ) -> Result<ShardResult, RolloutError<E>> {
        if let Ok(external) = self.config.task.external() {
            let missing = || EnvironmentError::Missing(external.environment.clone());
            let environments = self.environments.as_ref().ok_or_else(|| RolloutError::Environment(missing()))?;
            return self.rollout_in(shard, environments);
        }
        let (task, seed) = (&self.config.task, self.config.run.seed);
        let keep = shard.kind == ShardKind::Train;
        let shape = task.shape(shard.episodes as usize);
        let (b, n, steps) = (shape.episodes, shape.agents, shape.steps);
        let keys: Vec<_> = (0..shard.episodes).map(|e| episode_keys(seed, shard, e)).collect();

        // Reset, then goals, then the first observation: an agent never sees a goal of another episode.
        let mut worlds = new_env(task, keys.iter().map(|k| k.spawn.stream()), keep)?;
        let mut state = Buffers::new(&shape, worlds.statics());
        state.read(&worlds)?;
        let request = state.goal_request(&shape, task.stages(), shard, seed);
        let reply = assign(&request).map_err(RolloutError::Goals)?;
        state.goals = chain(&shape, &reply.goals);
        worlds.set_goals(&state.goals)?;
        let mut driver = match &self.source {
            Source::Policy(policy) => {
                let graph = keys.iter().map(|k| k.graph);
                Driver::Policy(policy.as_ref(), Carried::new(&self.model, shard, n, graph))
            }
            Source::Random => return Err(FieldError::new("task.name", "is not external").into()),
            Source::Controller(make) => {
                let keys: Vec<Key> = keys.iter().map(|k| k.controller).collect();
                let mut controller = make(task, &keys)?;
                controller.begin(&state.joint_state())?;
                Driver::Controller(controller)
            }
        };

        let mut out = columns(&shape, shard, keep);
        let mut recording = (Vec::new(), Vec::new());
        let mut rewards = vec![0.0; b * n];
        let mut chosen = KeyedChooser::new(self.model.heads(), n, shard.mode, keys.iter().map(|k| k.action));
        chosen.epsilon = self.epsilon(shard);
        for step in 0..=steps {
            self.pulse.beat();
            state.read(&worlds)?;
            if keep {
                out.positions.extend_from_slice(&state.positions);
                out.velocities.extend_from_slice(&state.velocities);
                out.agent_state.extend_from_slice(&state.agent_state);
            } else if shard.record {
                recording.0.extend_from_slice(&state.positions[..shape.bodies * shape.dims]);
                recording.1.extend_from_slice(&state.agent_state[..n * shape.agent_state]);
            }
            if step == steps {
                break;
            }
            let mut symmetries: Vec<Symmetry> = Vec::new();
            match &mut driver {
                Driver::Policy(policy, carried) => {
                    let features = Arc::new(self.model.spec().compute(&state.joint_state()));
                    carried.act(*policy, &features, step, &mut chosen).map_err(ParamError::from)?;
                    if let Some(place) = chosen.not_finite {
                        return Err(RolloutError::NotFinite { place, step, version: shard.version.0 });
                    }
                    symmetries.clone_from(&features.symmetries);
                }
                Driver::Controller(controller) => controller.act(&state.joint_state(), &mut chosen.actions)?,
            }
            if keep {
                out.actions.extend_from_slice(&chosen.actions);
            }
            // The policy chose in each agent's own frame.
            to_world(task.action_code(), shape.action_components, &symmetries, &mut chosen.actions);
            worlds.step(&chosen.actions, &mut rewards)?;
            if keep {
                out.log_probs.extend_from_slice(&chosen.log_probs);
                out.rewards.extend_from_slice(&rewards);
            }
        }
        let metrics = metrics(&worlds, &reply, shape.goals_per_agent);
        if !keep {
            let recording = shard.record.then(|| Recording {
                shape: Shape { episodes: 1, ..shape },
                positions: recording.0,
                agent_state: recording.1,
                statics: state.statics.episode(0).to_owned(),
                goals: state.goals[..n * shape.goals_per_agent].to_vec(),
                pictures: Vec::new(),
            });
            return Ok(ShardResult::Eval(EvalOutcome { shard: *shard, metrics, recording }));
        }
        out.statics = state.statics;
        out.goals = state.goals;
        out.goal_log_probs = reply.log_probs;
        out.costs = reply.costs;
        out.exact_costs = reply.exact_costs;
        out.metrics = metrics;
        Ok(ShardResult::Train(out))
    }
}

impl Roller {
    /// In one of the environments of this process; attempts that it spoils are repeated, others are not.
    fn rollout_in<E>(&self, shard: &Shard, environments: &Environments) -> Result<ShardResult, RolloutError<E>> {
        let mut own = None;
        let result = environments.with(|environment| match self.rollout_external(shard, environment) {
            Ok(result) => Ok(Some(result)),
            Err(Ended::Environment(error)) => Err(error),
            Err(Ended::Rollout(error)) => {
                own = Some(error);
                Ok(None)
            }
        });
        match (result, own) {
            (Ok(Some(result)), _) => Ok(result),
            (_, Some(error)) => Err(error),
            (Err(error), None) => Err(RolloutError::Environment(error)),
            (Ok(None), None) => Err(FieldError::new("shard", "gave neither a result nor an error").into()),
        }
    }
}

/// Turns the policy's actions, in place, to the axes of the world; without frames they are along them already.
fn to_world(code: ActionCode, heads: usize, symmetries: &[Symmetry], actions: &mut [u8]) {
    for (symmetry, action) in symmetries.iter().zip(actions.chunks_exact_mut(heads)) {
        symmetry.act(code, action);
    }
}

/// What the episodes scored, and what the commander cost them.
fn metrics(worlds: &Env, reply: &GoalReply, stages: usize) -> Vec<EpisodeMetrics> {
    let ratios: Vec<f32> = reply.costs.iter().zip(&reply.exact_costs).map(|(c, h)| c / h.max(1e-9)).collect();
    let mut episodes = worlds.scores();
    for (episode, ratios) in episodes.iter_mut().zip(ratios.chunks_exact(stages.max(1))) {
        for (metric, ratio) in [COST_RATIO, SECOND_COST_RATIO].into_iter().zip(ratios) {
            episode[metric] = *ratio;
        }
    }
    episodes
}

/// A trajectory to be filled, with room for its columns if they are kept.
fn columns(shape: &Shape, shard: &Shard, keep: bool) -> Trajectory {
    let room = |count: usize| if keep { count } else { 0 };
    let state = room((shape.steps + 1) * shape.episodes * shape.bodies * shape.dims);
    let rows = room(shape.steps * shape.episodes * shape.agents);
    Trajectory {
        shard: *shard,
        shape: *shape,
        positions: Vec::with_capacity(state),
        velocities: Vec::with_capacity(state),
        agent_state: Vec::with_capacity(room((shape.steps + 1) * shape.episodes * shape.agents * shape.agent_state)),
        statics: Statics::default(),
        goals: Vec::new(),
        actions: Vec::with_capacity(rows * shape.action_components),
        log_probs: Vec::with_capacity(rows),
        rewards: Vec::with_capacity(rows),
        moves: Vec::new(),
        masks: Vec::new(),
        marks: Vec::new(),
        world_states: Vec::new(),
        goal_log_probs: Vec::new(),
        costs: Vec::new(),
        exact_costs: Vec::new(),
        metrics: Vec::new(),
    }
}
