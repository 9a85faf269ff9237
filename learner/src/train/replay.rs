//! The replay buffer: the newest episodes of a run, whatever weights collected them.
//!
//! It keeps joint states, and no observations: an observation vector repeats what the others see, so that N of them are about N times
//! as long, and a batch's are computed in a small part of the time that its gradient takes. To keep actions alone and simulate again
//! would take a seventeenth of the room, but the learner links no environment.

use magex_core::config::RunConfig;
use magex_core::rng::Stream;
use magex_core::sha256;
use magex_core::statics::{StaticArray, StaticSpec, Statics};
use magex_core::trajectory::{Shape, Trajectory};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// The episodes of one iteration.
#[derive(Debug, Clone, PartialEq)]
pub struct Block {
    /// Which iteration.
    pub iteration: u32,
    /// SHA-256 of [`Self::encode`].
    pub sha256: String,
    /// Sizes; `episodes` is B.
    shape: Shape,
    /// [B, T+1, E, D]
    positions: Vec<f32>,
    /// [B, T+1, E, D]
    velocities: Vec<f32>,
    /// [B, T+1, N, X]
    agent_state: Vec<f32>,
    /// [B, T, N, H]
    actions: Vec<u8>,
    /// [B, T] mean over the agents.
    rewards: Vec<f32>,
    /// [B, N, K]
    goals: Vec<u32>,
    /// [B, ...]
    statics: Statics,
}

/// The blocks of the last iterations; the oldest one may be used in part.
#[derive(Debug, Clone, PartialEq)]
pub struct Replay {
    /// Episodes that are kept.
    capacity: usize,
    /// Episodes of a block.
    block_episodes: usize,
    /// Sizes of a block.
    shape: Shape,
    statics: Vec<StaticSpec>,
    blocks: VecDeque<Arc<Block>>,
}

/// Some episodes side by side, as the update reads them.
#[derive(Debug, Clone, Default)]
pub(crate) struct Episodes {
    /// [T+1, C, E, D]
    pub(crate) positions: Vec<f32>,
    /// [T+1, C, E, D]
    pub(crate) velocities: Vec<f32>,
    /// [T+1, C, N, X]
    pub(crate) agent_state: Vec<f32>,
    /// [T, C, N, H]
    pub(crate) actions: Vec<u8>,
    /// [T, C]
    pub(crate) rewards: Vec<f32>,
    /// [C, N, K]
    pub(crate) goals: Vec<u32>,
    /// [C, ...]
    pub(crate) statics: Statics,
}

impl Replay {
    /// An empty one for the episodes of a run.
    pub fn new(config: &RunConfig) -> Self {
        let block_episodes = config.collect.episodes_per_iteration as usize;
        let (shape, statics) = (config.task.shape(block_episodes), config.task.statics());
        Self { capacity: config.qmix.buffer_episodes, block_episodes, shape, statics, blocks: VecDeque::new() }
    }

    /// Bytes that an episode takes.
    pub fn episode_bytes(config: &RunConfig) -> u64 {
        let s = config.task.shape(1);
        let state = 2 * (s.steps + 1) * s.bodies * s.dims + (s.steps + 1) * s.agents * s.agent_state;
        let statics: usize = config.task.statics().iter().map(|spec| spec.shape.iter().product::<usize>()).sum();
        let numbers = state + s.steps + s.agents * s.goals_per_agent + statics;
        (4 * numbers + s.steps * s.agents * s.action_components) as u64
    }

    /// Bytes that a full buffer takes.
    pub fn bytes(config: &RunConfig) -> u64 {
        let block = u64::from(config.collect.episodes_per_iteration);
        Self::episode_bytes(config).saturating_mul((config.qmix.buffer_episodes as u64).next_multiple_of(block))
    }

    /// Episodes that can be drawn.
    pub fn len(&self) -> usize {
        (self.blocks.len() * self.block_episodes).min(self.capacity)
    }

    /// Whether there is none yet.
    pub fn is_empty(&self) -> bool {
        self.blocks.is_empty()
    }

    /// Blocks of a full buffer.
    pub fn block_count(&self) -> usize {
        self.capacity.div_ceil(self.block_episodes.max(1))
    }

    /// The blocks, oldest first.
    pub fn blocks(&self) -> impl Iterator<Item = &Arc<Block>> {
        self.blocks.iter()
    }

    /// Iterations and hashes of the blocks: with their files, all that there is to know.
    pub fn index(&self) -> BTreeMap<u32, String> {
        self.blocks.iter().map(|block| (block.iteration, block.sha256.clone())).collect()
    }

    /// Takes in an iteration's trajectories; the oldest episodes go.
    ///
    /// # Errors
    /// They cannot be encoded.
    pub fn push(&mut self, iteration: u32, trajectories: &[Trajectory]) -> Result<(), safetensors::SafeTensorError> {
        let mut block = Block::of(iteration, self.shape, trajectories);
        block.sha256 = sha256::hex(&block.encode()?);
        self.append(block);
        Ok(())
    }

