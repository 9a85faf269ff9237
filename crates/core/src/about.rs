//! What a weights file says about itself, so that it can be used without the run that it comes from: docs/policy.md.

use crate::config::{ExecutorConfig, ExecutorKind, RunConfig};
use crate::task::{ActionCode, Frame, TaskConfig};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;

/// Format of weights files that this version writes. 1 said nothing but its number.
pub const WEIGHTS_FORMAT: u32 = 2;

/// The metadata of a weights file, JSON under the key `magex`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct About {
    /// [`WEIGHTS_FORMAT`].
    pub format: u32,
    /// `<task>-<N>-<executor or algorithm>-s<seed>`.
    pub run: String,
    /// `[run] algorithm`.
    pub algorithm: String,
    /// The task that it was trained on.
    pub task: TaskConfig,
    /// `[executor]`.
    pub executor: ExecutorConfig,
    /// Sizes of what it sees, lengths in world units.
    pub observation: ObservationSizes,
    /// What it decides.
    pub actions: Actions,
    /// H: numbers that an agent carries from step to step; those of the last action, one-hot, stand behind the memory's.
    pub memory: usize,
    /// Whether the last action is an input, and part of what is carried.
    pub last_action: bool,
    /// Units of its inputs.
    pub units: Units,
    /// How its tensors are stored.
    pub layout: String,
    /// SHA-256 of the tensors' bytes, in the order of the file; empty before the file is written.
    pub tensors: String,
}

/// Sizes of the features.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[expect(missing_docs, reason = "the names of crate::task::Observation, which explains them")]
pub struct ObservationSizes {
    pub dims: usize,
    pub agent_state: usize,
    pub balls: bool,
    pub speed: f32,
    pub fade_radius: f32,
    pub sensing_radius: f32,
    pub success_radius: f32,
    pub contact_radius: f32,
    /// `world` or `push`.
    pub frame: String,
    pub encounters: bool,
    pub out: Option<usize>,
}

/// What an action is.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Actions {
    /// `thrust` (0 none, 1 +x, 2 −x, 3 +y, 4 −y) or `per-axis` (0 forward, 1 stop, 2 backward, for each axis).
    pub code: String,
    /// Choices of each component.
    pub choices: Vec<usize>,
}

/// Units of positions and velocities.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Units {
    /// Of positions, goals and radii.
    pub length: String,
    /// Of velocities.
    pub speed: String,
    /// Seconds from one action to the next.
    pub step_seconds: f32,
}

/// `<task>-<N>-<executor>`, or the algorithm where that is not MAPPO.
pub fn group_name(config: &RunConfig) -> String {
    let system = match config.run.algorithm {
        crate::config::Algorithm::Mappo => config.executor.kind.to_string(),
        other => other.to_string(),
    };
    let task = match config.task.external() {
        // A name of a folder.
        Ok(external) => {
            let plain = |c: char| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '-' };
            external.environment.chars().map(plain).collect()
        }
        Err(_) => config.task.name.to_string(),
    };
    format!("{task}-{}-{system}", config.task.agents)
}

impl About {
    /// What the weights of a run say about themselves.
    pub fn of(config: &RunConfig) -> Self {
        let (task, o) = (&config.task, config.task.observation());
        let literal = config.executor.kind == ExecutorKind::MagexLiteral;
        let last_action = config.run.algorithm.off_policy() && config.qmix.last_action;
        let choices = task.action_heads();
        let metres = task.dims() == 3;
        Self {
            format: WEIGHTS_FORMAT,
            run: format!("{}-s{}", group_name(config), config.run.seed),
            algorithm: config.run.algorithm.to_string(),
            observation: ObservationSizes {
                dims: task.dims(),
                agent_state: task.agent_state(),
                balls: task.balls() > 0,
                speed: o.speed,
                fade_radius: o.fade_radius,
                sensing_radius: o.sensing_radius,
                success_radius: o.success_radius,
                contact_radius: o.contact_radius,
                // Only executors that see relative goals turn the world.
                frame: if o.frame == Frame::Push && !literal && !config.executor.kind.flat() {
                    "push"
                } else {
                    "world"
                }
                .to_owned(),
                encounters: o.encounters,
                out: o.out,
            },
            memory: config.executor.memory() + if last_action { choices.iter().sum() } else { 0 },
            last_action,
            actions: Actions {
                code: match task.action_code() {
                    ActionCode::Thrust => "thrust".to_owned(),
                    ActionCode::PerAxis => "per-axis".to_owned(),
                    ActionCode::Own => "own".to_owned(),
                },
                choices,
            },
            units: Units {
                length: if metres { "metres" } else { "world units" }.to_owned(),
                speed: if metres { "metres per second" } else { "world units per second" }.to_owned(),
                step_seconds: task.definition().step_seconds,
            },
            layout: "F32, [inputs, outputs], row-major".to_owned(),
            tensors: String::new(),
            task: task.clone(),
            executor: config.executor.clone(),
        }
    }

    /// The metadata as text.
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).unwrap_or_default()
    }
}

