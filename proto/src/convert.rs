//! Domain types to messages and back. Going back checks everything and names the field that does not fit.

use crate::{arrays, v1};
use bytes::Bytes;
use magex_core::ids::{Iteration, Mode, RunId, Shard, ShardKind, WeightsVersion};
use magex_core::metrics_table::METRICS;
use magex_core::statics::{StaticArray, Statics};
use magex_core::trajectory::{EpisodeMetrics, EvalOutcome, Recording, Shape, ShardResult, Trajectory};
use prost::Message as _;

/// A message that does not describe what it claims to; the field is its path from the outermost message.
pub use magex_core::error::FieldError as ConvertError;

impl From<ShardKind> for v1::ShardKind {
    fn from(kind: ShardKind) -> Self {
        match kind {
            ShardKind::Train => Self::Train,
            ShardKind::Eval => Self::Eval,
        }
    }
}

impl From<Mode> for v1::Mode {
    fn from(mode: Mode) -> Self {
        match mode {
            Mode::Sampled => Self::Sampled,
            Mode::Greedy => Self::Greedy,
        }
    }
}

impl From<&Shard> for v1::Shard {
    fn from(shard: &Shard) -> Self {
        Self {
            kind: v1::ShardKind::from(shard.kind).into(),
            iteration: shard.iteration.0,
            index: shard.index,
            episodes: shard.episodes,
            first_episode: shard.first_episode,
            version: shard.version.0,
            mode: v1::Mode::from(shard.mode).into(),
            eval_set: shard.eval_set,
            record: shard.record,
        }
    }
}

impl TryFrom<&v1::Shard> for Shard {
    type Error = ConvertError;
    fn try_from(shard: &v1::Shard) -> Result<Self, ConvertError> {
        let kind = match shard.kind() {
            v1::ShardKind::Train => ShardKind::Train,
            v1::ShardKind::Eval => ShardKind::Eval,
            v1::ShardKind::Unspecified => return Err(ConvertError::new("kind", "not set or unknown")),
        };
        let mode = match shard.mode() {
            v1::Mode::Sampled => Mode::Sampled,
            v1::Mode::Greedy => Mode::Greedy,
            v1::Mode::Unspecified => return Err(ConvertError::new("mode", "not set or unknown")),
        };
        Ok(Self {
            kind,
            iteration: Iteration(shard.iteration),
            index: shard.index,
            episodes: shard.episodes,
            first_episode: shard.first_episode,
            version: WeightsVersion(shard.version),
            mode,
            eval_set: shard.eval_set,
            record: shard.record,
        })
    }
}

/// The shard of a message that must have one.
pub fn shard(field: &str, message: Option<&v1::Shard>) -> Result<Shard, ConvertError> {
    Shard::try_from(message.ok_or_else(|| ConvertError::missing(field))?).map_err(|error| error.within(field))
}

impl From<&Shape> for v1::Shape {
    fn from(shape: &Shape) -> Self {
        Self {
            steps: shape.steps as u32,
            episodes: shape.episodes as u32,
            agents: shape.agents as u32,
            bodies: shape.bodies as u32,
            landmarks: shape.landmarks as u32,
            dims: shape.dims as u32,
            goals_per_agent: shape.goals_per_agent as u32,
            action_components: shape.action_components as u32,
            agent_state: shape.agent_state as u32,
            world_state: shape.world_state as u32,
            moves: shape.moves as u32,
            masks: shape.masks as u32,
            marks: shape.marks as u32,
        }
    }
}

impl From<&v1::Shape> for Shape {
    fn from(shape: &v1::Shape) -> Self {
        Self {
            steps: shape.steps as usize,
            episodes: shape.episodes as usize,
            agents: shape.agents as usize,
            bodies: shape.bodies as usize,
            landmarks: shape.landmarks as usize,
            dims: shape.dims as usize,
            goals_per_agent: shape.goals_per_agent as usize,
            action_components: shape.action_components as usize,
            agent_state: shape.agent_state as usize,
            world_state: shape.world_state as usize,
            moves: shape.moves as usize,
            masks: shape.masks as usize,
            marks: shape.marks as usize,
        }
    }
}

fn from_metrics(episodes: &[EpisodeMetrics]) -> v1::Array {
    let values: Vec<f32> = episodes.iter().flat_map(|episode| episode.0).collect();
    arrays::from_f32(&[episodes.len(), METRICS.len()], &values)
}

fn to_metrics(message: Option<v1::Array>, episodes: usize) -> Result<Vec<EpisodeMetrics>, ConvertError> {
    let values = arrays::to_f32("metrics", message, &[episodes, METRICS.len()])?;
    Ok(values.as_chunks().0.iter().map(|episode| EpisodeMetrics(*episode)).collect())
}

