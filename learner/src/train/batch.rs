//! An iteration's trajectories as the update wants them: episode by episode, features computed once.

use candle_core::{Device, Result as CandleResult, Tensor};
use magex_core::joint_state::JointState;
use magex_core::keys::episode_keys;
use magex_core::rng::sequence;
use magex_core::trajectory::{Shape, Trajectory, mark};
use magex_nets::executor::Input;
use magex_nets::features::{FeatureSpec, Features};
use magex_nets::ops::{self, GraphNoise};
use rayon::prelude::*;
use std::sync::Arc;

/// E episodes of T steps of N agents. Rows of `features` and `marks` are ordered [E, T+1, N], everything else [E, T, N].
#[derive(Debug)]
pub struct Batch {
    /// Sizes; `episodes` is E.
    pub shape: Shape,
    /// Features of every state, one block of (T+1)·N rows per episode.
    pub features: Vec<Features>,
    /// [E, T, N, H]
    pub actions: Vec<u8>,
    /// [E, T, N]
    pub log_probs: Vec<f32>,
    /// [E, T, N]
    pub rewards: Vec<f32>,
    /// [E, T, N, C] real numbers of the actions.
    pub moves: Vec<f32>,
    /// [E, T+1, N] see [`mark`]; empty if every agent acts in every step and episodes end at the horizon only.
    pub marks: Vec<u8>,
    /// [E, T, N] 1 for an agent that acts in that state, otherwise 0; empty with `marks`.
    pub active: Vec<f32>,
    /// `[E]` bases of the keys of the graph's noise; step t of episode e uses `sequence(base, t)`.
    pub noise: Vec<u64>,
}

impl Batch {
    /// From trajectories sorted by shard index. All have the same shape but for the number of episodes.
    pub fn new(seed: u64, spec: &FeatureSpec, trajectories: &[Trajectory]) -> Self {
        let episodes: Vec<(&Trajectory, usize)> =
            trajectories.iter().flat_map(|t| (0..t.shape.episodes).map(move |b| (t, b))).collect();
        let common = trajectories.first().map(|t| t.shape).unwrap_or_default();
        let shape = Shape { episodes: episodes.len(), ..common };
        let features = episodes.par_iter().map(|(t, b)| episode_features(spec, t, *b)).collect();
        let rows = episodes.len() * shape.steps * shape.agents;
        let mut batch = Self {
            shape,
            features,
            actions: Vec::with_capacity(rows * shape.action_components),
            log_probs: Vec::with_capacity(rows),
            rewards: Vec::with_capacity(rows),
            moves: Vec::with_capacity(rows * shape.moves),
            marks: Vec::new(),
            active: Vec::new(),
            noise: Vec::with_capacity(episodes.len()),
        };
        let (n, h) = (shape.agents, shape.action_components);
        for (t, b) in &episodes {
            for step in 0..shape.steps {
                let at = (step * t.shape.episodes + b) * n;
                batch.actions.extend_from_slice(&t.actions[at * h..(at + n) * h]);
                batch.log_probs.extend_from_slice(&t.log_probs[at..at + n]);
                batch.rewards.extend_from_slice(&t.rewards[at..at + n]);
                batch.moves.extend_from_slice(&t.moves[at * shape.moves..(at + n) * shape.moves]);
            }
            if shape.marks > 0 {
                let states = (0..=shape.steps).map(|step| (step * t.shape.episodes + b) * n);
                states.for_each(|at| batch.marks.extend_from_slice(&t.marks[at..at + n]));
                let own = &batch.marks[batch.marks.len() - (shape.steps + 1) * n..];
                let acts = |mark: &u8| f32::from(u8::from(mark & mark::ACTIVE != 0));
                batch.active.extend(own[..shape.steps * n].iter().map(acts));
            }
            batch.noise.push(episode_keys(seed, &t.shard, *b as u32).graph.stream().bits64());
        }
        batch
    }

    /// Features of `steps` steps from `start` of several episodes, ordered [L, C, N].
    fn gather(&self, units: &[(usize, usize)], steps: usize) -> Features {
        let (n, rows) = (self.shape.agents, (self.shape.steps + 1) * self.shape.agents);
        let Some(first) = self.features.first() else { return Features::default() };
        let mut out = Features::with_room(first, rows, n, units.len() * steps * n);
        for l in 0..steps {
            for &(episode, start) in units {
                out.append(&self.features[episode], ((start + l) * n, n), rows, n);
            }
        }
        out
    }

    /// Noise keys of the same states, ordered [L, C].
    fn noise_keys(&self, units: &[(usize, usize)], steps: usize) -> Vec<u64> {
        (0..steps)
            .flat_map(|l| units.iter().map(move |&(episode, start)| sequence(self.noise[episode], (start + l) as u32)))
            .collect()
    }

    /// The marks [T+1, N] of an episode.
    pub(crate) fn marks_of(&self, episode: usize) -> &[u8] {
        let states = (self.shape.steps + 1) * self.shape.agents * self.shape.marks;
        &self.marks[episode * states..(episode + 1) * states]
    }

    /// The entries of a [E, T, N] array that are of agents that act.
    pub(crate) fn acting(&self, values: &[f32], units: &[(usize, usize)], steps: usize) -> Vec<f32> {
        let mut rows = self.rows(values, 1, units, steps);
        if !self.active.is_empty() {
            let mut active = self.rows(&self.active, 1, units, steps).into_iter();
            rows.retain(|_| active.next() == Some(1.0));
        }
        rows
    }

    /// How many they are.
    pub(crate) fn samples(&self, units: &[(usize, usize)], steps: usize) -> f32 {
        if self.active.is_empty() {
            return (units.len() * steps * self.shape.agents) as f32;
        }
        // A sum of ones: exact.
        self.rows(&self.active, 1, units, steps).into_iter().sum()
    }