    fn append(&mut self, block: Block) {
        self.blocks.push_back(Arc::new(block));
        while self.blocks.len() > self.block_count() {
            self.blocks.pop_front();
        }
    }

    /// Takes in a block as [`Block::encode`] wrote it, after the others.
    ///
    /// # Errors
    /// Another hash, or what is missing or has another shape.
    pub fn restore(&mut self, iteration: u32, sha256: &str, bytes: &[u8]) -> Result<(), String> {
        if sha256::hex(bytes) != sha256 {
            return Err("its checksum differs from state.json".to_owned());
        }
        let mut block = Block::decode(self.shape, &self.statics, bytes)?;
        (block.iteration, block.sha256) = (iteration, sha256.to_owned());
        self.append(block);
        Ok(())
    }

    /// `count` different episodes, at most all of them, each as likely as any other.
    pub(crate) fn draw(&self, stream: &mut Stream, count: usize) -> Vec<usize> {
        let length = self.len();
        let mut order: Vec<usize> = (0..length).collect();
        let count = count.min(length);
        for place in 0..count {
            let other = place + stream.below((length - place) as u32) as usize;
            order.swap(place, other);
        }
        order.truncate(count);
        order
    }

    /// Episodes side by side; number 0 is the oldest that can be drawn.
    pub(crate) fn gather(&self, numbers: &[usize]) -> Episodes {
        let older = self.blocks.len() * self.block_episodes - self.len();
        let place = |&number: &usize| {
            let number = number + older;
            (&*self.blocks[number / self.block_episodes], number % self.block_episodes)
        };
        let picked: Vec<(&Block, usize)> = numbers.iter().map(place).collect();
        let s = &self.shape;
        let (steps, states) = (s.steps, s.steps + 1);
        let statics = self.statics.iter().map(|spec| {
            let values = picked.iter().flat_map(|(block, b)| block.statics.episode(*b).get(spec.name)).copied();
            StaticArray { name: spec.name.to_owned(), shape: spec.shape.clone(), values: values.collect() }
        });
        Episodes {
            positions: interleave(&picked, |block| &block.positions, states, s.bodies * s.dims),
            velocities: interleave(&picked, |block| &block.velocities, states, s.bodies * s.dims),
            agent_state: interleave(&picked, |block| &block.agent_state, states, s.agents * s.agent_state),
            actions: interleave(&picked, |block| &block.actions, steps, s.agents * s.action_components),
            rewards: interleave(&picked, |block| &block.rewards, steps, 1),
            goals: interleave(&picked, |block| &block.goals, 1, s.agents * s.goals_per_agent),
            statics: Statics(statics.collect()),
        }
    }
}

/// [B, L, width] of each episode's block → [L, C, width].
fn interleave<T: Copy>(
    picked: &[(&Block, usize)],
    column: impl Fn(&Block) -> &[T],
    steps: usize,
    width: usize,
) -> Vec<T> {
    let mut out = Vec::with_capacity(steps * picked.len() * width);
    for step in 0..steps {
        for (block, episode) in picked {
            let at = (episode * steps + step) * width;
            out.extend_from_slice(&column(block)[at..at + width]);
        }
    }
    out
}

/// [L, B, width] of one shard → [B, L, width], appended.
fn by_episode<T: Copy>(out: &mut Vec<T>, data: &[T], steps: usize, episodes: usize, width: usize) {
    for episode in 0..episodes {
        for step in 0..steps {
            let at = (step * episodes + episode) * width;
            out.extend_from_slice(&data[at..at + width]);
        }
    }
}

impl Block {
    fn of(iteration: u32, shape: Shape, trajectories: &[Trajectory]) -> Self {
        let mut block = Self { iteration, ..Self::empty(shape) };
        for t in trajectories {
            let s = &t.shape;
            let (joint, rows, states) = (s.bodies * s.dims, s.agents, s.steps + 1);
            by_episode(&mut block.positions, &t.positions, states, s.episodes, joint);
            by_episode(&mut block.velocities, &t.velocities, states, s.episodes, joint);
            by_episode(&mut block.agent_state, &t.agent_state, states, s.episodes, rows * s.agent_state);
            by_episode(&mut block.actions, &t.actions, s.steps, s.episodes, rows * s.action_components);
            let mean = |agents: &[f32]| {
                (agents.iter().map(|&reward| f64::from(reward)).sum::<f64>() / agents.len().max(1) as f64) as f32
            };
            let rewards: Vec<f32> = t.rewards.chunks_exact(rows).map(mean).collect();
            by_episode(&mut block.rewards, &rewards, s.steps, s.episodes, 1);
            block.goals.extend_from_slice(&t.goals);
            if block.statics.0.is_empty() {
                block.statics = t.statics.clone();
            } else {
                let pairs = block.statics.0.iter_mut().zip(&t.statics.0);
                pairs.for_each(|(own, more)| own.values.extend_from_slice(&more.values));
            }
        }
        block
    }

