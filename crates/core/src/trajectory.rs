//! What comes back from a shard: a trajectory to train on, or the metrics of evaluation episodes.

use crate::error::{FieldError, check_count, check_finite};
use crate::ids::Shard;
use crate::metrics_table::METRICS;
use crate::statics::Statics;
use serde::{Deserialize, Serialize};
use std::ops::{Index, IndexMut};

/// Sizes of a shard's arrays.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
pub struct Shape {
    /// T: joint steps per episode.
    pub steps: usize,
    /// B: episodes.
    pub episodes: usize,
    /// N: agents.
    pub agents: usize,
    /// E: moving bodies, agents first, then balls (Push Ball: E = 2N, otherwise N).
    pub bodies: usize,
    /// G: fixed landmarks.
    pub landmarks: usize,
    /// D: space dimensions.
    pub dims: usize,
    /// X: further numbers of an agent's state (drones: 6).
    pub agent_state: usize,
    /// K: goals per agent (Simple Spread: 1, its landmark; Push Ball: 2, its ball and the ball's landmark).
    pub goals_per_agent: usize,
    /// H: components of an action that are choices.
    pub action_components: usize,
    /// S: numbers of the state of a world that only the critic sees (external environments).
    pub world_state: usize,
    /// C: components of an action that are real numbers (external environments).
    pub moves: usize,
    /// A: choices of all components, where some may be forbidden (external environments); otherwise 0.
    pub masks: usize,
    /// 1 if the episodes of a row of worlds can end before the last step (external environments); otherwise 0.
    pub marks: usize,
}

/// What a mark says about an agent and a state: a set of bits.
pub mod mark {
    /// The agent acts in this state.
    pub const ACTIVE: u8 = 1;
    /// The state begins an episode of its world.
    pub const FIRST: u8 = 2;
    /// The agent's episode ended with this state, because of what happened.
    pub const TERMINATED: u8 = 4;
    /// The agent's episode was cut at this state.
    pub const TRUNCATED: u8 = 8;
}

/// B whole episodes of T joint steps as the actor saw them: states, not observations. All arrays are row-major.
/// Index t of a state is the state *before* action t; index T is the true last state, before any reset.
#[derive(Debug, Clone, PartialEq)]
pub struct Trajectory {
    /// Which shard this is the result of.
    pub shard: Shard,
    /// Sizes of the arrays below.
    pub shape: Shape,
    /// [T+1, B, E, D] world units.
    pub positions: Vec<f32>,
    /// [T+1, B, E, D] world units per second.
    pub velocities: Vec<f32>,
    /// [T+1, B, N, X] further state of the agents, by task.
    pub agent_state: Vec<f32>,
    /// [B, ...] the static arrays of the episodes, by name.
    pub statics: Statics,
    /// [B, N, K] what each agent was assigned: the k-th is an index into the group that the task's k-th stage leads to.
    pub goals: Vec<u32>,
    /// [T, B, N, H] in the agent's own frame, as the policy chose them.
    pub actions: Vec<u8>,
    /// [T, B, N] log-probability of the whole action under the weights named by the shard.
    pub log_probs: Vec<f32>,
    /// [T, B, N] reward of the state after action t.
    pub rewards: Vec<f32>,
    /// [T, B, N, C] real numbers of the actions as the policy drew them, before they are taken to the environment's range.
    pub moves: Vec<f32>,
    /// [T, B, N, A] 1 for a choice that was allowed; empty if all always are.
    pub masks: Vec<u8>,
    /// [T+1, B, N] see [`mark`]; empty if every agent acts in every step and episodes end at the horizon only. A world whose
    /// episode has ended begins another one in the next step, in which no agent acts: the state before it is the true last one.
    pub marks: Vec<u8>,
    /// [T+1, B, S] state of the worlds.
    pub world_states: Vec<f32>,
    /// [B, K] log-probability of the commander's assignment of each stage.
    pub goal_log_probs: Vec<f32>,
    /// [B, K] C_c: summed distance of the commander's assignment.
    pub costs: Vec<f32>,
    /// [B, K] C_h: summed distance of the exact assignment.
    pub exact_costs: Vec<f32>,
    /// `[B]` metrics of each episode.
    pub metrics: Vec<EpisodeMetrics>,
}

/// What one episode scored: a value for each row of [`METRICS`], NaN for a metric that the task does not have.
#[derive(Debug, Clone, Copy)]
pub struct EpisodeMetrics(pub [f32; METRICS.len()]);

impl EpisodeMetrics {
    /// The given rows; the others are absent.
    pub fn of<const K: usize>(values: [(usize, f32); K]) -> Self {
        let mut all = [f32::NAN; METRICS.len()];
        values.into_iter().for_each(|(metric, value)| all[metric] = value);
        Self(all)
    }

    /// The value of a row, if the task has it.
    pub fn get(&self, metric: usize) -> Option<f32> {
        Some(self.0[metric]).filter(|value| !value.is_nan())
    }
}

impl Index<usize> for EpisodeMetrics {
    type Output = f32;
    fn index(&self, metric: usize) -> &f32 {
        &self.0[metric]
    }
}

