//! Validation of results before the learner trains on them.

mod plausible;

use bytes::Bytes;
use magex_core::ids::RunId;
use magex_core::metrics_table::METRICS;
use magex_core::statics::StaticSpec;
use magex_core::task::TaskConfig;
use magex_core::trajectory::{EpisodeMetrics, EvalOutcome, Recording, Shape, ShardResult, Trajectory, mark};
use magex_proto::convert::{ConvertError, Delivery, decode_result};

/// The shapes of a run's results, and the limits of the service.
#[derive(Debug, Clone, PartialEq)]
pub struct Limits {
    /// The task, which says what its numbers can be.
    pub task: TaskConfig,
    /// Sizes of a result's arrays; `episodes` is the limit per shard.
    pub shape: Shape,
    /// Static arrays of an episode.
    pub statics: Vec<StaticSpec>,
    /// Choices of each action component.
    pub action_heads: Vec<usize>,
    /// Whether the task has each of [`METRICS`]; one that it does not have may be absent.
    pub metrics: [bool; METRICS.len()],
    /// Limit of connected actors.
    pub max_actors: usize,
    /// Limit of open streams of weights and events.
    pub max_watchers: usize,
    /// Share of the shards that are computed a second time.
    pub recompute: f64,
}

/// Room for the pictures of a recorded episode, bytes.
const PICTURES_BYTES: usize = 64 << 20;

/// Default of [`Limits::recompute`].
pub const RECOMPUTE: f64 = 0.01;

impl Limits {
    /// The limits of a task whose shards have at most `max_episodes` episodes.
    pub fn for_task(task: &TaskConfig, max_episodes: usize) -> Self {
        let action_heads = task.action_heads();
        let shape = task.shape(max_episodes);
        let metrics = std::array::from_fn(|row| METRICS[row].applies(task));
        let recompute = if task.pure() { RECOMPUTE } else { 0.0 };
        Self {
            task: task.clone(),
            shape,
            statics: task.statics(),
            action_heads,
            metrics,
            max_actors: 256,
            max_watchers: 1024,
            recompute,
        }
    }

    /// Longest encoded result, bytes: its arrays, and a generous envelope.
    pub fn max_result_bytes(&self) -> usize {
        let s = &self.shape;
        let (t, b, n) = (s.steps, s.episodes, s.agents);
        let state = (t + 1) * b * s.bodies * s.dims;
        let agent_state = (t + 1) * b * n * s.agent_state;
        let statics: usize = self.statics.iter().map(|spec| spec.shape.iter().product::<usize>()).sum();
        let external = t * b * n * s.moves + (t + 1) * b * s.world_state;
        let floats = 2 * state + agent_state + external + b * statics + 2 * t * b * n + 3 * b * s.goals_per_agent;
        let metrics = b * METRICS.len();
        let goals = b * n * s.goals_per_agent;
        let flags = t * b * n * (s.action_components + s.masks) + (t + 1) * b * n * s.marks;
        let pictures = if self.task.external().is_ok_and(|external| external.renders) { PICTURES_BYTES } else { 0 };
        4 * (floats + metrics + goals) + flags + pictures + 64 * 1024
    }
}

/// Decodes a result and checks everything that does not depend on the plan or the weights: identity of the run, shapes, that every
/// number is finite and one that the task can give, and that the numbers agree with each other.
///
/// # Errors
/// Names the field and the index within it.
pub fn validate(limits: &Limits, run_id: &RunId, bytes: Bytes) -> Result<Delivery, ConvertError> {
    let delivery = decode_result(bytes)?;
    if delivery.run_id != *run_id {
        let problem = format!("'{}' where '{run_id}' is expected", delivery.run_id);
        return Err(ConvertError::new("run_id", problem));
    }
    let shard = delivery.result.shard();
    if shard.episodes == 0 || shard.episodes as usize > limits.shape.episodes {
        let problem = format!("{} is outside 1..={}", shard.episodes, limits.shape.episodes);
        return Err(ConvertError::new("shard.episodes", problem));
    }
    match &delivery.result {
        ShardResult::Train(trajectory) => check_trajectory(limits, trajectory)?,
        ShardResult::Eval(outcome) => check_eval(limits, outcome)?,
    }
    Ok(delivery)
}

