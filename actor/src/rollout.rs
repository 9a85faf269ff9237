//! Rolling out a shard: a pure function of the shard, the run's seed and task, the weights it names, and the goals that
//! the commander hands out. Nothing here knows a clock, a thread or an address.

use magex_core::config::RunConfig;
use magex_core::ids::{Mode, Shard, ShardKind};
use magex_core::keys::episode_keys;
use magex_core::rng::{Key, Purpose, Stream, sequence};
use magex_core::task::{ActionCode, Group, Stage};
use magex_core::trajectory::{EpisodeMetrics, EvalOutcome, Recording, Shape, ShardResult, Trajectory};
use magex_env::scripted::scripted;
use magex_env::{Env, EnvError, View, new_env};
use magex_nets::distribution::ActionHeads;
use magex_nets::executor::{self, Input, Network};
use magex_nets::features::{FeatureSpec, Features, JointStates, Symmetry};
use magex_nets::ops::GraphNoise;
use magex_nets::params::{ParamError, Params, Source, from_safetensors};
use magex_proto::goals::{GoalReply, GoalRequest};
use std::sync::Arc;

/// Why a shard could not be rolled out. E is the error of whoever hands out goals.
#[derive(Debug, thiserror::Error)]
pub enum RolloutError<E> {
    /// The environment refused.
    #[error(transparent)]
    Env(#[from] EnvError),
    /// The weights do not fit, or the tensor library refused.
    #[error(transparent)]
    Weights(#[from] ParamError),
    /// No goals.
    #[error("goals: {0}")]
    Goals(E),
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

/// What drives the agents.
enum Driver {
    /// The executor's actor network.
    Policy(Box<dyn Network>),
    /// The scripted controller: thrust that brings the predicted stopping point closest to the goal. A yardstick.
    Scripted,
}

/// Everything that is the same for all shards of a version of the weights.
pub struct Roller {
    config: RunConfig,
    spec: FeatureSpec,
    heads: ActionHeads,
    driver: Driver,
}

impl std::fmt::Debug for Roller {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Roller").field("task", &self.config.task).finish_non_exhaustive()
    }
}

impl Roller {
    /// With the actor network of a safetensors file (`actor.…`). `config.task` may have another team size than the one
    /// the weights were trained with, if the architecture allows it.
    pub fn new(config: &RunConfig, weights: &[u8]) -> Result<Self, ParamError> {
        let spec = executor::feature_spec(&config.executor, &config.task);
        let heads = heads(config)?;
        let build = |source: &mut Source<'_>| {
            executor::build(&config.executor, &spec, config.task.agents, heads.logits(), 0.01, source)
        };
        // The layout is that of a network drawn for this configuration; its numbers come from the file.
        let mut source = Source::new(Key::new(0, Purpose::Init, &[0]).stream());
        build(&mut source)?;
        let mut params = match source {
            Source::New { params, .. } => params,
            Source::Existing { .. } => Params::default(),
        };
        from_safetensors(weights, "actor", &mut params)?;
        let network = build(&mut params.source(params.plain()?))?;
        Ok(Self { config: config.clone(), spec, heads, driver: Driver::Policy(network) })
    }

    /// With the scripted controller instead of a policy (evaluation only).
    pub fn scripted(config: &RunConfig) -> Result<Self, ParamError> {
        let spec = executor::feature_spec(&config.executor, &config.task);
        Ok(Self { config: config.clone(), spec, heads: heads(config)?, driver: Driver::Scripted })
    }

    /// Rolls out all episodes of a shard side by side. `assign` is asked once for the goals of all of them.
    pub fn rollout<E>(
        &self,
        shard: &Shard,
        assign: impl FnOnce(&GoalRequest) -> Result<GoalReply, E>,
    ) -> Result<ShardResult, RolloutError<E>> {
        let (task, seed) = (&self.config.task, self.config.run.seed);
        let keep = shard.kind == ShardKind::Train;
        let shape = task.shape(shard.episodes as usize);
        let (b, n, steps) = (shape.episodes, shape.agents, shape.steps);
        let keys: Vec<_> = (0..shard.episodes).map(|e| episode_keys(seed, shard, e)).collect();

        // Reset, then goals, then the first observation: an agent never sees a goal of another episode.
        let mut worlds = new_env(task, keys.iter().map(|k| k.spawn.stream()), keep)?;
        let mut state = JointState::new(&shape, worlds.landmarks());
        state.read(worlds.as_ref())?;
        let request = state.goal_request(&shape, task.stages(), shard, seed);
        let reply = assign(&request).map_err(RolloutError::Goals)?;
        state.goals = chain(&shape, &reply.goals);
        worlds.set_goals(&state.goals)?;

        let mut out = columns(&shape, shard, keep);
        let mut recording = (Vec::new(), Vec::new());
        let mut actions = vec![0u8; b * n * shape.action_components];
        let (mut log_probs, mut rewards) = (vec![0.0; b * n], vec![0.0; b * n]);
        let mut policy = Policy::new(self, shard, b, &keys.iter().map(|k| k.graph).collect::<Vec<_>>());
        let mut streams: Vec<Stream> = keys.iter().map(|k| k.action.stream()).collect();
        for step in 0..=steps {
            state.read(worlds.as_ref())?;
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
            match &self.driver {
                Driver::Policy(network) => {
                    let features = self.spec.compute(&state.joint_states());
                    let logits = policy.logits(network.as_ref(), &features, step).map_err(ParamError::from)?;
                    if let Some(place) = logits.iter().position(|x| !x.is_finite()) {
                        return Err(RolloutError::NotFinite { place, step, version: shard.version.0 });
                    }
                    let width = self.heads.logits();
                    for row in 0..b * n {
                        let stream = (shard.mode == Mode::Sampled).then_some(&mut streams[row / n]);
                        log_probs[row] = self.heads.choose(
                            &logits[row * width..(row + 1) * width],
                            stream,
                            &mut actions[row * shape.action_components..(row + 1) * shape.action_components],
                        );
                    }
                    symmetries = features.symmetries;
                }
                Driver::Scripted => scripted(task, &state.view(), &mut actions)?,
            }
            if keep {
                out.actions.extend_from_slice(&actions);
            }
            // The policy chose in each agent's own frame.
            to_world(task.action_code(), shape.action_components, &symmetries, &mut actions);
            worlds.step(&actions, &mut rewards)?;
            if keep {
                out.log_probs.extend_from_slice(&log_probs);
                out.rewards.extend_from_slice(&rewards);
            }
        }
        let metrics = metrics(worlds.as_ref(), &reply, shape.goals_per_agent);
        if !keep {
            let recording = shard.record.then(|| Recording {
                shape: Shape { episodes: 1, ..shape },
                positions: recording.0,
                agent_state: recording.1,
                landmarks: state.landmarks[..shape.landmarks * shape.dims].to_vec(),
                goals: state.goals[..n * shape.goals_per_agent].to_vec(),
            });
            return Ok(ShardResult::Eval(EvalOutcome { shard: *shard, metrics, recording }));
        }
        out.landmarks = state.landmarks;
        out.goals = state.goals;
        out.goal_log_probs = reply.log_probs;
        out.costs = reply.costs;
        out.exact_costs = reply.exact_costs;
        out.metrics = metrics;
        Ok(ShardResult::Train(out))
    }
}

/// What the agents of B episodes see of them.
struct JointState {
    positions: Vec<f32>,
    velocities: Vec<f32>,
    agent_state: Vec<f32>,
    landmarks: Vec<f32>,
    goals: Vec<u32>,
}

impl JointState {
    fn new(shape: &Shape, landmarks: &[f32]) -> Self {
        let state = shape.episodes * shape.bodies * shape.dims;
        Self {
            positions: vec![0.0; state],
            velocities: vec![0.0; state],
            agent_state: vec![0.0; shape.episodes * shape.agents * shape.agent_state],
            landmarks: landmarks.to_vec(),
            goals: Vec::new(),
        }
    }

