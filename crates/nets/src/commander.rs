//! The goal commander (paper, section 4.1) assigns goals to agents, once per episode.
//!
//! | kind | decision |
//! |---|---|
//! | `pairwise` | a score for every (agent, goal) pair; the agent of the largest regret picks next among the goals still free. Equivariant, any N |
//! | `ranking` | the paper's Goal Scheduler: one score per goal, ranked, handed to the agents in canonical order |
//! | `exact` | the least summed distance (Jonker–Volgenant; the paper's "Hungarian"), or sum of its powers |
//! | `makespan` | the shortest longest distance; among those the least sum, or sum of powers |
//! | `greedy` | the shortest remaining way of an agent to a goal, repeatedly |
//! | `random` | a random permutation (the paper's ablation "w. RG") |

mod instance;
mod pairwise;
mod ranking;

use crate::ops::{Pick, PickTable, pick_log_probs};
use crate::params::{Entry, ParamBuilder, ParamError, Params};
use candle_core::{Result as CandleResult, Tensor};
use magex_assign::random::random;
use magex_assign::{AssignError, BottleneckSolver, Solver, Switching, distance, exact_points, greedy, powered};
use magex_core::config::{CommanderConfig, CommanderPolicy};
use magex_core::ids::Mode;
use magex_core::rng::{Key, Purpose, Stream};
use std::sync::Arc;

pub use instance::Instance;
pub use pairwise::PairwiseNet;
pub use ranking::RankingNet;

/// Why goals could not be assigned.
#[derive(Debug, thiserror::Error)]
pub enum CommanderError {
    /// The instance is not one that this scheduler can serve; names the field and the remedy.
    #[error("{0}")]
    Instance(String),
    /// The solver refused.
    #[error(transparent)]
    Assign(#[from] AssignError),
    /// The weights do not fit, or the tensor library refused.
    #[error(transparent)]
    Weights(#[from] ParamError),
    /// The caller no longer waits for the answer.
    #[error("interrupted")]
    Interrupted,
}

impl From<candle_core::Error> for CommanderError {
    fn from(error: candle_core::Error) -> Self {
        Self::Weights(ParamError::Tensor(error))
    }
}

/// One team: agents [N, D] and goals [G, D], world units.
#[derive(Debug, Clone, Copy)]
pub struct Team<'a> {
    /// [N, D]
    pub agents: &'a [f32],
    /// [G, D]
    pub goals: &'a [f32],
    /// D.
    pub dims: usize,
}

impl Team<'_> {
    fn agent_count(&self) -> usize {
        self.agents.len() / self.dims
    }

    fn goal_count(&self) -> usize {
        self.goals.len() / self.dims
    }
}

/// A decision and its probability.
#[derive(Debug, Clone, PartialEq)]
pub struct Decision {
    /// `[N]` goal of each agent; `u32::MAX` where there are more agents than goals.
    pub goals: Vec<u32>,
    /// Log-probability of the whole decision; 0 for schedulers that are not learned.
    pub log_prob: f32,
    /// `[N]` probability of each agent's pick when it was made; 1 for schedulers that are not learned.
    pub probabilities: Vec<f32>,
}

enum Net {
    Pairwise(PairwiseNet),
    Ranking(RankingNet),
}

/// A scheduler of any kind.
pub struct Commander {
    kind: CommanderPolicy,
    /// Exponent of the distances; 1 for schedulers that do not know it.
    power: f64,
    net: Option<Net>,
}

impl std::fmt::Debug for Commander {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Commander").field("kind", &self.kind).finish_non_exhaustive()
    }
}

impl Commander {
    /// Builds the kind that the configuration names; `agents` and `dims` matter to `ranking` only.
    pub fn build(
        config: &CommanderConfig,
        agents: usize,
        dims: usize,
        params: &mut ParamBuilder,
    ) -> Result<Self, ParamError> {
        let net = match config.kind {
            CommanderPolicy::Pairwise => Some(Net::Pairwise(PairwiseNet::build(config.hidden, params)?)),
            CommanderPolicy::Ranking => {
                Some(Net::Ranking(RankingNet::build(config.hidden, agents, dims, config.order, params)?))
            }
            CommanderPolicy::Exact | CommanderPolicy::Makespan | CommanderPolicy::Greedy | CommanderPolicy::Random => {
                None
            }
        };
        Ok(Self { kind: config.kind, power: config.power, net })
    }

    /// Names, shapes and initial distributions of the parameters; none for schedulers that are not learned.
    pub(crate) fn layout(config: &CommanderConfig, agents: usize, dims: usize) -> Result<Vec<Entry>, ParamError> {
        let mut params = ParamBuilder::layout();
        Self::build(config, agents, dims, &mut params)?;
        Ok(params.entries())
    }

    /// Initial parameters.
    pub fn init(config: &CommanderConfig, agents: usize, dims: usize, seed: u64) -> Result<Params, ParamError> {
        let stream = Key::new(seed, Purpose::Init, &[2]).stream();
        Ok(Params::init(Self::layout(config, agents, dims)?, stream))
    }