/// The static arrays of B episodes, each [B, ...].
fn named_arrays(episodes: usize, statics: &Statics) -> Vec<v1::NamedArray> {
    let named = |array: &StaticArray| {
        let shape = [&[episodes], &*array.shape].concat();
        v1::NamedArray { name: array.name.clone(), array: Some(arrays::from_f32(&shape, &array.values)) }
    };
    statics.0.iter().map(named).collect()
}

/// The reverse of [`named_arrays`]. Which arrays there must be only the task knows.
fn statics(episodes: usize, message: Vec<v1::NamedArray>) -> Result<Statics, ConvertError> {
    let read = |(place, v1::NamedArray { name, array }): (usize, v1::NamedArray)| {
        let field = format!("statics[{place}]");
        let shape = arrays::shape_up_to(&field, array.as_ref(), MAX_STATIC_AXES)?;
        if shape.first() != Some(&episodes) {
            return Err(ConvertError::new(field, format!("shape {shape:?} where {episodes} episodes are expected")));
        }
        let values = arrays::to_f32(&field, array, &shape)?;
        Ok(StaticArray { name, shape: shape[1..].to_vec(), values })
    };
    message.into_iter().enumerate().map(read).collect::<Result<_, _>>().map(Statics)
}

/// Most axes of a static array on the wire, that of the episodes included.
const MAX_STATIC_AXES: usize = 4;

/// An array that only some tasks have.
fn floats_if(shape: &[usize], values: &[f32]) -> Option<v1::Array> {
    (shape.last() != Some(&0)).then(|| arrays::from_f32(shape, values))
}

/// The same for bytes.
fn bytes_if(shape: &[usize], values: &[u8]) -> Option<v1::Array> {
    (shape.last() != Some(&0)).then(|| arrays::from_u8(shape, values))
}

/// The reverse: the numbers of an array of this width, none if it is 0.
fn absent_or<T>(
    array: Option<v1::Array>,
    width: usize,
    read: impl FnOnce(Option<v1::Array>) -> Result<Vec<T>, ConvertError>,
) -> Result<Vec<T>, ConvertError> {
    if width == 0 && array.is_none() { Ok(Vec::new()) } else { read(array) }
}

impl From<&Trajectory> for v1::Trajectory {
    fn from(trajectory: &Trajectory) -> Self {
        let s = &trajectory.shape;
        let (t, b, n) = (s.steps, s.episodes, s.agents);
        let state = [t + 1, b, s.bodies, s.dims];
        Self {
            shape: Some(s.into()),
            positions: Some(arrays::from_f32(&state, &trajectory.positions)),
            velocities: Some(arrays::from_f32(&state, &trajectory.velocities)),
            agent_state: Some(arrays::from_f32(&[t + 1, b, n, s.agent_state], &trajectory.agent_state)),
            moves: floats_if(&[t, b, n, s.moves], &trajectory.moves),
            masks: bytes_if(&[t, b, n, s.masks], &trajectory.masks),
            marks: bytes_if(&[t + 1, b, n, s.marks], &trajectory.marks),
            world_states: floats_if(&[t + 1, b, s.world_state], &trajectory.world_states),
            statics: named_arrays(b, &trajectory.statics),
            goals: Some(arrays::from_u32(&[b, n, s.goals_per_agent], &trajectory.goals)),
            actions: Some(arrays::from_u8(&[t, b, n, s.action_components], &trajectory.actions)),
            log_probs: Some(arrays::from_f32(&[t, b, n], &trajectory.log_probs)),
            rewards: Some(arrays::from_f32(&[t, b, n], &trajectory.rewards)),
            goal_log_probs: Some(arrays::from_f32(&[b, s.goals_per_agent], &trajectory.goal_log_probs)),
            costs: Some(arrays::from_f32(&[b, s.goals_per_agent], &trajectory.costs)),
            exact_costs: Some(arrays::from_f32(&[b, s.goals_per_agent], &trajectory.exact_costs)),
            metrics: Some(from_metrics(&trajectory.metrics)),
        }
    }
}

