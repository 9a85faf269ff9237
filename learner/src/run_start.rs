//! How a run starts when it does not start anew: what may change when it continues, and the weights of another run.

use crate::checkpoint::{self, CheckpointError};
use crate::run_folder::CONFIG_FILE;
use crate::train::algorithm::Algorithm;
use crate::train::commander_ppo::CommanderPpo;
use crate::train::learned::{Learned, Network};
use crate::trainer::TrainError;
use magex_core::config::{ConfigError, RunConfig};
use magex_core::sha256;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use toml::{Table, Value};

/// Keys of `[run]` that decide what is learned from the first iteration on. All others decide when a run ends, what it measures
/// and what it keeps.
const FIXED: [&str; 4] = ["algorithm", "seed", "initial_weights", "initial_optimiser"];
/// Keys that do not decide whether evaluations reached the target.
const WITHOUT_TARGET: [&str; 4] = ["max_steps", "final_episodes", "checkpoint_every", "keep_checkpoints"];

/// What differs between two configurations.
#[derive(Debug, Default, PartialEq)]
pub(crate) struct Changes {
    /// Dotted keys, with both values.
    keys: Vec<(String, String)>,
}

impl Changes {
    /// From one configuration to another, both as TOML: a value prints as it is written.
    pub(crate) fn between(own: &str, requested: &str) -> Result<Self, ConfigError> {
        let table =
            |text: &str| text.parse::<Table>().map(Value::Table).map_err(|error| ConfigError(error.to_string()));
        let mut keys = Vec::new();
        collect("", &table(own)?, &table(requested)?, &mut keys);
        Ok(Self { keys })
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.keys.is_empty()
    }

    /// Those that a run cannot continue with.
    pub(crate) fn forbidden(&self) -> Option<String> {
        let fixed = |key: &str| key.strip_prefix("run.").is_none_or(|key| FIXED.contains(&key));
        let texts: Vec<&str> = self.keys.iter().filter(|(key, _)| fixed(key)).map(|(_, text)| text.as_str()).collect();
        (!texts.is_empty()).then(|| texts.join(", "))
    }

    pub(crate) fn has(&self, key: &str) -> bool {
        self.keys.iter().any(|(changed, _)| changed == key)
    }

    /// Whether earlier evaluations say nothing about the target any more.
    pub(crate) fn target(&self) -> bool {
        self.keys.iter().any(|(key, _)| key.strip_prefix("run.").is_some_and(|key| !WITHOUT_TARGET.contains(&key)))
    }
}

impl std::fmt::Display for Changes {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.keys.iter().map(|(_, text)| text.as_str()).collect::<Vec<_>>().join(", "))
    }
}

/// `run.seed was 1 and is 2`
fn collect(path: &str, own: &Value, requested: &Value, keys: &mut Vec<(String, String)>) {
    match (own, requested) {
        (Value::Table(own), Value::Table(requested)) => {
            let names: BTreeSet<&String> = own.keys().chain(requested.keys()).collect();
            for name in names {
                let path = if path.is_empty() { name.clone() } else { format!("{path}.{name}") };
                match (own.get(name), requested.get(name)) {
                    (Some(own), Some(requested)) => collect(&path, own, requested, keys),
                    (Some(own), None) => keys.push((path.clone(), format!("{path} was {own} and is not set"))),
                    (None, now) => {
                        let now = now.map(Value::to_string).unwrap_or_default();
                        keys.push((path.clone(), format!("{path} was not set and is {now}")));
                    }
                }
            }
        }
        _ if own == requested => {}
        _ => keys.push((path.to_owned(), format!("{path} was {own} and is {requested}"))),
    }
}

/// The configuration that a run continues with, and how it differs from that of its checkpoints.
pub(crate) fn continued(folder: &Path, requested: &RunConfig) -> Result<(RunConfig, Changes), ConfigError> {
    let mut config = requested.clone();
    // Checkpoints of older builds do not hold their configuration.
    let own = checkpoint::configuration(folder).or_else(|| std::fs::read_to_string(folder.join(CONFIG_FILE)).ok());
    let Some(mut text) = own else { return Ok((config, Changes::default())) };
    if let Ok(own) = RunConfig::from_toml(&text) {
        if config.run.initial_weights.is_empty() {
            config.run.initial_weights.clone_from(&own.run.initial_weights);
            config.run.initial_optimiser = own.run.initial_optimiser;
        }
        // With keys that are newer than the checkpoint.
        text = own.to_toml()?;
    }
    let changes = Changes::between(&text, &config.to_toml()?)?;
    Ok((config, changes))
}

/// The run whose weights another one begins from: its newest checkpoint.
#[derive(Debug)]
pub struct Parent {
    folder: PathBuf,
    config: RunConfig,
    learned: Learned,
    sha256: String,
}

