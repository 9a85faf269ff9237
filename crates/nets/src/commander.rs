//! The goal commander (paper, section 4.1): who goes where, decided once per episode.
//!
//! | kind | decision |
//! |---|---|
//! | `pairwise` | a score for every (agent, goal) pair; agents pick in turn among the goals still free. Equivariant, any N |
//! | `ranking` | the paper's Goal Scheduler: one score per goal, ranked, handed to the agents in canonical order |
//! | `exact` | the least summed distance (Jonker–Volgenant; the paper's "Hungarian") |
//! | `random` | a random permutation (the paper's ablation "w. RG") |

mod pairwise;
mod ranking;

use crate::ops::{Pick, PickTable, masked_log_softmax, pick_log_probs};
use crate::params::{ParamError, Params, Source, from_safetensors};
use candle_core::{Device, Tensor};
use magex_assign::duals::{Schedule, sinkhorn_duals};
use magex_assign::random::random;
use magex_assign::{AssignError, exact_points};
use magex_core::config::{CommanderConfig, CommanderKind};
use magex_core::ids::Mode;
use magex_core::rng::{Key, Purpose, Stream};
use std::sync::Arc;

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

/// What a learned scheduler sees of a team, computed once.
#[derive(Debug, Clone)]
pub struct Instance {
    /// Network input.
    features: Vec<f32>,
    /// Rows of the score matrix (1 for `ranking`).
    rows: usize,
    /// Columns of the score matrix.
    columns: usize,
    /// For each pick in turn: the row that picks and whom it stands for.
    turns: Vec<(u32, u32)>,
    /// Column → goal (or agent, when goals pick agents because there are fewer of them).
    column_of: Vec<u32>,
    /// Goals pick agents.
    swapped: bool,
    agents: usize,
}

/// A network that scores instances.
enum Net {
    Pairwise(PairwiseNet),
    Ranking(RankingNet),
}

/// A scheduler of any kind.
pub struct Commander {
    kind: CommanderKind,
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
        source: &mut Source<'_>,
    ) -> Result<Self, ParamError> {
        let net = match config.kind {
            CommanderKind::Pairwise => Some(Net::Pairwise(PairwiseNet::build(config.hidden, source)?)),
            CommanderKind::Ranking => {
                Some(Net::Ranking(RankingNet::build(config.hidden, agents, dims, config.order, source)?))
            }
            CommanderKind::Exact | CommanderKind::Random => None,
        };
        Ok(Self { kind: config.kind, net })
    }

    /// Fresh parameters (empty for schedulers that are not learned).
    pub fn start(config: &CommanderConfig, agents: usize, dims: usize, seed: u64) -> Result<Params, ParamError> {
        let mut source = Source::new(Key::new(seed, Purpose::Init, &[2]).stream());
        Self::build(config, agents, dims, &mut source)?;
        match source {
            Source::New { params, .. } => Ok(params),
            Source::Existing { .. } => Err(ParamError::Mismatch("a new source became an existing one".to_owned())),
        }
    }

    /// From the `commander.…` tensors of a safetensors file.
    pub fn load(config: &CommanderConfig, agents: usize, dims: usize, weights: &[u8]) -> Result<Self, ParamError> {
        let mut params = Self::start(config, agents, dims, 0)?;
        from_safetensors(weights, "commander", &mut params)?;
        Self::build(config, agents, dims, &mut params.source(params.plain()?))
    }

    /// A scheduler without weights.
    pub fn classical(kind: CommanderKind) -> Option<Self> {
        (!kind.learned()).then_some(Self { kind, net: None })
    }

    /// Which kind it is.
    pub fn kind(&self) -> CommanderKind {
        self.kind
    }

    /// Assigns goals. `stream` is read when sampling, and by `random` always.
    pub fn assign(&self, team: &Team<'_>, mode: Mode, stream: &mut Stream) -> Result<Decision, CommanderError> {
        let n = team.agent_count();
        let classical = |goals: Vec<u32>| Decision { probabilities: vec![1.0; goals.len()], goals, log_prob: 0.0 };
        match (&self.net, self.kind) {
            (Some(_), _) => {
                let instance = self.instance(team)?;
                let scores = self.scores(std::slice::from_ref(&instance))?.flatten_all()?.to_vec1::<f32>()?;
                let stream = (mode == Mode::Sampled).then_some(stream);
                Ok(instance.decide(&scores, stream).0)
            }
            (None, CommanderKind::Random) => Ok(classical(random(n, team.goal_count(), stream)?)),
            (None, _) => Ok(classical(exact_points(team.agents, team.goals, team.dims)?.0)),
        }
    }

    /// What the network sees of a team.
    pub fn instance(&self, team: &Team<'_>) -> Result<Instance, CommanderError> {
        match &self.net {
            Some(Net::Pairwise(_)) => pairwise::instance(team),
            Some(Net::Ranking(net)) => net.instance(team),
            None => Err(CommanderError::Instance(format!("the {} scheduler has no network", self.kind))),
        }
    }

    /// Flat scores of several instances, one score matrix after the other.
    pub fn scores(&self, instances: &[Instance]) -> Result<Tensor, CommanderError> {
        let count: usize = instances.iter().map(|i| i.features.len()).sum();
        let mut features = Vec::with_capacity(count);
        instances.iter().for_each(|i| features.extend_from_slice(&i.features));
        match &self.net {
            Some(Net::Pairwise(net)) => Ok(net.forward(features)?),
            Some(Net::Ranking(net)) => Ok(net.forward(features)?),
            None => Err(CommanderError::Instance(format!("the {} scheduler has no network", self.kind))),
        }
    }

    /// [2, P] log-probabilities and entropies of all picks of given decisions, differentiable in the network's weights.
    pub fn pick_log_probs(&self, instances: &[Instance], picks: &[Vec<Pick>]) -> Result<Tensor, CommanderError> {
        let mut start = 0;
        let mut tables = Vec::with_capacity(instances.len());
        for (instance, picks) in instances.iter().zip(picks) {
            tables.push(PickTable { start, columns: instance.columns, picks: picks.clone() });
            start += instance.rows * instance.columns;
        }
        Ok(pick_log_probs(&self.scores(instances)?, Arc::new(tables))?)
    }
}