    fn read(&mut self, worlds: &dyn Env) -> Result<(), EnvError> {
        worlds.write_positions(&mut self.positions)?;
        worlds.write_velocities(&mut self.velocities)?;
        worlds.write_agent_state(&mut self.agent_state)
    }

    fn joint_states(&self) -> JointStates<'_> {
        JointStates {
            positions: &self.positions,
            velocities: &self.velocities,
            agent_state: &self.agent_state,
            landmarks: &self.landmarks,
            goals: &self.goals,
        }
    }

    fn view(&self) -> View<'_> {
        View {
            positions: &self.positions,
            velocities: &self.velocities,
            agent_state: &self.agent_state,
            landmarks: &self.landmarks,
            goals: &self.goals,
        }
    }

    /// The assignment problems of all episodes as they start.
    fn goal_request(&self, shape: &Shape, stages: &[Stage], shard: &Shard, seed: u64) -> GoalRequest {
        let group = |group: Group, episode: usize| {
            let (points, per_episode, first) = match group {
                Group::Agents => (&self.positions, shape.bodies, 0),
                Group::Balls => (&self.positions, shape.bodies, shape.agents),
                Group::Landmarks => (&self.landmarks, shape.landmarks, 0),
            };
            let from = (episode * per_episode + first) * shape.dims;
            &points[from..from + shape.agents * shape.dims]
        };
        let (mut agents, mut goals) = (Vec::new(), Vec::new());
        for episode in 0..shape.episodes {
            for stage in stages {
                agents.extend_from_slice(group(stage.from, episode));
                goals.extend_from_slice(group(stage.to, episode));
            }
        }
        GoalRequest {
            shard: *shard,
            seed,
            stages: stages.len(),
            agent_count: shape.agents,
            goal_count: shape.agents,
            dims: shape.dims,
            agents,
            goals,
        }
    }
}