impl Parent {
    /// Reads the newest usable checkpoint of a run folder.
    ///
    /// # Errors
    /// It is no run folder, or has no usable checkpoint.
    pub fn read(folder: &Path) -> Result<Self, TrainError> {
        let path = folder.join(CONFIG_FILE);
        let unusable = |reason: String| TrainError::Parent(folder.to_owned(), reason);
        let text = std::fs::read_to_string(&path).map_err(|error| match error.kind() {
            std::io::ErrorKind::NotFound if folder.is_dir() => unusable(format!("there is no {CONFIG_FILE} in it")),
            _ => unusable(format!("{CONFIG_FILE}: {error}")),
        })?;
        checkpoint::check_format(folder)?;
        let config = RunConfig::from_toml(&text).map_err(|error| unusable(format!("{CONFIG_FILE}: {error}")))?;
        let commander = CommanderPpo::new(&config.commander, &config.task, config.run.seed);
        // Weights and optimisers: the new run fills a replay buffer of its own.
        let template = Learned { replay: None, ..Learned::init(&config, &Algorithm::new(&config)?, &commander)? };
        let (progress, learned, skipped) = checkpoint::read_latest(folder, &template).map_err(|error| match error {
            CheckpointError::None(_) => unusable("it has no checkpoint to begin from".to_owned()),
            other => other.into(),
        })?;
        for error in skipped {
            tracing::warn!(%error, iteration = progress.iteration, "a checkpoint cannot be used; beginning from an older one");
        }
        let sha256 = sha256::hex(&learned.weights()?);
        Ok(Self { folder: folder.to_owned(), config, learned, sha256 })
    }

    /// The configuration of the run, without the weights that it began from itself.
    pub fn config(&self) -> RunConfig {
        let mut config = self.config.clone();
        (config.run.initial_weights, config.run.initial_optimiser) = (String::new(), false);
        config
    }

    /// The configuration of a run that begins from this one's weights: it says which ones.
    ///
    /// # Errors
    /// It names other weights.
    pub fn recorded(&self, mut config: RunConfig, keep_optimiser: bool) -> Result<RunConfig, TrainError> {
        let run = &mut config.run;
        if !run.initial_weights.is_empty() && run.initial_weights != self.sha256 {
            let (wanted, own) = (&run.initial_weights, &self.sha256);
            let reason = format!(
                "run.initial_weights is {wanted}, its newest checkpoint has {own}; name another run, or remove the key"
            );
            return Err(TrainError::Parent(self.folder.clone(), reason));
        }
        run.initial_weights.clone_from(&self.sha256);
        run.initial_optimiser |= keep_optimiser;
        Ok(config)
    }

    /// Puts the weights, and if `config` says so the optimiser's state, in place of the fresh ones. A network that one of the
    /// two runs does not train stays fresh.
    pub(crate) fn begin(&self, config: &RunConfig, fresh: &mut Learned) -> Result<(), TrainError> {
        for network in &mut fresh.networks {
            let of = |parent: &&Network| parent.name == network.name && !parent.params.values.is_empty();
            let Some(parent) = self.learned.networks.iter().find(of).filter(|_| !network.params.values.is_empty())
            else {
                tracing::info!(
                    network = network.name,
                    "not trained in the run that this one begins from: it begins anew"
                );
                continue;
            };
            let layout = |network: &Network| {
                let shapes = network.params.entries.iter().map(|entry| (entry.name.clone(), entry.shape.clone()));
                shapes.collect::<Vec<_>>()
            };
            let (own, theirs) = (layout(network), layout(parent));
            if own != theirs {
                return Err(self.mismatch(config, &network.name, &own, &theirs)?);
            }
            network.params.values.clone_from(&parent.params.values);
            // Otherwise the optimiser is a fresh one.
            if config.run.initial_optimiser {
                network.moments = parent.moments.clone();
            }
        }
        if fresh.value_norm.enabled == self.learned.value_norm.enabled {
            fresh.value_norm = self.learned.value_norm;
        }
        Ok(())
    }

    fn mismatch(
        &self,
        config: &RunConfig,
        network: &str,
        own: &[(String, Vec<usize>)],
        theirs: &[(String, Vec<usize>)],
    ) -> Result<TrainError, TrainError> {
        let first =
            own.iter().find(|entry| !theirs.contains(entry)).or_else(|| theirs.iter().find(|e| !own.contains(e)));
        let (name, _) = first.cloned().unwrap_or_default();
        let shape = |list: &[(String, Vec<usize>)]| {
            list.iter()
                .find(|(other, _)| *other == name)
                .map_or("missing".to_owned(), |(_, shape)| format!("{shape:?}"))
        };
        let changes = Changes::between(&self.config.to_toml()?, &config.to_toml()?)?;
        let decides = |key: &str| {
            key.starts_with("executor.") || key.starts_with("commander.") || ["task.name", "task.agents"].contains(&key)
        };
        let keys: Vec<&str> =
            changes.keys.iter().filter(|(key, _)| decides(key)).map(|(_, text)| text.as_str()).collect();
        Ok(TrainError::Parent(
            self.folder.clone(),
            format!(
                "its networks do not fit: {network}.{name} is {} there and {} here; {}",
                shape(theirs),
                shape(own),
                keys.join(", ")
            ),
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changes_name_the_keys_and_both_values() {
        let own = RunConfig::default();
        let mut other = own.clone();
        (other.run.max_steps, other.run.target_success) = (5, 2.0);
        let between =
            |a: &RunConfig, b: &RunConfig| Changes::between(&a.to_toml().unwrap(), &b.to_toml().unwrap()).unwrap();
        let changes = between(&own, &other);
        assert_eq!(changes.forbidden(), None);
        assert!(changes.has("run.max_steps") && changes.target(), "{changes}");
        (other.run.seed, other.mappo.gamma) = (2, 0.5);
        let forbidden = between(&own, &other).forbidden().unwrap();
        assert_eq!(forbidden, "mappo.gamma was 0.9 and is 0.5, run.seed was 1 and is 2");
        other = own.clone();
        other.run.keep_checkpoints = 9;
        assert!(!between(&own, &other).target());
        assert!(between(&own, &own).is_empty());
    }
}
