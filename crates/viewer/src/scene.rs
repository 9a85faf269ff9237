//! A recorded episode as the live page and replay files draw it: sizes of the task and packed states.
//!
//! [`SCRIPT`] computes what it shows (covered landmarks, contacts, arrival) from these, and knows no task by name.

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use magex_core::error::{FieldError, check_count};
use magex_core::metrics_table::{METRICS, Metric};
use magex_core::statics::LANDMARKS;
use magex_core::task::{Group, TaskConfig};
use magex_core::trajectory::{EpisodeMetrics, Recording, Shape};
use serde::{Serialize, Serializer};

/// Defines `makeScene`, which draws an episode on a canvas.
pub const SCRIPT: &str = include_str!("scene.js");

/// States are stored as whole multiples of this; as a length in world units, a fifth of a pixel on a map of side 2.
pub const UNIT: f64 = 1e-3;

/// What the script needs to know besides the states. Lengths are in world units.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Scene {
    /// Side of the map, which is centred on the origin.
    pub side: f32,
    /// Plural name of the length unit.
    pub length_unit: &'static str,
    /// Display name of an agent.
    pub agent_name: &'static str,
    /// Display name of the state of an agent that has left the episode.
    pub out_name: &'static str,
    /// Radius of an agent.
    pub agent_radius: f32,
    /// Radius of the bodies that are not agents.
    pub ball_radius: f32,
    /// Radius a landmark is drawn with.
    pub landmark_radius: f32,
    /// Two agents closer than this are in contact.
    pub contact_distance: f32,
    /// A landmark is covered by a member of the last group but one of the chain within this distance.
    pub cover_radius: f32,
    /// Simulated seconds per step.
    pub step_seconds: f32,
    /// Height of the ground, if there is one.
    pub ground: Option<f32>,
    /// The groups from the agents to the landmarks, K + 1 of them: the k-th goal of an agent is a member of entry k + 1.
    #[serde(serialize_with = "group_names")]
    pub chain: Vec<Group>,
    /// Index in `agent_state` where an agent's target velocity begins.
    pub target_velocity: Option<usize>,
    /// Index in `agent_state` of x of an agent's upward axis; y follows.
    pub up: Option<usize>,
    /// Index in `agent_state` that is 1 once an agent has crashed; a crashed agent covers no landmark.
    pub out: Option<usize>,
    /// [`UNIT`].
    pub unit: f64,
    /// Whether the task has each of [`METRICS`].
    #[serde(skip)]
    pub metrics: [bool; METRICS.len()],
}

impl Scene {
    /// The sizes of a task (paper, section 5.1).
    pub fn of(task: &TaskConfig) -> Self {
        let (seen, stages) = (task.observation(), task.stages());
        let flies = task.dims() == 3;
        Self {
            side: task.side,
            length_unit: if flies { "metres" } else { "world units" },
            agent_name: if flies { "drone" } else { "agent" },
            out_name: "crashed",
            agent_radius: seen.contact_radius / 2.0,
            ball_radius: 0.15,
            landmark_radius: task.definition().landmark_radius,
            contact_distance: seen.contact_radius,
            cover_radius: seen.success_radius,
            step_seconds: task.definition().step_seconds,
            ground: flies.then_some(0.0),
            chain: stages.iter().take(1).map(|stage| stage.from).chain(stages.iter().map(|stage| stage.to)).collect(),
            target_velocity: flies.then_some(0),
            up: flies.then_some(3),
            out: seen.out,
            unit: UNIT,
            metrics: std::array::from_fn(|row| METRICS[row].applies(task)),
        }
    }

    /// Length of `agent_state` that the script reads.
    pub fn agent_state(&self) -> usize {
        let ends = [self.target_velocity.map(|x| x + 3), self.up.map(|x| x + 2), self.out.map(|x| x + 1)];
        ends.into_iter().flatten().max().unwrap_or(0)
    }

