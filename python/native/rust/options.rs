//! What a caller asks for, made into a task.

use crate::observe::{Observer, Seen};
use magex_core::config::RunConfig;
use magex_core::error::FieldError;
use magex_core::task::{RewardTarget, TaskConfig};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use toml::{Table, Value};

/// A task and what an agent sees of it.
pub(crate) struct Options {
    pub(crate) task: TaskConfig,
    pub(crate) observer: Observer,
}

/// The arguments by which a task is named.
pub(crate) struct Named<'a> {
    pub(crate) task: &'a str,
    pub(crate) agents: usize,
    pub(crate) spawn: &'a str,
    pub(crate) side: Option<f64>,
    pub(crate) horizon: Option<u32>,
    pub(crate) reward: &'a str,
    pub(crate) observation: &'a str,
    pub(crate) neighbours: usize,
    pub(crate) settings: Option<&'a Bound<'a, PyDict>>,
}

/// Neighbours that an agent can see.
const NEIGHBOURS_MAX: usize = 64;

impl Options {
    /// Reads the arguments as a configuration file would, so that defaults, ranges and messages are those of `[task]`.
    pub(crate) fn read(named: &Named<'_>) -> Result<Self, FieldError> {
        let mut task = Table::new();
        let name = named.task.replace('_', "-");
        if !["simple-spread", "push-ball", "drones"].contains(&name.as_str()) {
            let problem = format!("'{}' is not a task; use simple-spread, push-ball or drones", named.task);
            return Err(FieldError::new("task", problem));
        }
        let section = if name == "simple-spread" { "reward".to_owned() } else { name.replace('-', "_") };
        task.insert("name".to_owned(), Value::from(name));
        task.insert("agents".to_owned(), Value::from(i64::try_from(named.agents).unwrap_or(i64::MAX)));
        task.insert("spawn".to_owned(), Value::from(named.spawn));
        if !["goals", "team"].contains(&named.reward) {
            let problem = format!("'{}' is not a reward; use goals or team", named.reward);
            return Err(FieldError::new("reward", problem));
        }
        task.insert("reward_target".to_owned(), Value::from(named.reward));
        if let Some(side) = named.side {
            task.insert("side".to_owned(), Value::from(side));
        }
        if let Some(horizon) = named.horizon {
            task.insert("horizon".to_owned(), Value::from(i64::from(horizon)));
        }
        if let Some(settings) = named.settings {
            let mut table = Table::new();
            for (key, value) in settings {
                let key: String = key.extract().map_err(|_| FieldError::new("settings", "its keys must be strings"))?;
                let value = read_value(&key, &value)?;
                table.insert(key, value);
            }
            task.insert(section, Value::Table(table));
        }
        // Any horizon will do: nothing is trained here, so nothing is cut into chunks.
        let chunk = Table::from_iter([("chunk_length".to_owned(), Value::from(1))]);
        let keys =
            Table::from_iter([("task".to_owned(), Value::Table(task)), ("mappo".to_owned(), Value::Table(chunk))]);
        let task = RunConfig::from_keys(&keys).map_err(|error| renamed(&error.to_string()))?.task;
        if named.neighbours > NEIGHBOURS_MAX {
            let problem = format!("{} is out of range; use 0 to {NEIGHBOURS_MAX}", named.neighbours);
            return Err(FieldError::new("neighbours", problem));
        }
        let seen = match named.observation {
            "vector" => Seen::Vector { goals: task.reward_target == RewardTarget::Goals },
            "none" => Seen::Nothing,
            "goal" => Seen::Goal { neighbours: named.neighbours },
            other => {
                let problem = format!("'{other}' is not an observation; use vector, goal or none");
                return Err(FieldError::new("observation", problem));
            }
        };
        Ok(Self { observer: Observer::new(&task, seen), task })
    }

    /// Whether any number depends on the goals: if not, nothing is assigned.
    pub(crate) fn needs_goals(&self) -> bool {
        self.task.reward_target == RewardTarget::Goals || matches!(self.observer.seen, Seen::Goal { .. })
    }
}

/// The problem of a configuration, with the names of arguments for those of keys.
fn renamed(message: &str) -> FieldError {
    let message = message.strip_prefix("configuration: ").unwrap_or(message);
    let (field, problem) = message.split_once(": ").unwrap_or(("task", message));
    let field = field.strip_prefix("task.").unwrap_or(field);
    let (first, rest) = field.split_once('.').map_or((field, None), |(first, rest)| (first, Some(rest)));
    match (first, rest) {
        ("reward" | "push_ball" | "drones", Some(key)) => FieldError::new(format!("settings.{key}"), problem),
        ("reward" | "push_ball" | "drones", None) => FieldError::new("settings", problem),
        ("reward_target", _) => FieldError::new("reward", problem),
        _ => FieldError::new(field, problem),
    }
}

fn read_value(key: &str, value: &Bound<'_, PyAny>) -> Result<Value, FieldError> {
    if let Ok(text) = value.extract::<String>() {
        Ok(Value::from(text))
    } else if let Ok(whole) = value.extract::<i64>() {
        Ok(Value::from(whole))
    } else if let Ok(number) = value.extract::<f64>() {
        Ok(Value::from(number))
    } else {
        Err(FieldError::new(format!("settings.{key}"), "must be a number or a string"))
    }
}