fn check_trajectory(limits: &Limits, trajectory: &Trajectory) -> Result<(), ConvertError> {
    check_shape("trajectory.shape", &trajectory.shape, limits, trajectory.shard.episodes as usize)?;
    trajectory.validate()?;
    trajectory.statics.validate(&limits.statics, trajectory.shape.episodes).map_err(|e| e.within("trajectory"))?;
    let heads = limits.action_heads.len().max(1);
    for (place, action) in trajectory.actions.iter().enumerate() {
        let choices = limits.action_heads.get(place % heads).copied().unwrap_or(0);
        if usize::from(*action) >= choices {
            let problem = format!("{action} is not below {choices}");
            return Err(ConvertError::new(format!("trajectory.actions[{place}]"), problem));
        }
    }
    check_masks(limits, trajectory)?;
    check_one_to_one(trajectory)?;
    check_metrics("trajectory.metrics", limits, &trajectory.metrics)?;
    plausible::check(limits, trajectory)
}

/// Checks that agents that act took choices that were allowed.
fn check_masks(limits: &Limits, trajectory: &Trajectory) -> Result<(), ConvertError> {
    let (width, heads) = (trajectory.shape.masks, limits.action_heads.len().max(1));
    if width == 0 {
        return Ok(());
    }
    let rows = trajectory.actions.chunks_exact(heads).zip(trajectory.masks.chunks_exact(width)).enumerate();
    for (row, (action, masks)) in rows.filter(|(row, _)| trajectory.marks[*row] & mark::ACTIVE != 0) {
        let mut from = 0;
        for (component, (&choice, &size)) in action.iter().zip(&limits.action_heads).enumerate() {
            if masks[from + usize::from(choice)] == 0 {
                let field = format!("trajectory.actions[{}]", row * heads + component);
                return Err(ConvertError::new(field, format!("{choice} was forbidden")));
            }
            from += size;
        }
    }
    Ok(())
}

/// Checks that in every stage no two agents have the same goal.
fn check_one_to_one(trajectory: &Trajectory) -> Result<(), ConvertError> {
    let shape = &trajectory.shape;
    let (n, k) = (shape.agents.max(1), shape.goals_per_agent.max(1));
    for (episode, goals) in trajectory.goals.chunks(n * k).enumerate() {
        let mut taken = vec![false; n * k];
        for (place, &goal) in goals.iter().enumerate() {
            let field = || format!("trajectory.goals[{episode}][{}][{}]", place / k, place % k);
            match taken.get_mut(goal as usize * k + place % k) {
                Some(taken) if !*taken => *taken = true,
                Some(_) => return Err(ConvertError::new(field(), format!("goal {goal} is assigned twice"))),
                None => return Err(ConvertError::new(field(), format!("{goal} is not below {n}"))),
            }
        }
    }
    Ok(())
}

fn check_eval(limits: &Limits, outcome: &EvalOutcome) -> Result<(), ConvertError> {
    check_metrics("eval.metrics", limits, &outcome.metrics)?;
    match (&outcome.recording, outcome.shard.record) {
        (Some(recording), true) => check_recording(limits, recording),
        (None, false) => Ok(()),
        (Some(_), false) => Err(ConvertError::new("eval.recording", "not requested")),
        (None, true) => Err(ConvertError::missing("eval.recording")),
    }
}

fn check_recording(limits: &Limits, recording: &Recording) -> Result<(), ConvertError> {
    check_shape("eval.recording.shape", &recording.shape, limits, 1)?;
    recording.statics.validate(&limits.statics, 1).map_err(|error| error.within("eval.recording"))?;
    for (name, values) in [("positions", &recording.positions), ("agent_state", &recording.agent_state)] {
        if let Some(place) = values.iter().position(|value| !value.is_finite()) {
            let problem = format!("{} is not finite", values[place]);
            return Err(ConvertError::new(format!("eval.recording.{name}[{place}]"), problem));
        }
    }
    let bound = limits.shape.landmarks.max(limits.shape.bodies);
    if let Some(place) = recording.goals.iter().position(|&goal| goal as usize >= bound) {
        let problem = format!("{} is not below {bound}", recording.goals[place]);
        return Err(ConvertError::new(format!("eval.recording.goals[{place}]"), problem));
    }
    Ok(())
}

