//! Acting on raw positions, velocities and goals.
//!
//! Logits, probabilities and actions are along the axes of the world here, whatever frame an executor sees the world in.

use magex_core::config::RunConfig;
use magex_core::ids::Mode;
use magex_core::joint_state::JointState;
use magex_core::rng::{Key, Purpose, Stream};
use magex_core::statics::Statics;
use magex_core::task::{ActionCode, TaskConfig};
use magex_nets::distribution::ActionHeads;
use magex_nets::executor::{Act, Chooser, Input, Model};
use magex_nets::features::{Features, Symmetry};
use magex_nets::ops::GraphNoise;
use magex_nets::params::ParamError;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

/// Why a policy did not act.
#[derive(Debug, thiserror::Error)]
pub enum ActError {
    /// A field of the request is invalid.
    #[error("{field}: {problem}")]
    Invalid {
        /// Path of the field.
        field: String,
        /// What is wrong with it, and the remedy.
        problem: String,
    },
    /// The weights do not fit, or the tensor library refused.
    #[error(transparent)]
    Weights(#[from] ParamError),
    /// The policy's outputs are not finite.
    #[error(
        "the policy's logits are not finite: the weights are broken, or the numbers far outside of what it was trained on"
    )]
    NotFinite,
}

impl ActError {
    /// A field that is wrong.
    pub fn invalid(field: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::Invalid { field: field.into(), problem: problem.into() }
    }
}

/// B teams of N agents each, side by side. Everything is row-major; lengths in the units of the task, seen from the middle of its map.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Teams {
    /// B.
    pub teams: usize,
    /// D: 2 or 3.
    pub dims: usize,
    /// Side of the map, for policies that see absolute positions; by default that of their run, or the one of its density for
    /// another team size.
    pub side: Option<f32>,
    /// [B, N, D]
    pub positions: Vec<f32>,
    /// [B, N, D] per second.
    pub velocities: Vec<f32>,
    /// [B, N, D]: of the agent with the same index. Policies that observe all landmarks see them in this order.
    pub goals: Vec<f32>,
    /// [B, N, D]: the ball of the agent with the same index; Push Ball only.
    pub balls: Vec<f32>,
    /// [B, N, D]; Push Ball only.
    pub ball_velocities: Vec<f32>,
    /// [B, N, X]: further state of the agents; drones only.
    pub agent_state: Vec<f32>,
}

/// What a policy decides.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Decision {
    /// [B·N, H] choices.
    pub actions: Vec<u8>,
    /// [B·N, A] logits, or action values, of all choices.
    pub logits: Vec<f32>,
    /// [B·N, A] probabilities of all choices. Of action values: 1 for the best one.
    pub probabilities: Vec<f32>,
    /// [B·N, M] what the agents carry to the next step.
    pub memory: Vec<f32>,
}

/// How actions are chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Choice {
    /// The most likely ones, or drawn.
    pub mode: Mode,
    /// Seed of the draws.
    pub seed: u64,
}

impl Choice {
    /// The most likely actions.
    pub const GREEDY: Self = Self { mode: Mode::Greedy, seed: 0 };
}

/// The policy of a weights file for teams of one size.
pub struct TeamPolicy {
    model: Model,
    policy: Box<dyn Act>,
    task: TaskConfig,
    values: bool,
}

impl std::fmt::Debug for TeamPolicy {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("TeamPolicy").field("task", &self.task).finish_non_exhaustive()
    }
}

/// Refuses the policies of external environments: what they see is known to the environment alone.
pub(crate) fn check_simulated(config: &RunConfig) -> Result<(), ParamError> {
    match config.task.external() {
        Ok(external) => Err(ParamError::Mismatch(format!(
            "task: {} is an environment of its own, which makes the observations; acting, traces and exports know the \
             simulated tasks, for this one there are magex eval and magex replay",
            external.environment
        ))),
        Err(_) => Ok(()),
    }
}

