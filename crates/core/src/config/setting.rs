//! Single keys of a configuration, as `KEY=VALUE` on a command line.

use super::{ConfigError, RunConfig};
use crate::error::FieldError;
use toml::{Table, Value};

/// A key with its full dotted name, and a value.
#[derive(Debug, Clone, PartialEq)]
pub struct Setting {
    key: String,
    value: Value,
}

/// The key of the team size, which others follow.
const AGENTS: &str = "task.agents";

impl std::str::FromStr for Setting {
    type Err = String;

    /// The value is typed as in TOML; what is no TOML is a text, so that names need no quotes.
    fn from_str(text: &str) -> Result<Self, String> {
        let problem = |what: &str| format!("'{text}' has no {what}; write KEY=VALUE, such as mappo.gamma=0.9");
        let (key, value) = text.split_once('=').ok_or_else(|| problem("="))?;
        let (key, value) = (key.trim(), value.trim());
        if key.is_empty() || key.split('.').any(|part| part.trim() != part || part.is_empty()) {
            return Err(problem("key"));
        }
        if value.is_empty() {
            return Err(problem("value"));
        }
        let typed = toml::from_str::<Table>(&format!("value = {value}")).ok().filter(|table| table.len() == 1);
        let typed = typed.and_then(|mut table| table.remove("value"));
        Ok(Self { key: key.to_owned(), value: typed.unwrap_or_else(|| Value::String(value.to_owned())) })
    }
}

impl Setting {
    /// Changes the key in a file's table, and makes the sections above it.
    pub(super) fn apply(&self, file: &mut Table) -> Result<(), FieldError> {
        let mut parts = self.key.split('.');
        let last = parts.next_back().unwrap_or_default();
        let mut table = file;
        for part in parts {
            let section = table.entry(part).or_insert_with(|| Value::Table(Table::new()));
            let value = section.to_string();
            table = section.as_table_mut().ok_or_else(|| {
                FieldError::new(
                    self.key.clone(),
                    format!("{part} is {value}, not a section; there is nothing below it"),
                )
            })?;
        }
        table.insert(last.to_owned(), self.value.clone());
        Ok(())
    }
}

impl RunConfig {
    /// This configuration with some keys changed. Every key is set, so none follows another one, except that of the team size:
    /// see [`Self::resized`].
    ///
    /// # Errors
    /// Those of a file that has these keys.
    pub fn with(self, settings: &[Setting]) -> Result<Self, ConfigError> {
        if settings.is_empty() {
            return Ok(self);
        }
        let agents =
            settings.iter().rev().find(|setting| setting.key == AGENTS).and_then(|agents| agents.value.as_integer());
        let agents = agents.and_then(|agents| usize::try_from(agents).ok()).filter(|&agents| agents > 0);
        let base = match agents {
            Some(agents) => self.resized(agents),
            None => self,
        };
        Self::from_toml_with(&base.to_toml()?, settings)
    }

    /// For another team size: keys that were derived from the old one are derived again, keys that were set stay.
    #[must_use]
    pub fn resized(mut self, agents: usize) -> Self {
        let derived = self.collect.episodes_per_iteration == self.derived_episodes();
        self.task = self.task.resized(agents);
        if derived {
            self.collect.episodes_per_iteration = self.derived_episodes();
        }
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings(texts: &[&str]) -> Vec<Setting> {
        texts.iter().map(|text| text.parse().unwrap()).collect()
    }

    fn refused(texts: &[&str]) -> String {
        RunConfig::from_toml_with("", &settings(texts)).unwrap_err().to_string()
    }

    #[test]
    fn values_are_typed_as_in_toml_and_names_need_no_quotes() {
        let config = settings(&[
            "run.seed=7",
            "run.max_steps = 1e6",
            "mappo.gamma=0.9",
            "mappo.value_norm=false",
            "executor.kind=local",
            "task.spawn='lines-2'",
            "mappo.gamma=0.5",
        ]);
        let config = RunConfig::from_toml_with("[mappo]\ngamma = 0.7\nepochs = 2", &config).unwrap();
        assert_eq!((config.run.seed, config.run.max_steps, config.mappo.epochs), (7, 1_000_000, 2));
        assert_eq!((config.mappo.gamma, config.mappo.value_norm), (0.5, false));
        assert_eq!(
            (config.executor.kind.to_string(), config.task.spawn.to_string()),
            ("local".into(), "lines-2".into())
        );
    }

    #[test]
    fn what_follows_the_team_size_follows_a_setting_of_it() {
        let agents = settings(&["task.agents=5"]);
        let resized = RunConfig::default().resized(5);
        assert_eq!(RunConfig::from_toml_with("", &agents).unwrap(), resized);
        assert_eq!(RunConfig::default().with(&agents).unwrap(), resized);
        assert_eq!((resized.task.side, resized.collect.episodes_per_iteration), (2.0, 40));
        let other = RunConfig::from_toml_with("", &settings(&["task.name=push-ball", "task.agents=5"])).unwrap();
        assert_eq!((other.task.name.to_string().as_str(), other.task.side), ("push-ball", 4.0));
    }

    #[test]
    fn a_wrong_setting_is_refused_as_a_file_would_be() {
        for (texts, words) in [
            (["mappo.gama=0.9"], ["mappo.gama", "unknown key"]),
            (["mappo.gamma=high"], ["mappo.gamma", "write a number"]),
            (["mappo.gamma=2"], ["mappo.gamma", "0 to 1"]),
            (["mappo.clip=0.1"], ["mappo.clip", "mappo.clip_epsilon"]),
            (["run.seed.x=1"], ["run.seed.x", "not a section"]),
            (["run=5"], ["run", "not a section"]),
            (["learning.rate=5"], ["learning", "unknown key"]),
            (["task.spawn=ring"], ["task.spawn", "'ring'"]),
        ] {
            let error = refused(&texts);
            assert!(words.iter().all(|word| error.contains(word)), "{texts:?}: {error}");
        }
        for (text, word) in
            [("", "no ="), ("seed", "no ="), ("=5", "no key"), ("run..seed=5", "no key"), ("run.seed=", "no value")]
        {
            let error = text.parse::<Setting>().unwrap_err();
            assert!(error.contains(word) && error.contains("KEY=VALUE"), "{text}: {error}");
        }
    }
}