fn check_shape(field: &str, shape: &Shape, limits: &Limits, episodes: usize) -> Result<(), ConvertError> {
    let expected = Shape { episodes, ..limits.shape };
    if *shape == expected {
        return Ok(());
    }
    Err(ConvertError::new(field, format!("{shape:?} where the task has {expected:?}")))
}

fn check_metrics(field: &str, limits: &Limits, episodes: &[EpisodeMetrics]) -> Result<(), ConvertError> {
    for (place, episode) in episodes.iter().enumerate() {
        for ((metric, &value), &has) in METRICS.iter().zip(&episode.0).zip(&limits.metrics) {
            let [low, high] = metric.range;
            let problem = if value.is_nan() && !has || (low..=high).contains(&value) {
                continue;
            } else if !value.is_finite() {
                format!("{value} is not finite")
            } else {
                format!("{value} is outside {low}..={high}")
            };
            return Err(ConvertError::new(format!("{field}[{place}].{}", metric.name), problem));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::{eval_outcome, task, train_shard, trajectory};
    use magex_core::metrics_table::{REWARD, SECOND_COST_RATIO, SUCCESS_RATE};
    use magex_proto::convert::encode_result;

    fn limits() -> Limits {
        Limits::for_task(&task(), 4)
    }

    fn verdict(result: ShardResult) -> Result<Delivery, String> {
        let run = RunId("r".into());
        validate(&limits(), &run, encode_result(&run, "sha", &result)).map_err(|error| error.to_string())
    }

    #[test]
    fn a_result_of_the_task_is_valid_and_fits_the_byte_limit() {
        let result = ShardResult::Train(trajectory(&task(), train_shard(0, 0, 4)));
        let run = RunId("r".into());
        assert!(encode_result(&run, "sha", &result).len() <= limits().max_result_bytes());
        assert_eq!(verdict(result.clone()).unwrap().result, result);
        let result = ShardResult::Eval(eval_outcome(&task(), train_shard(0, 0, 2), true));
        assert!(verdict(result).is_ok());
    }

    #[test]
    fn an_invalid_value_is_rejected_with_its_field() {
        let check = |damage: fn(&mut Trajectory), words: &str| {
            let mut bad = trajectory(&task(), train_shard(0, 0, 2));
            damage(&mut bad);
            let error = verdict(ShardResult::Train(bad)).unwrap_err();
            assert!(error.starts_with(words), "{error}");
        };
        check(|t| t.positions[5] = f32::NAN, "trajectory.positions[5]: NaN is not finite");
        check(|t| t.rewards[2] = f32::INFINITY, "trajectory.rewards[2]: inf");
        check(|t| t.log_probs[0] = 0.5, "trajectory.log_probs[0]: 0.5 is above 0");
        check(|t| t.actions[3] = 5, "trajectory.actions[3]: 5 is not below 5");
        check(|t| t.goals[0] = 99, "trajectory.goals[0]: 99 is not below");
        check(|t| t.metrics[1][REWARD] = f32::NAN, "trajectory.metrics[1].reward: NaN is not finite");
        check(|t| t.metrics[0][SUCCESS_RATE] = 1.5, "trajectory.metrics[0].success_rate: 1.5 is outside 0..=1");
        check(|t| t.metrics[0][SECOND_COST_RATIO] = f32::INFINITY, "trajectory.metrics[0].second_cost_ratio: inf");
        check(|t| t.shard.episodes = 5, "shard.episodes: 5 is outside 1..=4");
        check(|t| t.shard.episodes = 1, "trajectory.shape: ");
        let other =
            encode_result(&RunId("other".into()), "", &ShardResult::Train(trajectory(&task(), train_shard(0, 0, 1))));
        assert!(validate(&limits(), &RunId("r".into()), other).unwrap_err().to_string().contains("'other' where 'r'"));
    }

    #[test]
    fn a_recording_is_required_if_and_only_if_it_was_requested() {
        let mut shard = train_shard(0, 0, 2);
        let outcome = eval_outcome(&task(), shard, false);
        assert!(verdict(ShardResult::Eval(outcome)).is_ok());
        shard.record = true;
        let error =
            verdict(ShardResult::Eval(EvalOutcome { shard, ..eval_outcome(&task(), shard, false) })).unwrap_err();
        assert_eq!(error, "eval.recording: missing");
    }
}
