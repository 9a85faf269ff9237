//! The configuration as it is written: TOML in which nearly every key may be missing.

use super::{
    Algorithm, CollectConfig, CommanderConfig, CommanderPolicy, ConfigError, EPISODES_MAX, ExecutorConfig,
    ExecutorKind, MappoConfig, MaserConfig, QmixConfig, RunConfig, RunSection, Setting,
};
use crate::error::FieldError;
use crate::task::{self, NOT_ZERO, TaskName};
use crate::toml_table;
use serde::Deserialize;
use toml::{Table, Value};

/// Keys that had another name: the old one and the present one. The old one is refused, naming the present one.
pub(super) const RENAMED: &[(&str, &str)] = &[
    ("mappo.chunk", "mappo.chunk_length"),
    ("mappo.minibatch", "mappo.minibatch_size"),
    ("mappo.clip", "mappo.clip_epsilon"),
    ("mappo.entropy", "mappo.entropy_coef"),
    ("mappo.bootstrap", "mappo.bootstrap_at_horizon"),
    ("mappo.grad_shards", "mappo.gradient_slices"),
    ("mappo.episodes", "collect.episodes_per_iteration"),
    ("mappo.shards", "collect.shards_per_iteration"),
    ("commander.random_share", "commander.random_assignment_fraction"),
    ("task.push_ball.arc", "task.push_ball.turn_length"),
    ("task.push_ball.aligned", "task.push_ball.start_in_line_fraction"),
];

/// The sections of a file; those that are missing are empty.
#[derive(Deserialize, Default)]
#[serde(deny_unknown_fields, default)]
struct Sections {
    run: Table,
    task: Option<Table>,
    executor: Table,
    commander: Table,
    collect: Table,
    mappo: Table,
    qmix: Table,
    maser: Table,
}

/// `[collect]` as it is written.
#[derive(Deserialize)]
#[serde(deny_unknown_fields, default)]
struct RawCollect {
    episodes_per_iteration: Option<u32>,
    shards_per_iteration: u32,
}

impl Default for RawCollect {
    fn default() -> Self {
        Self { episodes_per_iteration: None, shards_per_iteration: 4 }
    }
}

fn collect_bounds(_key: &str) -> Option<String> {
    Some(format!("1 to {EPISODES_MAX}"))
}

/// The configuration of a file with some keys changed; missing values are defaults or derived from others. Ranges are not
/// checked.
pub(super) fn read(text: &str, settings: &[Setting]) -> Result<RunConfig, ConfigError> {
    let file: Table = toml::from_str(text).map_err(|error| not_toml(text, &error))?;
    let mut file = if file.contains_key("task") { file } else { on_the_first_run(file, settings)? };
    settings.iter().try_for_each(|setting| setting.apply(&mut file))?;
    refuse_renamed(&file)?;
    let sections: Sections = toml_table::read("", file, |_| None)?;
    let mut sections = sections;
    let external = sections.task.as_ref().and_then(|task| task.get("name")).and_then(Value::as_str);
    if external == Some(TaskName::External.to_string().as_str()) {
        // What fits an environment that has neither goals nor features of ours.
        sections.executor.entry("kind").or_insert(ExecutorKind::Flat.to_string().into());
        sections.commander.entry("kind").or_insert(CommanderPolicy::Exact.to_string().into());
    }
    let task = sections.task.map_or_else(|| Ok(RunConfig::default().task), task::read)?;
    let collect: RawCollect = toml_table::read("collect", sections.collect, collect_bounds)?;
    let mut config = RunConfig {
        run: toml_table::read("run", sections.run, RunSection::bounds)?,
        task,
        executor: toml_table::read("executor", sections.executor, ExecutorConfig::bounds)?,
        commander: toml_table::read("commander", sections.commander, CommanderConfig::bounds)?,
        collect: CollectConfig { episodes_per_iteration: 0, shards_per_iteration: collect.shards_per_iteration },
        mappo: toml_table::read("mappo", sections.mappo, MappoConfig::bounds)?,
        qmix: toml_table::read("qmix", sections.qmix, QmixConfig::bounds)?,
        maser: toml_table::read("maser", sections.maser, MaserConfig::bounds)?,
    };
    config.collect.episodes_per_iteration = match collect.episodes_per_iteration {
        Some(0) => return Err(FieldError::new("collect.episodes_per_iteration", NOT_ZERO).into()),
        Some(episodes) => episodes,
        None => config.derived_episodes(),
    };
    Ok(config)
}

/// A file without a task changes keys of the first run.
fn on_the_first_run(file: Table, settings: &[Setting]) -> Result<Table, ConfigError> {
    let text = RunConfig::default().to_toml()?;
    let mut base: Table = toml::from_str(&text).map_err(|error| ConfigError(error.to_string()))?;
    // Derived, also from what the file and the settings say.
    if let Some(Value::Table(collect)) = base.get_mut("collect") {
        collect.remove("episodes_per_iteration");
    }
    if let Some(Value::Table(task)) = base.get_mut("task") {
        task.retain(|key, _| ["name", "agents", "spawn"].contains(&key));
    }
    // The first run's settings of MAPPO are none of another algorithm's.
    let mut asked = file.clone();
    settings.iter().try_for_each(|setting| setting.apply(&mut asked))?;
    let algorithm = asked.get("run").and_then(|run| run.get("algorithm")).and_then(Value::as_str);
    if algorithm.is_some_and(|name| name != Algorithm::Mappo.name()) {
        base.remove("mappo");
    }
    for (name, section) in file {
        match (base.get_mut(&name), section) {
            (Some(Value::Table(base)), Value::Table(section)) => base.extend(section),
            (_, other) => drop(base.insert(name, other)),
        }
    }
    Ok(base)
}

/// Where a text is no TOML. The parser's words are kept where they speak of TOML.
fn not_toml(text: &str, error: &toml::de::Error) -> ConfigError {
    let problem = match error.message().trim() {
        message if ["too large", "too small", "overflow"].iter().any(|words| message.contains(words)) => {
            "this whole number is out of range; write one from -9223372036854775808 to 9223372036854775807"
        }
        message => message,
    };
    let place = error.span().map(|span| {
        let before = text.get(..span.start).unwrap_or(text);
        let line = before.matches('\n').count();
        format!("line {} (`{}`): ", line + 1, text.lines().nth(line).unwrap_or_default().trim())
    });
    ConfigError(format!("{}{problem}", place.unwrap_or_default()))
}

fn refuse_renamed(file: &Table) -> Result<(), FieldError> {
    let present = |key: &str| {
        let mut path = key.split('.');
        let first = path.next().and_then(|section| file.get(section));
        path.try_fold(first?, |value, key| value.as_table()?.get(key))
    };
    match RENAMED.iter().find(|(old, _)| present(old).is_some()) {
        Some((old, new)) => Err(FieldError::new(*old, format!("this key is now {new}; rename it"))),
        None => Ok(()),
    }
}
