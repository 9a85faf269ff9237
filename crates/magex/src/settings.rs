//! The effective configuration of a run: defaults, then the file, then the options of the command.

use anyhow::Context as _;
use magex_core::config::{COLLISIONS_ANY, ConfigError, ExecutorKind, RunConfig, SEED_MAX, STEPS_MAX};
use magex_core::task::{AGENTS_MAX, Spawn};
use magex_runtime::options;
use serde::de::DeserializeOwned;
use std::path::Path;

/// Options that change single keys of the configuration.
#[derive(Debug, Clone, Default, PartialEq, clap::Args)]
#[command(next_help_heading = "Configuration (overrides the file)")]
pub(crate) struct Overrides {
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
    /// Starts: uniform, lines, lines-0..3, authors or authors-0..3 [task.spawn].
    #[arg(long, value_name = "MODE")]
    pub(crate) spawn: Option<Spawn>,
}

impl Overrides {
    /// The configuration with these changes, checked.
    pub(crate) fn apply(&self, mut config: RunConfig) -> Result<RunConfig, ConfigError> {
        let run = &mut config.run;
        run.seed = self.seed.unwrap_or(run.seed);
        run.max_steps = self.max_steps.unwrap_or(run.max_steps);
        let target = self.whole_budget.then_some(2.0).or(self.target_success);
        run.target_success = target.unwrap_or(run.target_success);
        run.target_sampled_success = self.target_sampled_success.unwrap_or(run.target_sampled_success);
        run.target_collisions = self.target_collisions.unwrap_or(run.target_collisions);
        config.executor.kind = self.executor.unwrap_or(config.executor.kind);
        if let Some(agents) = self.agents {
            // Keys that were derived from the team size are derived again; keys that were set stay.
            let derived = config.collect.episodes_per_iteration == config.derived_episodes();
            config.task = config.task.resized(agents);
            if derived {
                config.collect.episodes_per_iteration = config.derived_episodes();
            }
        }
        config.task.spawn = self.spawn.unwrap_or(config.task.spawn);
        config.validated()
    }
}

/// Reads a configuration file; without one, the defaults.
pub fn read(path: Option<&Path>) -> anyhow::Result<RunConfig> {
    path.map_or_else(|| Ok(RunConfig::default()), |path| read_from("", path))
}

/// Reads the configuration file that an option names.
pub(crate) fn read_from(option: &str, path: &Path) -> anyhow::Result<RunConfig> {
    let text = options::text_file(option, path)?;
    RunConfig::from_toml(&text).with_context(|| format!("{option} {}", path.display()).trim_start().to_owned())
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