impl TeamPolicy {
    /// Loads it for the team size of `config.task`.
    ///
    /// # Errors
    /// The weights do not fit the configuration.
    pub fn load(config: &RunConfig, weights: &[u8]) -> Result<Self, ParamError> {
        check_simulated(config)?;
        let model = Model::new(config)?;
        let policy = model.load_policy(weights)?;
        Ok(Self { model, policy, task: config.task.clone(), values: config.run.algorithm.off_policy() })
    }

    /// M: numbers that an agent carries from step to step.
    pub fn memory(&self) -> usize {
        self.model.memory()
    }

    /// A: choices of all components of an action.
    pub fn choices(&self) -> &[usize] {
        self.model.heads().sizes()
    }

    /// Acts for joint states. `memory` [B·N, M] is what the previous step returned, or zeros.
    ///
    /// # Errors
    /// The policy's outputs are not finite.
    pub fn act(&self, state: &JointState<'_>, memory: Vec<f32>, choice: Choice) -> Result<Decision, ActError> {
        self.act_and_see(state, memory, choice).map(|(decision, _)| decision)
    }

    /// The same, with what the networks saw.
    ///
    /// # Errors
    /// As those of `act`.
    pub fn act_and_see(
        &self,
        state: &JointState<'_>,
        memory: Vec<f32>,
        choice: Choice,
    ) -> Result<(Decision, Arc<Features>), ActError> {
        let shape = self.task.shape(1);
        let n = shape.agents;
        let teams = state.positions.len() / (shape.bodies * shape.dims);
        let features = Arc::new(self.model.spec().compute(state));
        let mut streams = (choice.mode == Mode::Sampled)
            .then(|| (0..teams as u32).map(|t| Key::new(choice.seed, Purpose::Request, &[t]).stream()).collect());
        let noise = match &mut streams {
            None => GraphNoise::Off,
            Some(streams) => {
                let streams: &mut Vec<Stream> = streams;
                GraphNoise::Keyed(Arc::new(streams.iter_mut().map(Stream::bits64).collect()))
            }
        };
        let heads = self.model.heads();
        let rows = teams * n;
        let mut chosen = Recorder {
            heads,
            agents: n,
            values: self.values,
            streams,
            actions: vec![0; rows * heads.count()],
            logits: vec![0.0; rows * heads.logits()],
        };
        let input = Input { steps: 1, sequences: teams, agents: n, features: &features, hidden: memory, noise };
        let states = self.policy.act(&input, &mut chosen).map_err(ParamError::from)?;
        let memory = match states {
            Some(states) => states.flatten_all().and_then(|all| all.to_vec1()).map_err(ParamError::from)?,
            None => Vec::new(),
        };
        let Recorder { mut actions, mut logits, .. } = chosen;
        if !logits.iter().chain(&memory).all(|x| x.is_finite()) {
            return Err(ActError::NotFinite);
        }
        self.to_world(&features.symmetries, &mut actions, &mut logits);
        let probabilities = self.probabilities(&logits);
        Ok((Decision { actions, logits, probabilities, memory }, features))
    }

    /// Turns actions and logits, in place, to the axes of the world.
    fn to_world(&self, symmetries: &[Symmetry], actions: &mut [u8], logits: &mut [f32]) {
        let (heads, code) = (self.model.heads(), self.task.action_code());
        let rows = actions.chunks_exact_mut(heads.count()).zip(logits.chunks_exact_mut(heads.logits()));
        for (symmetry, (action, logits)) in symmetries.iter().zip(rows) {
            symmetry.act(code, action);
            if code == ActionCode::Thrust {
                let own = logits.to_vec();
                for (choice, logit) in own.into_iter().enumerate() {
                    let mut world = [choice as u8];
                    symmetry.act(code, &mut world);
                    logits[usize::from(world[0])] = logit;
                }
            }
        }
    }

    fn probabilities(&self, logits: &[f32]) -> Vec<f32> {
        let heads = self.model.heads();
        let mut out = vec![0.0; logits.len()];
        for (row, out) in logits.chunks_exact(heads.logits()).zip(out.chunks_exact_mut(heads.logits())) {
            if self.values {
                let mut best = vec![0; heads.count()];
                heads.best(row, &mut best);
                heads.mark(&best, out);
            } else {
                heads.log_softmax(row, out);
                out.iter_mut().for_each(|x| *x = libm::expf(*x));
            }
        }
        out
    }
}