    /// An episode, ready for the script.
    ///
    /// # Errors
    /// Arrays that do not fit their shape or the task, or are not finite.
    pub fn pack<'a>(
        &self,
        name: String,
        recording: &'a Recording,
        metrics: Option<&EpisodeMetrics>,
    ) -> Result<PackedEpisode<'a>, FieldError> {
        let wide = self.check(recording)?;
        Ok(PackedEpisode {
            name,
            shape: recording.shape,
            wide,
            positions: pack(&recording.positions, wide),
            agent_state_values: pack(&recording.agent_state, wide),
            landmarks_at: pack(recording.statics.get(LANDMARKS), wide),
            goals: &recording.goals,
            facts: metrics.map(|metrics| self.facts(metrics)).unwrap_or_default(),
        })
    }

    /// Whether some number needs 32 bits.
    fn check(&self, recording: &Recording) -> Result<bool, FieldError> {
        let shape = &recording.shape;
        let wrong = |field: &str, problem: String| Err(FieldError::new(field, problem));
        if shape.agents == 0 || shape.dims == 0 || shape.goals_per_agent == 0 || shape.bodies < shape.agents {
            let problem = "agents, dims and goals_per_agent must be at least 1, and bodies at least agents";
            return wrong("shape", problem.to_owned());
        }
        let (goals, expected) = (shape.goals_per_agent, self.chain.len().saturating_sub(1));
        if goals != expected {
            return wrong("shape", format!("goals_per_agent is {goals}, the task assigns {expected} to an agent"));
        }
        let (found, least) = (shape.agent_state, self.agent_state());
        if found < least {
            return wrong("shape", format!("agent_state is {found}, the task has {least} or more"));
        }
        let floats = [
            ("positions", &*recording.positions, (shape.steps + 1) * shape.bodies * shape.dims),
            ("agent_state", &recording.agent_state, (shape.steps + 1) * shape.agents * shape.agent_state),
            ("landmarks", recording.statics.get(LANDMARKS), shape.landmarks * shape.dims),
        ];
        let mut wide = false;
        for (field, values, expected) in floats {
            check_count(field, "numbers", values.len(), expected)?;
            if let Some(place) = values.iter().position(|x| x.is_nan() || x.abs() > 2e6) {
                return wrong(field, format!("entry {place} is {}, which cannot be drawn", values[place]));
            }
            wide |= values.iter().any(|&x| quantised(x).abs() > i32::from(i16::MAX));
        }
        check_count("goals", "entries", recording.goals.len(), shape.agents * goals)?;
        for (place, &goal) in recording.goals.iter().enumerate() {
            let group = self.chain[place % goals + 1];
            let members = match group {
                Group::Agents => shape.agents,
                Group::Balls => shape.bodies - shape.agents,
                Group::Landmarks => shape.landmarks,
            };
            if goal as usize >= members {
                return wrong("goals", format!("entry {place} is {goal}, there are {members} {}", group_name(group)));
            }
        }
        Ok(wide)
    }

    /// The scores of an episode: heading and value of the metrics that a replay lists and the task has.
    pub fn facts(&self, metrics: &EpisodeMetrics) -> Vec<(&'static str, String)> {
        let listed = METRICS.iter().zip(&self.metrics).enumerate().filter(|(_, (metric, has))| metric.replay && **has);
        let value = |(row, (metric, _)): (usize, (&Metric, &bool))| {
            metrics.get(row).map(|value| (metric.label, metric.write(value.into())))
        };
        listed.filter_map(value).collect()
    }
}

/// One episode as the script reads it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PackedEpisode<'a> {
    name: String,
    #[serde(flatten)]
    shape: Shape,
    /// 32-bit instead of 16-bit numbers.
    wide: bool,
    /// `[T+1, E, D]`, base64 of little-endian whole multiples of the unit.
    positions: String,
    /// `[T+1, N, X]`, the same.
    agent_state_values: String,
    /// `[G, D]`, the same.
    landmarks_at: String,
    /// `[N, K]`
    goals: &'a [u32],
    facts: Vec<(&'static str, String)>,
}

/// Name of a group in the script.
fn group_name(group: Group) -> &'static str {
    match group {
        Group::Agents => "agents",
        Group::Balls => "balls",
        Group::Landmarks => "landmarks",
    }
}

fn group_names<S: Serializer>(chain: &[Group], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(chain.iter().map(|&group| group_name(group)))
}

fn quantised(value: f32) -> i32 {
    (f64::from(value) / UNIT).round() as i32
}

