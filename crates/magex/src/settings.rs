//! The effective configuration of a run: defaults, then the file, then the settings of single keys, then the options of the
//! command.

use crate::external::Described;
use anyhow::Context as _;
use magex_core::config::{COLLISIONS_ANY, ConfigError, ExecutorKind, RunConfig, SEED_MAX, STEPS_MAX, Setting};
use magex_core::task::{AGENTS_MAX, Spawn};
use magex_runtime::options;
use serde::de::DeserializeOwned;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Options that change single keys of the configuration.
#[derive(Debug, Clone, Default, PartialEq, clap::Args)]
#[command(next_help_heading = "Configuration (overrides the file)")]
pub(crate) struct Overrides {
    /// Any key of the configuration, by its full name: mappo.gamma=0.9; repeat for more. The options below win over it.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub(crate) settings: Vec<Setting>,
    /// Seed of every random stream [run.seed].
    #[arg(long, value_name = "S", value_parser = options::whole::<u64>(0, SEED_MAX))]
    pub(crate) seed: Option<u64>,
    /// Budget in joint environment steps [run.max_steps].
    #[arg(long, value_name = "M", value_parser = options::whole::<u64>(1, STEPS_MAX))]
    pub(crate) max_steps: Option<u64>,
    /// Stop when two evaluations in a row reach this greedy success rate [run.target_success].
    #[arg(long, value_name = "X", value_parser = options::number::<f32>(0.0, 2.0))]
    pub(crate) target_success: Option<f32>,
    /// Stop only if sampled actions reach this success rate, too; 0 asks for none [run.target_sampled_success].
    #[arg(long, value_name = "X", value_parser = options::number::<f32>(0.0, 1.0))]
    pub(crate) target_sampled_success: Option<f32>,
    /// Stop only if there are at most this many collisions per agent and step, too; 1000 allows any [run.target_collisions].
    #[arg(long, value_name = "X", value_parser = options::number::<f32>(0.0, COLLISIONS_ANY))]
    pub(crate) target_collisions: Option<f32>,
    /// Spend the whole budget, whatever success the evaluations reach [run.target_success = 2].
    #[arg(long, conflicts_with = "target_success")]
    pub(crate) whole_budget: bool,
    /// Architecture: magex, magex-literal, attention, mlp or local [executor.kind].
    #[arg(long, value_name = "KIND", value_parser = named::<ExecutorKind>)]
    pub(crate) executor: Option<ExecutorKind>,
    /// Team size; side, horizon and layout follow it [task.agents].
    #[arg(long, value_name = "N", value_parser = options::whole::<usize>(1, AGENTS_MAX as u64))]
    pub(crate) agents: Option<usize>,
    /// Exponent of the distances that the exact and makespan schedulers sum; 2.1 lets the last agent arrive sooner
    /// [commander.power].
    #[arg(long, value_name = "P", value_parser = options::number::<f64>(1.0, 16.0))]
    pub(crate) power: Option<f64>,
    /// Starts: uniform, lines, lines-0..3, authors or authors-0..3 [task.spawn].
    #[arg(long, value_name = "MODE")]
    pub(crate) spawn: Option<Spawn>,
}

impl Overrides {
    /// The configuration of a file, or the default one, with the settings of single keys.
    pub(crate) fn read(&self, path: Option<&Path>, described: Option<&Described>) -> anyhow::Result<RunConfig> {
        let text = path.map_or_else(|| Ok(String::new()), |path| options::text_file("", path))?;
        let text = described.map_or_else(|| Ok(text.clone()), |described| described.fill(&text))?;
        let file = || path.map_or_else(String::new, |path| path.display().to_string());
        RunConfig::from_toml_with(&text, &self.settings).map_err(|error| {
            // The file is at fault itself if it is refused without them in the same words.
            let alone = RunConfig::from_toml(&text).err().is_some_and(|alone| alone.0 == error.0);
            anyhow::Error::new(error).context(if alone { file() } else { SET.to_owned() })
        })
    }

    /// The configuration of a run with the settings of single keys.
    pub(crate) fn set(&self, config: RunConfig) -> anyhow::Result<RunConfig> {
        config.with(&self.settings).context(SET)
    }

    /// The configuration with the options, checked.
    pub(crate) fn apply(&self, mut config: RunConfig) -> Result<RunConfig, ConfigError> {
        let run = &mut config.run;
        run.seed = self.seed.unwrap_or(run.seed);
        run.max_steps = self.max_steps.unwrap_or(run.max_steps);
        let target = self.whole_budget.then_some(2.0).or(self.target_success);
        run.target_success = target.unwrap_or(run.target_success);
        run.target_sampled_success = self.target_sampled_success.unwrap_or(run.target_sampled_success);
        run.target_collisions = self.target_collisions.unwrap_or(run.target_collisions);
        config.executor.kind = self.executor.unwrap_or(config.executor.kind);
        config.commander.power = self.power.unwrap_or(config.commander.power);
        if let Some(agents) = self.agents {
            config = config.resized(agents);
        }
        config.task.spawn = self.spawn.unwrap_or(config.task.spawn);
        config.validated()
    }
}

/// The option that sets single keys.
const SET: &str = "--set";