fn trajectory(shard: Shard, message: v1::Trajectory) -> Result<Trajectory, ConvertError> {
    let shape = Shape::from(message.shape.as_ref().ok_or_else(|| ConvertError::missing("shape"))?);
    let s = &shape;
    let (t, b, n) = (s.steps, s.episodes, s.agents);
    let state = [t + 1, b, s.bodies, s.dims];
    Ok(Trajectory {
        shard,
        shape,
        positions: arrays::to_f32("positions", message.positions, &state)?,
        velocities: arrays::to_f32("velocities", message.velocities, &state)?,
        agent_state: arrays::to_f32("agent_state", message.agent_state, &[t + 1, b, n, s.agent_state])?,
        moves: absent_or(message.moves, s.moves, |array| arrays::to_f32("moves", array, &[t, b, n, s.moves]))?,
        masks: absent_or(message.masks, s.masks, |array| arrays::to_u8("masks", array, &[t, b, n, s.masks]))?,
        marks: absent_or(message.marks, s.marks, |array| arrays::to_u8("marks", array, &[t + 1, b, n, s.marks]))?,
        world_states: absent_or(message.world_states, s.world_state, |array| {
            arrays::to_f32("world_states", array, &[t + 1, b, s.world_state])
        })?,
        statics: statics(b, message.statics)?,
        goals: arrays::to_u32("goals", message.goals, &[b, n, s.goals_per_agent])?,
        actions: arrays::to_u8("actions", message.actions, &[t, b, n, s.action_components])?,
        log_probs: arrays::to_f32("log_probs", message.log_probs, &[t, b, n])?,
        rewards: arrays::to_f32("rewards", message.rewards, &[t, b, n])?,
        goal_log_probs: arrays::to_f32("goal_log_probs", message.goal_log_probs, &[b, s.goals_per_agent])?,
        costs: arrays::to_f32("costs", message.costs, &[b, s.goals_per_agent])?,
        exact_costs: arrays::to_f32("exact_costs", message.exact_costs, &[b, s.goals_per_agent])?,
        metrics: to_metrics(message.metrics, b)?,
    })
}

impl From<&Recording> for v1::Recording {
    fn from(recording: &Recording) -> Self {
        let s = &recording.shape;
        Self {
            shape: Some(s.into()),
            positions: Some(arrays::from_f32(&[s.steps + 1, s.bodies, s.dims], &recording.positions)),
            agent_state: Some(arrays::from_f32(&[s.steps + 1, s.agents, s.agent_state], &recording.agent_state)),
            statics: named_arrays(1, &recording.statics),
            goals: Some(arrays::from_u32(&[s.agents, s.goals_per_agent], &recording.goals)),
            pictures: recording.pictures.clone(),
        }
    }
}

impl TryFrom<v1::Recording> for Recording {
    type Error = ConvertError;
    fn try_from(message: v1::Recording) -> Result<Self, ConvertError> {
        let shape = Shape::from(message.shape.as_ref().ok_or_else(|| ConvertError::missing("shape"))?);
        let s = &shape;
        Ok(Self {
            shape,
            positions: arrays::to_f32("positions", message.positions, &[s.steps + 1, s.bodies, s.dims])?,
            agent_state: arrays::to_f32("agent_state", message.agent_state, &[s.steps + 1, s.agents, s.agent_state])?,
            statics: statics(1, message.statics)?,
            goals: arrays::to_u32("goals", message.goals, &[s.agents, s.goals_per_agent])?,
            pictures: message.pictures,
        })
    }
}

/// A result as it came in: what it is, and what it claims to be made with.
#[derive(Debug, Clone, PartialEq)]
pub struct Delivery {
    /// Run that it belongs to.
    pub run_id: RunId,
    /// SHA-256 (hex) of the weights that were used.
    pub weights_sha256: String,
    /// The result.
    pub result: ShardResult,
}

/// Encodes a result for the wire.
pub fn encode_result(run_id: &RunId, weights_sha256: &str, result: &ShardResult) -> Bytes {
    let body = match result {
        ShardResult::Train(trajectory) => v1::shard_result::Result::Trajectory(trajectory.into()),
        ShardResult::Eval(outcome) => v1::shard_result::Result::Eval(v1::EvalOutcome {
            metrics: Some(from_metrics(&outcome.metrics)),
            recording: outcome.recording.as_ref().map(Into::into),
        }),
    };
    let message = v1::ShardResult {
        run_id: run_id.0.clone(),
        shard: Some(result.shard().into()),
        weights_sha256: weights_sha256.to_owned(),
        result: Some(body),
    };
    message.encode_to_vec().into()
}

/// Decodes a result. Shapes agree with the arrays afterwards; the numbers themselves are not looked at.
pub fn decode_result(bytes: Bytes) -> Result<Delivery, ConvertError> {
    let message = v1::ShardResult::decode(bytes).map_err(|error| ConvertError::new("result", error.to_string()))?;
    let shard = shard("shard", message.shard.as_ref())?;
    let result = match message.result {
        Some(v1::shard_result::Result::Trajectory(body)) => {
            ShardResult::Train(trajectory(shard, body).map_err(|error| error.within("trajectory"))?)
        }
        Some(v1::shard_result::Result::Eval(body)) => ShardResult::Eval(EvalOutcome {
            shard,
            metrics: to_metrics(body.metrics, shard.episodes as usize).map_err(|error| error.within("eval"))?,
            recording: body.recording.map(Recording::try_from).transpose().map_err(|e| e.within("eval.recording"))?,
        }),
        None => return Err(ConvertError::missing("result")),
    };
    Ok(Delivery { run_id: RunId(message.run_id), weights_sha256: message.weights_sha256, result })
}

#[cfg(test)]
mod tests;