    /// With given parameters, as constants.
    pub fn of(config: &CommanderConfig, agents: usize, dims: usize, params: &Params) -> Result<Self, ParamError> {
        Self::build(config, agents, dims, &mut ParamBuilder::with(params.tensors()?))
    }

    /// From the `commander.…` tensors of a safetensors file.
    pub fn load(config: &CommanderConfig, agents: usize, dims: usize, weights: &[u8]) -> Result<Self, ParamError> {
        let params = Params::load(Self::layout(config, agents, dims)?, weights, "commander")?;
        Self::of(config, agents, dims, &params)
    }

    /// A scheduler without weights, of distances as they are.
    pub fn classical(kind: CommanderPolicy) -> Option<Self> {
        (!kind.learned()).then_some(Self { kind, power: 1.0, net: None })
    }

    /// The same with an exponent of the distances.
    pub fn with_power(self, power: f64) -> Self {
        Self { power, ..self }
    }

    /// Which kind it is.
    pub fn kind(&self) -> CommanderPolicy {
        self.kind
    }

    /// Assigns goals. `stream` is read when sampling, and by `random` always.
    pub fn assign(&self, team: &Team<'_>, mode: Mode, stream: &mut Stream) -> Result<Decision, CommanderError> {
        let n = team.agent_count();
        let classical = |goals: Vec<u32>| Decision { probabilities: vec![1.0; goals.len()], goals, log_prob: 0.0 };
        match (&self.net, self.kind) {
            (Some(_), _) => {
                let instance = self.instance(team)?;
                let scores = self.scores(&[&instance])?.flatten_all()?.to_vec1::<f32>()?;
                let stream = (mode == Mode::Sampled).then_some(stream);
                Ok(instance.decide(&scores, stream).0)
            }
            (None, CommanderPolicy::Random) => Ok(classical(random(n, team.goal_count(), stream)?)),
            (None, CommanderPolicy::Greedy) => Ok(classical(greedy_goals(team)?)),
            (None, CommanderPolicy::Makespan) => Ok(classical(shortest_longest(team, self.power)?)),
            (None, _) if self.power == 1.0 => Ok(classical(exact_points(team.agents, team.goals, team.dims)?.0)),
            (None, _) => {
                let costs = powers(team, self.power);
                Ok(classical(Solver::default().solve(&costs, n, team.goal_count())?.col_of_row))
            }
        }
    }

    /// What the network sees of a team.
    pub fn instance(&self, team: &Team<'_>) -> Result<Instance, CommanderError> {
        match &self.net {
            Some(Net::Pairwise(_)) => pairwise::instance(team, self.power),
            Some(Net::Ranking(net)) => net.instance(team),
            None => Err(CommanderError::Instance(format!("the {} scheduler has no network", self.kind))),
        }
    }

    /// Flat scores of several instances, one score matrix after the other.
    pub fn scores(&self, instances: &[&Instance]) -> Result<Tensor, CommanderError> {
        match &self.net {
            Some(Net::Pairwise(net)) => Ok(net.forward(instances)?),
            Some(Net::Ranking(net)) => Ok(net.forward(instances)?),
            None => Err(CommanderError::Instance(format!("the {} scheduler has no network", self.kind))),
        }
    }

    /// [2, P] log-probabilities and entropies of all picks of given decisions, differentiable in the network's weights.
    pub fn pick_log_probs(&self, instances: &[&Instance], picks: &[&[Pick]]) -> Result<Tensor, CommanderError> {
        Ok(Self::log_probs_of(&self.scores(instances)?, instances, picks)?)
    }

    /// The same, given the [`Self::scores`].
    pub fn log_probs_of(scores: &Tensor, instances: &[&Instance], picks: &[&[Pick]]) -> CandleResult<Tensor> {
        let mut end = 0;
        let tables = instances.iter().zip(picks).map(|(instance, picks)| {
            let start = end;
            end += instance.cells();
            PickTable { start, columns: instance.columns, picks: picks.to_vec() }
        });
        pick_log_probs(scores, Arc::new(tables.collect()))
    }
}

/// Distances `[N, G]`, raised to a power.
fn powers(team: &Team<'_>, power: f64) -> Vec<f64> {
    let (agents, goals) = (team.agents.chunks_exact(team.dims), team.goals.chunks_exact(team.dims));
    agents.flat_map(|agent| goals.clone().map(|goal| powered(distance(agent, goal), power))).collect()
}

/// The goals that greedy assignment by distance gives.
fn greedy_goals(team: &Team<'_>) -> Result<Vec<u32>, AssignError> {
    Ok(greedy(&powers(team, 1.0), team.agent_count(), team.goal_count(), &|| true)?.col_of_row)
}

/// The goals with the shortest longest distance; among those the least sum of powers.
fn shortest_longest(team: &Team<'_>, power: f64) -> Result<Vec<u32>, AssignError> {
    let (costs, agents, goals) = (powers(team, power), team.agent_count(), team.goal_count());
    Ok(BottleneckSolver::default().solve_switching(&costs, agents, goals, &Switching::default(), &|| true)?.col_of_row)
}