/// Keeps what it is shown and what it chooses.
struct Recorder<'a> {
    heads: &'a ActionHeads,
    agents: usize,
    values: bool,
    streams: Option<Vec<Stream>>,
    actions: Vec<u8>,
    logits: Vec<f32>,
}

impl Chooser for Recorder<'_> {
    fn choose(&mut self, row: usize, logits: &[f32]) -> &[u8] {
        let (count, width) = (self.heads.count(), self.heads.logits());
        self.logits[row * width..(row + 1) * width].copy_from_slice(logits);
        let action = &mut self.actions[row * count..(row + 1) * count];
        if self.values {
            // Action values are no distribution to draw from.
            self.heads.best(logits, action);
        } else {
            let stream = self.streams.as_mut().map(|streams| &mut streams[row / self.agents]);
            self.heads.choose(logits, stream, action);
        }
        action
    }
}

/// The policy of a weights file for teams of any size that its architecture allows.
#[derive(Debug)]
pub struct Policies {
    config: RunConfig,
    weights: Arc<[u8]>,
    /// By team size and bits of the side.
    loaded: Mutex<BTreeMap<(usize, u32), Arc<TeamPolicy>>>,
}

/// Team sizes that are kept loaded.
const SIZES: usize = 64;

impl Policies {
    /// Loads it, for the team size of its configuration first.
    ///
    /// # Errors
    /// The weights do not fit.
    pub fn load(config: &RunConfig, weights: &[u8]) -> Result<Self, ParamError> {
        let own = TeamPolicy::load(config, weights)?;
        let key = (config.task.agents, config.task.side.to_bits());
        let loaded = Mutex::new(BTreeMap::from([(key, Arc::new(own))]));
        Ok(Self { config: config.clone(), weights: weights.into(), loaded })
    }

    /// The configuration of its run.
    pub fn config(&self) -> &RunConfig {
        &self.config
    }

    /// For teams of N agents on a map of a side; see [`Teams::side`].
    ///
    /// # Errors
    /// The architecture has a fixed team size.
    pub fn of_size(&self, agents: usize, side: Option<f32>) -> Result<Arc<TeamPolicy>, ActError> {
        let (own, kind) = (self.config.task.agents, self.config.executor.kind);
        if agents != own && kind.fixed_team_size() {
            let problem = format!("{agents} agents; the {kind} executor of this run was built for {own}");
            return Err(ActError::invalid("positions", problem));
        }
        let task = &self.config.task;
        let side = side.unwrap_or_else(|| if agents == own { task.side } else { task.clone().resized(agents).side });
        let lock = || self.loaded.lock().unwrap_or_else(PoisonError::into_inner);
        let key = (agents, side.to_bits());
        if let Some(loaded) = lock().get(&key) {
            return Ok(loaded.clone());
        }
        let mut config = self.config.clone();
        (config.task.agents, config.task.side) = (agents, side);
        let policy = Arc::new(TeamPolicy::load(&config, &self.weights)?);
        let mut loaded = lock();
        if loaded.len() >= SIZES {
            loaded.clear();
        }
        loaded.insert(key, policy.clone());
        Ok(policy)
    }