    fn empty(shape: Shape) -> Self {
        Self {
            iteration: 0,
            sha256: String::new(),
            shape,
            positions: Vec::new(),
            velocities: Vec::new(),
            agent_state: Vec::new(),
            actions: Vec::new(),
            rewards: Vec::new(),
            goals: Vec::new(),
            statics: Statics::default(),
        }
    }

    /// The name of its file.
    pub fn file(iteration: u32, sha256: &str) -> String {
        format!("{iteration:06}-{}.safetensors", sha256.get(..16).unwrap_or(sha256))
    }

    /// A safetensors file: arrays by their names, those of the statics as `statics.<name>`.
    ///
    /// # Errors
    /// The library refuses.
    pub fn encode(&self) -> Result<Vec<u8>, safetensors::SafeTensorError> {
        let floats = |values: &[f32]| values.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
        let s = &self.shape;
        let (b, states) = (s.episodes, s.steps + 1);
        let joint = vec![b, states, s.bodies, s.dims];
        let mut arrays = vec![
            ("positions".to_owned(), Dtype::F32, joint.clone(), floats(&self.positions)),
            ("velocities".to_owned(), Dtype::F32, joint, floats(&self.velocities)),
            ("rewards".to_owned(), Dtype::F32, vec![b, s.steps], floats(&self.rewards)),
            ("actions".to_owned(), Dtype::U8, vec![b, s.steps, s.agents, s.action_components], self.actions.clone()),
            (
                "goals".to_owned(),
                Dtype::U32,
                vec![b, s.agents, s.goals_per_agent],
                self.goals.iter().flat_map(|x| x.to_le_bytes()).collect(),
            ),
        ];
        if s.agent_state > 0 {
            let shape = vec![b, states, s.agents, s.agent_state];
            arrays.push(("agent_state".to_owned(), Dtype::F32, shape, floats(&self.agent_state)));
        }
        for array in &self.statics.0 {
            let shape = [&[b], array.shape.as_slice()].concat();
            arrays.push((format!("statics.{}", array.name), Dtype::F32, shape, floats(&array.values)));
        }
        let mut views = Vec::with_capacity(arrays.len());
        for (name, dtype, shape, bytes) in &arrays {
            views.push((name, TensorView::new(*dtype, shape.clone(), bytes)?));
        }
        safetensors::serialize(views, None)
    }

    fn decode(shape: Shape, statics: &[StaticSpec], bytes: &[u8]) -> Result<Self, String> {
        let file = SafeTensors::deserialize(bytes).map_err(|error| error.to_string())?;
        let s = &shape;
        let (b, states) = (s.episodes, s.steps + 1);
        let array = |name: &str, dtype: Dtype, shape: &[usize]| -> Result<Vec<u8>, String> {
            let view = file.tensor(name).map_err(|_| format!("{name} is missing"))?;
            if view.dtype() != dtype || view.shape() != shape {
                return Err(format!("{name} is {:?} {:?}, expected {dtype:?} {shape:?}", view.dtype(), view.shape()));
            }
            Ok(view.data().to_vec())
        };
        let words = |bytes: Vec<u8>| -> Vec<u32> {
            bytes.chunks_exact(4).map(|c| u32::from_le_bytes([c[0], c[1], c[2], c[3]])).collect()
        };
        let floats = |name: &str, shape: &[usize]| -> Result<Vec<f32>, String> {
            Ok(words(array(name, Dtype::F32, shape)?).into_iter().map(f32::from_bits).collect())
        };
        let joint = [b, states, s.bodies, s.dims];
        let agent_state = [b, states, s.agents, s.agent_state];
        let static_array = |spec: &StaticSpec| {
            let values = floats(&format!("statics.{}", spec.name), &[&[b], spec.shape.as_slice()].concat())?;
            Ok(StaticArray { name: spec.name.to_owned(), shape: spec.shape.clone(), values })
        };
        Ok(Self {
            positions: floats("positions", &joint)?,
            velocities: floats("velocities", &joint)?,
            agent_state: if s.agent_state > 0 { floats("agent_state", &agent_state)? } else { Vec::new() },
            actions: array("actions", Dtype::U8, &[b, s.steps, s.agents, s.action_components])?,
            rewards: floats("rewards", &[b, s.steps])?,
            goals: words(array("goals", Dtype::U32, &[b, s.agents, s.goals_per_agent])?),
            statics: Statics(statics.iter().map(static_array).collect::<Result<_, String>>()?),
            ..Self::empty(shape)
        })
    }
}

#[cfg(test)]
mod tests;