impl Instance {
    /// Picks in turn: the best free column, or a sample. Returns the decision and its picks.
    pub fn decide(&self, scores: &[f32], mut stream: Option<&mut Stream>) -> (Decision, Vec<Pick>) {
        let mut free = vec![true; self.columns];
        let mut log_probs = vec![0.0f32; self.columns];
        let mut decision =
            Decision { goals: vec![u32::MAX; self.agents], log_prob: 0.0, probabilities: vec![0.0; self.agents] };
        let mut picks = Vec::with_capacity(self.turns.len());
        for &(row, who) in &self.turns {
            let scores = &scores[row as usize * self.columns..(row as usize + 1) * self.columns];
            masked_log_softmax(scores, &free, &mut log_probs);
            let open = || log_probs.iter().zip(&free).enumerate().filter(|(_, (_, f))| **f).map(|(j, (x, _))| (j, *x));
            let best = open().fold((0, f32::NEG_INFINITY), |best, next| if next.1 > best.1 { next } else { best }).0;
            let column = match &mut stream {
                None => best,
                Some(stream) => {
                    let u = stream.uniform32();
                    let mut sum = 0.0;
                    open()
                        .find(|(_, x)| {
                            sum += libm::expf(*x);
                            u < sum
                        })
                        .map_or(best, |(j, _)| j)
                }
            };
            free[column] = false;
            decision.log_prob += log_probs[column];
            let target = self.column_of[column];
            let (agent, goal) = if self.swapped { (target, who) } else { (who, target) };
            decision.goals[agent as usize] = goal;
            decision.probabilities[agent as usize] = libm::expf(log_probs[column]);
            picks.push(Pick { row, column: column as u32 });
        }
        (decision, picks)
    }

    /// The picks that lead to a given decision (`[N]` goals), in the order of the turns; `None` if it is not one-to-one.
    pub fn picks_of(&self, goals: &[u32]) -> Option<Vec<Pick>> {
        let mut agent_of = std::collections::BTreeMap::new();
        for (agent, goal) in goals.iter().enumerate() {
            agent_of.insert(*goal, agent as u32);
        }
        let mut free = vec![true; self.columns];
        let mut picks = Vec::with_capacity(self.turns.len());
        for &(row, who) in &self.turns {
            let target = if self.swapped { *agent_of.get(&who)? } else { *goals.get(who as usize)? };
            let column = self.column_of.iter().position(|&c| c == target)?;
            if !std::mem::replace(&mut free[column], false) {
                return None;
            }
            picks.push(Pick { row, column: column as u32 });
        }
        Some(picks)
    }
}

/// A constant tensor [rows, width].
fn constant(numbers: Vec<f32>, width: usize) -> candle_core::Result<Tensor> {
    let rows = numbers.len() / width;
    Tensor::from_vec(numbers, (rows, width), &Device::Cpu)
}

/// Entropic transport prices of a distance matrix [rows, columns].
fn duals(cost: &[f32], rows: usize, columns: usize) -> Result<(Vec<f32>, Vec<f32>), CommanderError> {
    let duals = sinkhorn_duals(cost, rows, columns, &Schedule::default())?;
    Ok((duals.rows, duals.cols))
}
