//! Rolling out a shard: a pure function of the shard, the run's seed and task, the weights it names, and the goals that
//! the commander hands out. Nothing here knows a clock, a thread or an address.

use magex_core::config::RunConfig;
use magex_core::ids::{Mode, Shard, ShardKind};
use magex_core::keys::episode_keys;
use magex_core::rng::{Key, Purpose, Stream, sequence};
use magex_core::trajectory::{EvalOutcome, Recording, Shape, ShardResult, Trajectory};
use magex_env::scripted::scripted_actions;
use magex_env::{EnvError, Spread};
use magex_nets::distribution::ActionHeads;
use magex_nets::executor::{self, Input, Network};
use magex_nets::features::{FeatureSpec, Features, JointStates};
use magex_nets::ops::GraphNoise;
use magex_nets::params::{ParamError, Params, Source, from_safetensors};
use magex_proto::goals::{GoalReply, GoalRequest, SchedulerKind};
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
        let (b, n, d) = (shard.episodes as usize, task.agents, task.dims());
        let steps = task.horizon as usize;
        let keys: Vec<_> = (0..shard.episodes).map(|e| episode_keys(seed, shard, e)).collect();

        // Reset, then goals, then the first observation: an agent never sees a goal of another episode.
        let mut worlds = Spread::new(task, keys.iter().map(|k| k.spawn.stream()))?;
        let landmarks = worlds.landmarks().to_vec();
        let request = GoalRequest {
            shard: *shard,
            seed,
            scheduler: SchedulerKind::Learned,
            agent_count: n,
            goal_count: n,
            dims: d,
            agents: worlds.positions(),
            goals: landmarks.clone(),
        };
        let reply = assign(&request).map_err(RolloutError::Goals)?;
        worlds.set_goals(&reply.goals)?;

        let shape = Shape {
            steps,
            episodes: b,
            agents: n,
            bodies: n,
            landmarks: n,
            dims: d,
            targets: 1,
            heads: self.heads.count(),
        };
        let state = b * n * d;
        let keep = shard.kind == ShardKind::Train;
        let mut out = columns(&shape, shard, keep);
        let mut recording = Vec::new();
        let (mut positions, mut velocities) = (vec![0.0; state], vec![0.0; state]);
        let mut actions = vec![0u8; b * n * shape.heads];
        let (mut log_probs, mut rewards) = (vec![0.0; b * n], vec![0.0; b * n]);
        let targets = target_positions(&landmarks, &reply.goals, n, d);
        let mut policy = Policy::new(self, shard, b, &keys.iter().map(|k| k.graph).collect::<Vec<_>>());
        let mut streams: Vec<Stream> = keys.iter().map(|k| k.action.stream()).collect();
        for step in 0..=steps {
            worlds.write_positions(&mut positions)?;
            worlds.write_velocities(&mut velocities)?;
            if keep {
                out.positions.extend_from_slice(&positions);
                out.velocities.extend_from_slice(&velocities);
            } else if shard.record {
                recording.extend_from_slice(&positions[..n * d]);
            }
            if step == steps {
                break;
            }
            match &self.driver {
                Driver::Policy(network) => {
                    let states = JointStates {
                        agents: n,
                        dims: d,
                        targets_per_agent: 1,
                        positions: &positions,
                        velocities: &velocities,
                        targets: &targets,
                    };
                    let features = self.spec.compute(&states);
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
                            &mut actions[row * shape.heads..(row + 1) * shape.heads],
                        );
                    }
                }
                Driver::Scripted => {
                    scripted_actions(&positions, &velocities, &landmarks, &reply.goals, n, &mut actions)?;
                }
            }
            worlds.step(&actions, &mut rewards)?;
            if keep {
                out.actions.extend_from_slice(&actions);
                out.log_probs.extend_from_slice(&log_probs);
                out.rewards.extend_from_slice(&rewards);
            }
        }
        let ratios: Vec<f32> = reply.costs.iter().zip(&reply.exact_costs).map(|(c, h)| c / h.max(1e-9)).collect();
        let metrics = worlds.metrics(&ratios)?;
        if !keep {
            let recording = shard.record.then(|| Recording {
                shape: Shape { episodes: 1, ..shape },
                positions: recording,
                landmarks: landmarks[..n * d].to_vec(),
                goals: reply.goals[..n].to_vec(),
            });
            return Ok(ShardResult::Eval(EvalOutcome { shard: *shard, metrics, recording }));
        }
        out.landmarks = landmarks;
        out.goals = reply.goals;
        out.goal_log_probs = reply.log_probs;
        out.costs = reply.costs;
        out.exact_costs = reply.exact_costs;
        out.metrics = metrics;
        Ok(ShardResult::Train(out))
    }
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
        landmarks: Vec::new(),
        goals: Vec::new(),
        actions: Vec::with_capacity(rows * shape.heads),
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

/// [B, N, D] position of every agent's goal.
fn target_positions(landmarks: &[f32], goals: &[u32], n: usize, d: usize) -> Vec<f32> {
    let mut out = Vec::with_capacity(goals.len() * d);
    for (row, &goal) in goals.iter().enumerate() {
        let at = (row / n * n + goal as usize) * d;
        out.extend_from_slice(&landmarks[at..at + d]);
    }
    out
}