fn pack(values: &[f32], wide: bool) -> String {
    let bytes: Vec<u8> = if wide {
        values.iter().flat_map(|&x| quantised(x).to_le_bytes()).collect()
    } else {
        values.iter().flat_map(|&x| (quantised(x) as i16).to_le_bytes()).collect()
    };
    BASE64_STANDARD.encode(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use magex_core::metrics_table::SECOND_COST_RATIO;
    use magex_core::statics::Statics;
    use magex_core::task::Spawn;
    use magex_core::task::TaskName;

    #[test]
    fn states_are_whole_multiples_of_the_unit() {
        assert_eq!(quantised(-40.0), -40_000);
        assert_eq!(quantised(0.0015), 2);
        assert_eq!(pack(&[-1.5, 1.0], false), "JProAw==");
        assert_eq!(pack(&[-1.5], true), "JPr//w==");
    }

    #[test]
    fn each_task_brings_its_own_sizes() {
        let scene = |name| Scene::of(&TaskConfig::of(name, 5, Spawn::Uniform));
        let sizes = |name| {
            let s = scene(name);
            (s.agent_radius, s.landmark_radius, s.contact_distance, s.cover_radius, s.step_seconds)
        };
        assert_eq!(sizes(TaskName::SimpleSpread), (0.1, 0.05, 0.2, 0.15, 0.1));
        assert_eq!(sizes(TaskName::PushBall), (0.1, 0.15, 0.2, 0.3, 0.1));
        assert_eq!(sizes(TaskName::Drones), (0.06, 0.03, 0.12, 0.15, 1.0 / 30.0));
        for name in [TaskName::SimpleSpread, TaskName::PushBall, TaskName::Drones] {
            let (task, scene) = (TaskConfig::of(name, 5, Spawn::Uniform), scene(name));
            assert_eq!(scene.chain.len(), task.stages().len() + 1, "{name}");
            assert_eq!((scene.agent_state(), scene.side), (task.agent_state(), task.side), "{name}");
        }
    }

    /// The script has no compiler that would notice a renamed field.
    #[test]
    fn the_script_reads_only_fields_that_are_written() {
        let head = SCRIPT.lines().find_map(|line| line.trim().strip_prefix("const { ")?.strip_suffix(" } = source;"));
        let mut read: Vec<&str> = head.expect("the fields of an episode").split(", ").collect();
        let word = |text: &'static str| text.split(|c: char| !c.is_ascii_alphanumeric() && c != '_').next();
        read.extend(SCRIPT.split("source.").skip(1).filter_map(word));
        let task = TaskConfig::of(TaskName::SimpleSpread, 5, Spawn::Uniform);
        let recording = Recording {
            shape: Shape { steps: 0, ..task.shape(1) },
            positions: vec![0.0; 10],
            agent_state: Vec::new(),
            statics: Statics::landmarks(5, 2, vec![0.0; 10]),
            pictures: Vec::new(),
            goals: vec![0; 5],
        };
        let packed = Scene::of(&task).pack(String::new(), &recording, None).unwrap();
        let packed = serde_json::to_value(packed).unwrap();
        let scene = serde_json::to_value(Scene::of(&task)).unwrap();
        for field in read {
            assert!(packed.get(field).is_some(), "scene.js reads source.{field}, which no episode has");
        }
        for field in SCRIPT.split("data.").skip(1).filter_map(word) {
            assert!(scene.get(field).is_some(), "scene.js reads data.{field}, which no scene has");
        }
    }

    #[test]
    fn facts_that_a_task_does_not_have_are_left_out() {
        let mut metrics = EpisodeMetrics([0.25; METRICS.len()]);
        metrics[SECOND_COST_RATIO] = f32::NAN;
        let value = |name, metrics: &EpisodeMetrics, fact: &str| {
            let facts = Scene::of(&TaskConfig::of(name, 5, Spawn::Uniform)).facts(metrics);
            facts.into_iter().find(|(key, _)| *key == fact).map(|(_, value)| value)
        };
        assert_eq!(value(TaskName::SimpleSpread, &metrics, "at spawn").as_deref(), Some("0.2500"));
        assert_eq!(value(TaskName::SimpleSpread, &metrics, "crashed"), None);
        assert_eq!(value(TaskName::SimpleSpread, &metrics, "second cost"), None);
        assert_eq!(value(TaskName::Drones, &metrics, "crashed").as_deref(), Some("0.2500"));
        metrics[SECOND_COST_RATIO] = 1.25;
        assert_eq!(value(TaskName::PushBall, &metrics, "second cost").as_deref(), Some("1.2500"));
    }
}