    /// Checks B teams: sizes and finiteness. Returns N.
    ///
    /// # Errors
    /// A field that is wrong, by name.
    pub fn check(&self, teams: &Teams) -> Result<usize, ActError> {
        let task = &self.config.task;
        let (dims, b) = (task.dims(), teams.teams.max(1));
        if teams.dims != dims {
            let problem = format!("{}; {} has {dims} dimensions", teams.dims, task.name);
            return Err(ActError::invalid("dims", problem));
        }
        if let Some(side) = teams.side.filter(|side| !(*side > 0.0 && *side <= 10_000.0)) {
            return Err(ActError::invalid("side", format!("{side}; must be a positive length up to 10000")));
        }
        let count = teams.positions.len();
        if count == 0 || !count.is_multiple_of(b * dims) {
            let problem = format!(
                "{count} numbers are not {b} teams × agents × {dims}; send [teams, agents, dims], at least one agent"
            );
            return Err(ActError::invalid("positions", problem));
        }
        let n = count / (b * dims);
        let balls = if task.balls() > 0 { count } else { 0 };
        let fields: [(&str, &[f32], usize); 6] = [
            ("positions", &teams.positions, count),
            ("velocities", &teams.velocities, count),
            ("goals", &teams.goals, count),
            ("balls", &teams.balls, balls),
            ("ball_velocities", &teams.ball_velocities, balls),
            ("agent_state", &teams.agent_state, b * n * task.agent_state()),
        ];
        for (field, values, wanted) in fields {
            if values.len() != wanted {
                let why = match wanted {
                    0 => format!("{} has none; leave it out", task.name),
                    _ => format!("{b} teams of {n} agents need {wanted}"),
                };
                return Err(ActError::invalid(field, format!("{} numbers; {why}", values.len())));
            }
            // Far beyond any map, and squares of it are finite.
            if let Some(at) = values.iter().position(|x| x.is_nan() || x.abs() > LARGEST) {
                let problem = format!("{}; must be finite and at most {LARGEST:e} in magnitude", values[at]);
                return Err(ActError::invalid(format!("{field}[{at}]"), problem));
            }
        }
        Ok(n)
    }

    /// Acts for B teams. `memory` [B·N, M] is what the previous step returned; `None` begins an episode.
    ///
    /// # Errors
    /// A field that is wrong, a team size that the architecture does not serve, weights that are broken.
    pub fn act(&self, teams: &Teams, memory: Option<Vec<f32>>, choice: Choice) -> Result<Decision, ActError> {
        let n = self.check(teams)?;
        let policy = self.of_size(n, teams.side)?;
        let b = teams.teams.max(1);
        let wanted = b * n * policy.memory();
        let memory = memory.unwrap_or_else(|| vec![0.0; wanted]);
        if memory.len() != wanted {
            let problem = format!("{} numbers; {b} teams of {n} agents carry {wanted}", memory.len());
            return Err(ActError::invalid("memory", problem));
        }
        let joint = Joint::new(&self.config.task, teams, n);
        policy.act(&joint.state(), memory, choice)
    }
}

/// Largest coordinate, velocity or further number.
const LARGEST: f32 = 1e9;

/// Teams as joint states: agents, then balls.
struct Joint {
    positions: Vec<f32>,
    velocities: Vec<f32>,
    agent_state: Vec<f32>,
    statics: Statics,
    goals: Vec<u32>,
}

impl Joint {
    fn new(task: &TaskConfig, teams: &Teams, n: usize) -> Self {
        let (b, d, stages) = (teams.teams.max(1), teams.dims, task.stages().len());
        let bodies = |agents: &[f32], balls: &[f32]| match balls.is_empty() {
            true => agents.to_vec(),
            false => {
                agents.chunks_exact(n * d).zip(balls.chunks_exact(n * d)).flat_map(|(a, b)| [a, b].concat()).collect()
            }
        };
        Self {
            positions: bodies(&teams.positions, &teams.balls),
            velocities: bodies(&teams.velocities, &teams.ball_velocities),
            agent_state: teams.agent_state.clone(),
            statics: Statics::landmarks(n, d, teams.goals.clone()),
            // Everything of agent i has the index i.
            goals: (0..b * n).flat_map(|row| std::iter::repeat_n((row % n) as u32, stages)).collect(),
        }
    }

    fn state(&self) -> JointState<'_> {
        JointState {
            positions: &self.positions,
            velocities: &self.velocities,
            agent_state: &self.agent_state,
            world_states: &[],
            masks: &[],
            marks: &[],
            statics: self.statics.view(),
            goals: &self.goals,
        }
    }
}

#[cfg(test)]
mod tests;