impl IndexMut<usize> for EpisodeMetrics {
    fn index_mut(&mut self, metric: usize) -> &mut f32 {
        &mut self.0[metric]
    }
}

/// Equal bits, so that an absent metric equals itself.
impl PartialEq for EpisodeMetrics {
    fn eq(&self, other: &Self) -> bool {
        self.0.map(f32::to_bits) == other.0.map(f32::to_bits)
    }
}

/// The states of one episode, to be looked at.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Recording {
    /// Sizes; `episodes` = 1.
    pub shape: Shape,
    /// [T+1, E, D]
    pub positions: Vec<f32>,
    /// [T+1, N, X]
    pub agent_state: Vec<f32>,
    /// [1, ...] the static arrays of the episode, by name.
    pub statics: Statics,
    /// [N, K]
    pub goals: Vec<u32>,
    /// PNG files in base64, in the order of time, of an environment that draws itself.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub pictures: Vec<String>,
}

/// Result of an evaluation shard.
#[derive(Debug, Clone, PartialEq)]
pub struct EvalOutcome {
    /// Which shard this is the result of.
    pub shard: Shard,
    /// One entry per episode.
    pub metrics: Vec<EpisodeMetrics>,
    /// The shard's first episode, if it was asked for.
    pub recording: Option<Recording>,
}

/// Result of a shard of either kind.
#[allow(clippy::large_enum_variant, reason = "most are of the large one, and there are few")]
#[derive(Debug, Clone, PartialEq)]
pub enum ShardResult {
    /// A trajectory to train on.
    Train(Trajectory),
    /// Metrics only.
    Eval(EvalOutcome),
}

impl ShardResult {
    /// The shard it belongs to.
    pub fn shard(&self) -> &Shard {
        match self {
            Self::Train(trajectory) => &trajectory.shard,
            Self::Eval(outcome) => &outcome.shard,
        }
    }
}

impl Trajectory {
    /// Checks every array against the shape, every number for finiteness and every index for its range. Which static arrays
    /// there must be only the task knows: see [`Statics::validate`]. An error names the field and the place.
    pub fn validate(&self) -> Result<(), FieldError> {
        self.check().map_err(|error| error.within("trajectory"))
    }

    fn check(&self) -> Result<(), FieldError> {
        let s = &self.shape;
        let (t, b, n) = (s.steps, s.episodes, s.agents);
        let state = (t + 1) * b * s.bodies * s.dims;
        let floats: [(&str, &[f32], usize); 10] = [
            ("positions", &self.positions, state),
            ("velocities", &self.velocities, state),
            ("agent_state", &self.agent_state, (t + 1) * b * n * s.agent_state),
            ("moves", &self.moves, t * b * n * s.moves),
            ("world_states", &self.world_states, (t + 1) * b * s.world_state),
            ("log_probs", &self.log_probs, t * b * n),
            ("rewards", &self.rewards, t * b * n),
            ("goal_log_probs", &self.goal_log_probs, b * s.goals_per_agent),
            ("costs", &self.costs, b * s.goals_per_agent),
            ("exact_costs", &self.exact_costs, b * s.goals_per_agent),
        ];
        for (name, data, expected) in floats {
            check_count(name, "numbers", data.len(), expected)?;
            check_finite(name, data)?;
        }
        self.statics.check_numbers(b)?;
        // A density may be above 1.
        let above = |x: &f32| s.moves == 0 && *x > 1e-4;
        if let Some(place) = self.log_probs.iter().position(above) {
            let problem = format!("{} is above 0", self.log_probs[place]);
            return Err(FieldError::new(format!("log_probs[{place}]"), problem));
        }
        check_count("goals", "entries", self.goals.len(), b * n * s.goals_per_agent)?;
        let bound = s.landmarks.max(s.bodies) as u32;
        if let Some(place) = self.goals.iter().position(|&g| g >= bound) {
            let problem = format!("{} is not below {bound}", self.goals[place]);
            return Err(FieldError::new(format!("goals[{place}]"), problem));
        }
        check_count("actions", "entries", self.actions.len(), t * b * n * s.action_components)?;
        self.check_marks()?;
        check_count("metrics", "entries", self.metrics.len(), b)
    }

    /// Masks and marks: sizes, values, and that they agree with each other.
    fn check_marks(&self) -> Result<(), FieldError> {
        let s = &self.shape;
        let states = s.episodes * s.agents;
        check_count("masks", "entries", self.masks.len(), s.steps * states * s.masks)?;
        check_count("marks", "entries", self.marks.len(), (s.steps + 1) * states * s.marks)?;
        if let Some(place) = self.masks.iter().position(|&mask| mask > 1) {
            return Err(FieldError::new(format!("masks[{place}]"), format!("{} is not 0 or 1", self.masks[place])));
        }
        for (place, &mark) in self.marks.iter().enumerate() {
            let ended = mark & (mark::TERMINATED | mark::TRUNCATED) != 0;
            let begins = place < states;
            let fits = mark < 16 && !(ended && mark & (mark::ACTIVE | mark::FIRST) != 0);
            if !fits || (begins && mark & mark::FIRST == 0) {
                return Err(FieldError::new(format!("marks[{place}]"), format!("{mark} cannot be")));
            }
        }
        Ok(())
    }
}