/// Reads a configuration file; without one, the defaults.
pub fn read(path: Option<&Path>) -> anyhow::Result<RunConfig> {
    path.map_or_else(|| Ok(RunConfig::default()), |path| read_from("", path))
}

/// Reads the configuration file that an option names.
pub(crate) fn read_from(option: &str, path: &Path) -> anyhow::Result<RunConfig> {
    let text = options::text_file(option, path)?;
    RunConfig::from_toml(&text).with_context(|| format!("{option} {}", path.display()).trim_start().to_owned())
}

/// A configuration as JSON, by its text: single-precision numbers print as they are written.
pub(crate) fn as_json(config: &RunConfig) -> anyhow::Result<Value> {
    Ok(serde_json::from_str(&serde_json::to_string(config)?)?)
}

/// Every key of a configuration with its value, as they are written.
pub(crate) fn flat(config: &RunConfig) -> anyhow::Result<BTreeMap<String, String>> {
    Ok(flat_value(&as_json(config)?))
}

/// [`flat`] of [`as_json`].
pub(crate) fn flat_value(config: &Value) -> BTreeMap<String, String> {
    fn leaves(path: &str, value: &Value, found: &mut BTreeMap<String, String>) {
        match value {
            Value::Object(section) => {
                let below = |key: &str| if path.is_empty() { key.to_owned() } else { format!("{path}.{key}") };
                section.iter().for_each(|(key, value)| leaves(&below(key), value, found));
            }
            Value::String(text) => drop(found.insert(path.to_owned(), text.clone())),
            other => drop(found.insert(path.to_owned(), other.to_string())),
        }
    }
    let mut found = BTreeMap::new();
    leaves("", config, &mut found);
    found
}

/// `run.seed is 1, not 2` for every key that differs.
pub(crate) fn changes(own: &BTreeMap<String, String>, asked: &BTreeMap<String, String>) -> Vec<String> {
    let value = |of: &BTreeMap<String, String>, key: &String| of.get(key).cloned().unwrap_or_else(|| "not set".into());
    let keys = differing([own, asked]).into_iter();
    keys.map(|key| format!("{key} is {}, not {}", value(own, &key), value(asked, &key))).collect()
}

/// The keys whose values are not the same everywhere.
pub(crate) fn differing<'a>(all: impl IntoIterator<Item = &'a BTreeMap<String, String>>) -> Vec<String> {
    let all: Vec<_> = all.into_iter().collect();
    let keys: BTreeSet<&String> = all.iter().flat_map(|one| one.keys()).collect();
    let same = |key: &&String| all.windows(2).all(|pair| pair[0].get(*key) == pair[1].get(*key));
    keys.into_iter().filter(|key| !same(key)).cloned().collect()
}

/// Parses a name of the configuration, such as an executor.
pub fn named<T: DeserializeOwned>(text: &str) -> Result<T, String> {
    serde_json::from_value(text.into()).map_err(|error| {
        let error = error.to_string();
        let known = error.rsplit_once("expected one of ").map_or("", |(_, known)| known).replace('`', "");
        format!("'{text}' is unknown; use one of {known}")
    })
}

pub(crate) fn threads(text: &str) -> Result<usize, String> {
    options::whole(1, options::THREADS_MAX)(text)
}

pub(crate) fn actors(text: &str) -> Result<usize, String> {
    options::whole(1, 256)(text)
}

/// Parses a count.
pub fn count(text: &str) -> Result<u32, String> {
    options::whole(1, 1_000_000)(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_win_over_the_file_and_nothing_else_changes() {
        let file = RunConfig::from_toml("[run]\nseed = 3\nmax_steps = 77").unwrap();
        assert_eq!(Overrides::default().apply(file.clone()).unwrap(), file);
        let options = Overrides { seed: Some(9), executor: Some(ExecutorKind::Local), ..Overrides::default() };
        let config = options.apply(file.clone()).unwrap();
        assert_eq!((config.run.seed, config.run.max_steps), (9, 77));
        assert_eq!(config.executor.kind, ExecutorKind::Local);
        assert_eq!(config.task, file.task);
    }

    #[test]
    fn a_power_is_for_schedulers_that_know_one() {
        let options = Overrides { power: Some(2.1), ..Overrides::default() };
        let refused = options.apply(RunConfig::default()).unwrap_err().to_string();
        assert!(refused.contains("commander.power"), "{refused}");
        let exact = RunConfig::from_toml("[commander]\nkind = \"exact\"").unwrap();
        assert_eq!(options.apply(exact).unwrap().commander.power, 2.1);
    }

    #[test]
    fn another_team_size_brings_its_own_map() {
        let resized = |agents| Overrides { agents: Some(agents), ..Overrides::default() }.apply(RunConfig::default());
        let task = resized(5).unwrap().task;
        assert_eq!((task.side, task.horizon, task.reward().unwrap().distance_unit), (2.0, 60, 2.0));
        assert_eq!(resized(50).unwrap(), RunConfig::default());
        assert!(resized(0).unwrap_err().to_string().contains("task.agents"));
    }

    #[test]
    fn names_are_those_of_the_configuration() {
        assert_eq!(named::<ExecutorKind>("magex-literal"), Ok(ExecutorKind::MagexLiteral));
        let error = named::<ExecutorKind>("fast").unwrap_err();
        assert!(error.contains("'fast'") && error.contains("local"), "{error}");
    }
}