    /// Rows of a [E, T, N, width] array for the same states, ordered [L, C, N, width].
    pub(crate) fn rows<T: Copy>(&self, data: &[T], width: usize, units: &[(usize, usize)], steps: usize) -> Vec<T> {
        let block = self.shape.agents * width;
        let mut out = Vec::with_capacity(units.len() * steps * block);
        for l in 0..steps {
            for &(episode, start) in units {
                let at = (episode * self.shape.steps + start + l) * block;
                out.extend_from_slice(&data[at..at + block]);
            }
        }
        out
    }
}

/// Some chunks of a batch, whose rows are ordered [L, C, N].
pub(crate) struct Slice<'a> {
    pub(crate) batch: &'a Batch,
    /// (episode, first step) of each chunk.
    pub(crate) units: &'a [(usize, usize)],
    /// L.
    pub(crate) chunk: usize,
    /// Agent samples of the whole minibatch.
    pub(crate) samples: f32,
}

impl Slice<'_> {
    pub(crate) fn features(&self) -> Arc<Features> {
        Arc::new(self.batch.gather(self.units, self.chunk))
    }

    pub(crate) fn input<'f>(&self, features: &'f Arc<Features>, hidden: Vec<f32>, noise: GraphNoise) -> Input<'f> {
        let (sequences, agents) = (self.units.len(), self.batch.shape.agents);
        Input { steps: self.chunk, sequences, agents, features, hidden, noise }
    }

    pub(crate) fn noise(&self) -> GraphNoise {
        GraphNoise::Keyed(Arc::new(self.batch.noise_keys(self.units, self.chunk)))
    }

    pub(crate) fn actions(&self) -> Vec<u8> {
        self.batch.rows(&self.batch.actions, self.batch.shape.action_components, self.units, self.chunk)
    }

    pub(crate) fn moves(&self) -> Vec<f32> {
        self.batch.rows(&self.batch.moves, self.batch.shape.moves, self.units, self.chunk)
    }

    /// 1 for rows of agents that act, otherwise 0; `None` if all do.
    pub(crate) fn active(&self) -> CandleResult<Option<Tensor>> {
        if self.batch.active.is_empty() {
            return Ok(None);
        }
        self.column(&self.batch.active).map(Some)
    }

    /// The episode of a row of the policy's outputs: one per agent, or one per team.
    pub(crate) fn episode_of(&self, row: usize, team: bool) -> usize {
        let chunk = if team { row } else { row / self.batch.shape.agents } % self.units.len();
        self.units[chunk].0
    }

    /// The rows of a [E, T, N] array.
    pub(crate) fn column(&self, values: &[f32]) -> CandleResult<Tensor> {
        column(self.batch.rows(values, 1, self.units, self.chunk))
    }

    /// [C·N·H] memories entering the chunks, out of the [T/L, N, H] of each episode.
    pub(crate) fn memories<'m>(&self, of: impl Fn(usize) -> &'m [f32]) -> Vec<f32> {
        let mut out = Vec::new();
        for &(episode, start) in self.units {
            let memory = of(episode);
            let width = memory.len() / (self.batch.shape.steps / self.chunk);
            let at = start / self.chunk * width;
            out.extend_from_slice(&memory[at..at + width]);
        }
        out
    }
}

/// The numbers of a tensor, row-major.
pub(crate) fn plain(tensor: &Tensor) -> CandleResult<Vec<f32>> {
    tensor.flatten_all()?.to_vec1()
}

/// Σ over the columns of each row: [R, A] → `[R]`.
pub(crate) fn sum_of_rows(x: &Tensor) -> CandleResult<Tensor> {
    // A product with ones: candle's sum has another order on another instruction set.
    let (ones, zero) = (ops::constant(vec![1.0; x.dim(1)?], 1)?, column(vec![0.0])?);
    ops::linear(x, &ones, &zero, ops::Activation::Identity, false)?.flatten_all()
}

/// A vector without a gradient.
pub(crate) fn column(values: Vec<f32>) -> CandleResult<Tensor> {
    let rows = values.len();
    Tensor::from_vec(values, rows, &Device::Cpu)
}

/// Features of all T+1 states of one episode of a trajectory.
fn episode_features(spec: &FeatureSpec, t: &Trajectory, b: usize) -> Features {
    let s = &t.shape;
    // The rows of one episode out of [T+1, B, width].
    fn rows<T: Copy>(data: &[T], (steps, episodes, b): (usize, usize, usize), width: usize) -> Vec<T> {
        let rows = (0..steps).flat_map(|step| {
            let at = (step * episodes + b) * width;
            &data[at..at + width]
        });
        rows.copied().collect()
    }
    let place = (s.steps + 1, s.episodes, b);
    let episode = |data: &[f32], width: usize| rows(data, place, width);
    let marks = rows(&t.marks, place, s.marks * s.agents);
    let mut masks = rows(&t.masks, (s.steps, s.episodes, b), s.agents * s.masks);
    // No agent acts in the last state.
    masks.resize((s.steps + 1) * s.agents * s.masks, 1);
    spec.compute(&JointState {
        positions: &episode(&t.positions, s.bodies * s.dims),
        velocities: &episode(&t.velocities, s.bodies * s.dims),
        agent_state: &episode(&t.agent_state, s.agents * s.agent_state),
        world_states: &episode(&t.world_states, s.world_state),
        masks: &masks,
        marks: &marks,
        statics: t.statics.episode(b),
        goals: &t.goals[b * s.agents * s.goals_per_agent..(b + 1) * s.agents * s.goals_per_agent],
    })
}