/// What is wrong with a weights file's metadata, given the configuration that it is loaded with: an error, or warnings.
///
/// # Errors
/// The format is not of this version, or the file belongs to another task, executor or team size. It names the keys and the
/// remedy.
pub fn check(found: Option<&str>, config: &RunConfig) -> Result<Vec<String>, String> {
    const OWN: &str = "use the configuration of its own run (config.toml in its folder)";
    let Some(text) = found else {
        return Ok(vec![
            "the weights file has no metadata (key 'magex'): it says neither task nor executor, only shapes are checked"
                .to_owned(),
        ]);
    };
    let value: Value = serde_json::from_str(text).map_err(|error| format!("the metadata is not JSON: {error}"))?;
    match value.get("format").and_then(Value::as_u64) {
        Some(1) => {
            return Ok(vec![
                "the weights file has format 1, of a version before 0.3: it says neither task nor executor, only shapes are checked"
                    .to_owned(),
            ]);
        }
        Some(format) if format == u64::from(WEIGHTS_FORMAT) => {}
        Some(format) => {
            return Err(format!(
                "format {format} is not known to this version, which reads 1 and {WEIGHTS_FORMAT}; use the version that wrote it"
            ));
        }
        None => return Err("the metadata has no format; it must be the number that magex wrote".to_owned()),
    }
    // Through text, as the file went: numbers of single precision are the same then.
    let wanted: Value = serde_json::from_str(&About::of(config).to_json()).unwrap_or_default();
    let (found, wanted) = (flat(&value), flat(&wanted));
    let absent = Value::Null;
    let (mut refused, mut warned) = (Vec::new(), Vec::new());
    for key in found.keys().chain(wanted.keys().filter(|key| !found.contains_key(*key))) {
        let (theirs, ours) = (found.get(key).unwrap_or(&absent), wanted.get(key).unwrap_or(&absent));
        if theirs == ours {
            continue;
        }
        let line = format!("{key} is {theirs} in the weights file and {ours} in the configuration");
        match key.split('.').next().unwrap_or_default() {
            // Names, words for people, and what is checked elsewhere.
            "run" | "units" | "layout" | "tensors" | "format" => {}
            "task" if key == "task.name" => refused.insert(0, line),
            "task" if key == "task.agents" && config.executor.kind.fixed_team_size() => refused.push(line),
            "task" if key == "task.agents" => {}
            // The map follows the team size.
            "task" if found.get("task.agents") != wanted.get("task.agents") => {}
            "task" => warned.push(format!("{line}: it acts in a world that it was not trained in")),
            "executor" if TRAINING_ONLY.contains(&key.as_str()) => {
                warned.push(format!("{line}, which matters to training only"));
            }
            _ => refused.push(line),
        }
    }
    if refused.is_empty() { Ok(warned) } else { Err(format!("{}; {OWN}", refused.join("; "))) }
}

/// The SHA-256 of the tensors that a weights file's metadata promises.
pub fn tensors(metadata: &str) -> Option<String> {
    let value: Value = serde_json::from_str(metadata).ok()?;
    value.get("tensors")?.as_str().map(str::to_owned)
}

/// Keys that decide nothing once the weights are there.
const TRAINING_ONLY: [&str; 3] = ["executor.temperature", "executor.centralised_critic", "executor.frozen_graph"];

/// Values by dotted key.
fn flat(value: &Value) -> BTreeMap<String, Value> {
    fn walk(key: &str, value: &Value, to: &mut BTreeMap<String, Value>) {
        match value {
            Value::Object(parts) => parts.iter().for_each(|(name, part)| {
                walk(&if key.is_empty() { name.clone() } else { format!("{key}.{name}") }, part, to);
            }),
            other => drop(to.insert(key.to_owned(), other.clone())),
        }
    }
    let mut to = BTreeMap::new();
    walk("", value, &mut to);
    to
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::task::{Spawn, TaskName};

    fn config() -> RunConfig {
        RunConfig::from_toml(
            "[task]\nname = 'simple-spread'\nagents = 5\nspawn = 'uniform'\n[executor]\nkind = 'local'",
        )
        .unwrap()
    }

    fn checked(change: fn(&mut RunConfig)) -> Result<Vec<String>, String> {
        let mut other = config();
        change(&mut other);
        check(Some(&About::of(&config()).to_json()), &other)
    }

    #[test]
    fn its_own_configuration_fits_and_another_is_named() {
        assert_eq!(checked(|_| ()), Ok(Vec::new()));
        assert_eq!(checked(|c| c.run.seed = 9), Ok(Vec::new()));
        assert_eq!(checked(|c| c.task = c.task.clone().resized(50)), Ok(Vec::new()));
        let error = checked(|c| c.executor.neighbours = 1).unwrap_err();
        assert!(
            error.starts_with("executor.neighbours is 6 in the weights file and 1 in the configuration; use"),
            "{error}"
        );
        let error = checked(|c| c.task = TaskConfig::of(TaskName::Drones, 5, Spawn::Uniform)).unwrap_err();
        assert!(error.starts_with("task.name is \"simple-spread\""), "{error}");
        let warned = checked(|c| c.task.side = 3.0).unwrap();
        assert!(warned.len() == 1 && warned[0].starts_with("task.side is 2.0"), "{warned:?}");
        assert_eq!(checked(|c| c.executor.temperature = 2.0).unwrap().len(), 1);
    }

    #[test]
    fn another_format_is_refused_and_an_older_one_warned_about() {
        assert!(check(Some(r#"{"format":9}"#), &config()).unwrap_err().starts_with("format 9 is not known"));
        assert!(check(Some("{}"), &config()).unwrap_err().contains("no format"));
        assert!(check(Some("x"), &config()).unwrap_err().contains("not JSON"));
        assert!(check(Some(r#"{"format":1}"#), &config()).unwrap()[0].contains("format 1"));
        assert!(check(None, &config()).unwrap()[0].contains("no metadata"));
    }
}