/// [B, K, N] assignments, stage by stage, to the [B, N, K] goals that each agent finds by following them.
fn chain(shape: &Shape, assigned: &[u32]) -> Vec<u32> {
    let (n, k) = (shape.agents, shape.goals_per_agent);
    let mut goals = Vec::with_capacity(assigned.len());
    for episode in assigned.chunks_exact(n * k) {
        for agent in 0..n {
            let mut at = agent;
            for stage in episode.chunks_exact(n) {
                // Out of range cannot be: the reply was checked. If it were, the environment would refuse it.
                let next = stage.get(at).copied().unwrap_or(u32::MAX);
                goals.push(next);
                at = next as usize;
            }
        }
    }
    goals
}

/// Turns the policy's actions, in place, to the axes of the world; without frames they are along them already.
fn to_world(code: ActionCode, heads: usize, symmetries: &[Symmetry], actions: &mut [u8]) {
    for (symmetry, action) in symmetries.iter().zip(actions.chunks_exact_mut(heads)) {
        symmetry.act(code, action);
    }
}

/// What the episodes scored, and what the commander cost them.
fn metrics(worlds: &dyn Env, reply: &GoalReply, stages: usize) -> Vec<EpisodeMetrics> {
    let ratios: Vec<f32> = reply.costs.iter().zip(&reply.exact_costs).map(|(c, h)| c / h.max(1e-9)).collect();
    let episodes = worlds.scores().into_iter().zip(ratios.chunks_exact(stages.max(1)));
    let metrics = episodes.map(|(score, ratios)| EpisodeMetrics {
        success: score.success,
        matched_success: score.matched_success,
        spawn_success: score.spawn_success,
        arrival_step: score.arrival_step,
        collisions_per_agent_step: score.collisions_per_agent_step,
        collision_rate: score.collision_rate,
        reward: score.reward,
        cost_ratio: ratios.first().copied().unwrap_or(1.0),
        second_cost_ratio: ratios.get(1).copied(),
    });
    metrics.collect()
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
        landmarks: Vec::new(),
        goals: Vec::new(),
        actions: Vec::with_capacity(rows * shape.action_components),
        log_probs: Vec::with_capacity(rows),
        rewards: Vec::with_capacity(rows),
        goal_log_probs: Vec::new(),
        costs: Vec::new(),
        exact_costs: Vec::new(),
        metrics: Vec::new(),
    }
}

/// The memory and the noise of a batch of episodes.
struct Policy {
    hidden: Vec<f32>,
    noise: Option<Vec<u64>>,
    episodes: usize,
    agents: usize,
}

impl Policy {
    fn new(roller: &Roller, shard: &Shard, episodes: usize, graph: &[Key]) -> Self {
        let agents = roller.config.task.agents;
        let memory = match &roller.driver {
            Driver::Policy(network) => network.memory(),
            Driver::Scripted => 0,
        };
        let noise = (shard.mode == Mode::Sampled).then(|| graph.iter().map(|key| key.stream().bits64()).collect());
        Self { hidden: vec![0.0; episodes * agents * memory], noise, episodes, agents }
    }

    /// [B·N, A] logits of one joint step; the memory moves on.
    fn logits(&mut self, network: &dyn Network, features: &Features, step: usize) -> candle_core::Result<Vec<f32>> {
        let noise = match &self.noise {
            Some(bases) => GraphNoise::Keyed(Arc::new(bases.iter().map(|&base| sequence(base, step as u32)).collect())),
            None => GraphNoise::Off,
        };
        let output = network.forward(&Input {
            steps: 1,
            sequences: self.episodes,
            agents: self.agents,
            features,
            hidden: std::mem::take(&mut self.hidden),
            noise,
        })?;
        if let Some(states) = output.states {
            self.hidden = states.flatten_all()?.to_vec1()?;
        }
        output.out.flatten_all()?.to_vec1()
    }
}

fn heads(config: &RunConfig) -> Result<ActionHeads, ParamError> {
    ActionHeads::new(config.task.action_heads())
        .ok_or_else(|| ParamError::Mismatch("an action component must have 1 to 16 choices".to_owned()))
}
