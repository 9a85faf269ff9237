//! Run folders: names, content, creation and loading.
//!
//! | file | what it is |
//! |---|---|
//! | `config.toml` | the effective configuration, every key |
//! | `metrics.jsonl` | one line per iteration |
//! | `checkpoints/` | the latest checkpoints, weights as safetensors |
//! | `replay/` | episodes of the replay buffer, for algorithms that have one |
//! | `weights.safetensors`, `summary.json`, `recordings.json` | the result of a finished run |
//! | `curve.svg`, `replay.html` | pictures |
//! | `tensorboard/` | the numbers of metrics.jsonl for TensorBoard |
//! | `logs/` | standard error of the services |
//! | `.lock` | locked by the process that writes to the folder |

use crate::external::Described;
use crate::failure::{cannot_create, usage};
use crate::settings::Overrides;
use anyhow::Context as _;
use magex_core::config::RunConfig;
use magex_core::sha256;
use magex_learner::checkpoint::{self, CheckpointError};
use magex_learner::run_folder::{Claim, FolderError};
use magex_learner::run_lock::LockError;
use magex_learner::train::algorithm::Algorithm;
use magex_learner::train::commander_ppo::CommanderPpo;
use magex_learner::train::learned::Learned;
use magex_nets::weights_file;
use std::path::{Path, PathBuf};

/// The effective configuration.
pub const CONFIG: &str = "config.toml";
pub(crate) const SUMMARY: &str = "summary.json";
/// The trained networks.
pub const WEIGHTS: &str = "weights.safetensors";

/// `<task>-<N>-<executor>-s<seed>`
pub(crate) fn default_name(config: &RunConfig) -> String {
    format!("{}-s{}", group_name(config), config.run.seed)
}

pub(crate) use magex_core::about::group_name;

/// The folder of all runs, unless an option says otherwise.
pub(crate) const RUNS: &str = "runs";

/// Parses the name of a run folder within [`RUNS`].
pub(crate) fn name(text: &str) -> Result<String, String> {
    let plain = Path::new(text).file_name().is_some_and(|name| name == text);
    if plain { Ok(text.to_owned()) } else { Err(format!("'{text}' is no name of a folder; --out takes a path")) }
}

/// The run in [`RUNS`] that was written to last.
pub(crate) fn newest() -> Option<PathBuf> {
    let folders = std::fs::read_dir(RUNS).ok()?.filter_map(|entry| Some(entry.ok()?.path()));
    let runs = folders.filter(|folder| folder.join(CONFIG).is_file());
    runs.max_by_key(|folder| std::fs::metadata(folder.join("metrics.jsonl")).and_then(|file| file.modified()).ok())
}

/// Creates and locks the folder of a new run with its configuration: `out`, or `runs/<name>` with -2, -3, … if it is taken. With
/// `again`, a run in `out` that ended before its first checkpoint begins again.
pub(crate) fn begin(
    out: Option<&Path>,
    name: &str,
    toml: &str,
    command: &str,
    again: bool,
) -> Result<(PathBuf, Claim), FolderError> {
    if let Some(out) = out {
        return Ok((out.to_owned(), Claim::begin(out, toml, command, again)?));
    }
    let mut number = 1u32;
    loop {
        let suffix = if number == 1 { String::new() } else { format!("-{number}") };
        let folder = Path::new(RUNS).join(format!("{name}{suffix}"));
        number += 1;
        // One that exists is not touched, even if it is empty: another process may be about to begin in it.
        if folder.symlink_metadata().is_ok() {
            continue;
        }
        match Claim::begin(&folder, toml, command, false) {
            Err(FolderError::Exists(..) | FolderError::Lock(LockError::Held { .. })) => {}
            claimed => return Ok((folder, claimed?)),
        }
    }
}

pub(crate) fn refused(error: FolderError) -> anyhow::Error {
    cannot_create(format!("--out {error}"))
}

/// The configuration of an existing run.
pub fn config_of(folder: &Path) -> anyhow::Result<RunConfig> {
    let path = folder.join(CONFIG);
    let text = std::fs::read_to_string(&path).map_err(|error| match error.kind() {
        std::io::ErrorKind::NotFound => {
            let seeds = seeds_in(folder);
            let hint = seeds.first().map(|first| format!("; it holds one run per seed, such as {}", first.display()));
            let hint = hint.unwrap_or_default();
            usage(format!("{} is not a run folder: there is no {CONFIG} in it{hint}", folder.display()))
        }
        _ => usage(format!("{}: {error}", path.display())),
    })?;
    checkpoint::check_format(folder).map_err(usage)?;
    RunConfig::from_toml(&text).with_context(|| path.display().to_string())
}

/// The folder of a seed's run within that of several seeds.
pub(crate) fn of_seed(folder: &Path, seed: u64) -> PathBuf {
    folder.join(format!("seed-{seed}"))
}

/// The run folders of several seeds in a folder, by seed.
pub(crate) fn seeds_in(folder: &Path) -> Vec<PathBuf> {
    let names =
        std::fs::read_dir(folder).into_iter().flatten().filter_map(|entry| entry.ok()?.file_name().into_string().ok());
    let mut seeds: Vec<u64> = names.filter_map(|name| name.strip_prefix("seed-")?.parse().ok()).collect();
    seeds.sort_unstable();
    seeds.into_iter().map(|seed| of_seed(folder, seed)).filter(|run| run.join(CONFIG).is_file()).collect()
}

/// A run with its latest weights.
#[derive(Debug)]
pub struct Trained {
    /// The configuration of the run.
    pub config: RunConfig,
    /// Weights file; empty without weights.
    pub weights: Vec<u8>,
    /// SHA-256 of the weights file; empty without weights.
    pub sha256: String,
    /// Display name.
    pub name: String,
    /// The run folder; `None` for a weights file.
    pub folder: Option<PathBuf>,
    /// Warnings about the weights.
    pub notes: Vec<String>,
    /// Whether they are the weights that the finished run ended with, undamaged.
    pub is_final: bool,
}

/// Loads a run folder, or a weights file together with a configuration file.
pub fn load(path: &Path, config: Option<&Path>) -> anyhow::Result<Trained> {
    if path.is_file() {
        let Some(config) = config else {
            return Err(usage(format!("{} is a file: add --config with the run's config.toml", path.display())));
        };
        let weights = std::fs::read(path).with_context(|| path.display().to_string())?;
        let config = crate::settings::read_from("--config", config)?;
        let notes = weights_file::check(&weights, &config).with_context(|| path.display().to_string())?;
        let (sha256, name) = (sha256::hex(&weights), path.display().to_string());
        return Ok(Trained { config, weights, sha256, name, folder: None, notes, is_final: true });
    }
    if !path.is_dir() {
        return Err(usage(format!("RUN: {} does not exist", path.display())));
    }
    if config.is_some() {
        return Err(usage("--config: a run folder has its own configuration; leave it out"));
    }
    let config = config_of(path)?;
    let (weights, mut notes, is_final) = weights_of(path, &config)?;
    notes.extend(weights_file::check(&weights, &config).with_context(|| path.display().to_string())?);
    let name = path.file_name().map_or_else(|| path.display().to_string(), |name| name.to_string_lossy().into_owned());
    Ok(Trained { config, sha256: sha256::hex(&weights), weights, name, folder: Some(path.to_owned()), notes, is_final })
}

/// A configuration file as a run without weights.
pub(crate) fn untrained(path: &Path, described: Option<&Described>) -> anyhow::Result<Trained> {
    let config = match described {
        Some(_) => Overrides::default().read(Some(path), described)?,
        None => crate::settings::read_from("RUN", path)?,
    };
    let name = path.display().to_string();
    Ok(Trained {
        config,
        weights: Vec::new(),
        sha256: String::new(),
        name,
        folder: None,
        notes: Vec::new(),
        is_final: false,
    })
}

/// The final weights if they exist and are intact, otherwise those of the newest usable checkpoint.
fn weights_of(folder: &Path, config: &RunConfig) -> anyhow::Result<(Vec<u8>, Vec<String>, bool)> {
    let mut notes = Vec::new();
    let expected = std::fs::read(folder.join(SUMMARY))
        .ok()
        .and_then(|bytes| serde_json::from_slice::<serde_json::Value>(&bytes).ok())
        .and_then(|summary| summary["weights_sha256"].as_str().map(str::to_owned));
    match (std::fs::read(folder.join(WEIGHTS)), expected) {
        (Ok(bytes), Some(expected)) if sha256::hex(&bytes) == expected => return Ok((bytes, notes, true)),
        (Ok(_), Some(_)) => notes.push(format!("{WEIGHTS} is corrupt (its checksum differs from {SUMMARY})")),
        (Err(_), Some(_)) => notes.push(format!("{WEIGHTS} is missing")),
        (_, None) => notes.push("the run is not finished".to_owned()),
    }
    let commander = CommanderPpo::new(&config.commander, &config.task, config.run.seed);
    // An evaluation needs no replay buffer.
    let template = Learned { replay: None, ..Learned::init(config, &Algorithm::new(config)?, &commander)? };
    let (progress, learned, skipped) = checkpoint::read_latest(folder, &template)?;
    notes.extend(skipped.iter().map(what_is_wrong));
    notes.push(format!("using checkpoint {:06}", progress.iteration));
    Ok((learned.weights()?, notes, false))
}

/// `checkpoint 000010 is corrupt (weights.safetensors: its checksum differs from the manifest)`
pub(crate) fn what_is_wrong(error: &CheckpointError) -> String {
    let CheckpointError::File { path, reason } = error else {
        return format!("a checkpoint is corrupt ({error})");
    };
    let text = |part: Option<&std::ffi::OsStr>| part.map(|p| p.to_string_lossy().into_owned()).unwrap_or_default();
    let checkpoint = text(path.parent().and_then(Path::file_name));
    if checkpoint == checkpoint::REPLAY {
        return format!("the replay buffer is corrupt ({}: {reason})", text(path.file_name()));
    }
    format!("checkpoint {checkpoint} is corrupt ({}: {reason})", text(path.file_name()))
}

/// The checkpoint that a resumed run continues from when the newest `skipped` ones are unusable.
pub(crate) fn continues_from(folder: &Path, skipped: usize) -> Option<String> {
    checkpoint::list(folder).iter().rev().nth(skipped)?.file_name().map(|name| name.to_string_lossy().into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_that_is_not_empty_is_rejected_with_a_remedy() {
        let place = tempfile::tempdir().unwrap();
        let dir = place.path().join("run");
        let config = RunConfig::default();
        let toml = config.to_toml().unwrap();
        let begin = || begin(Some(&dir), "", &toml, "test", false).map_err(refused);
        let (_, claim) = begin().unwrap();
        assert_eq!(config_of(&dir).unwrap(), config);
        let error = begin().unwrap_err();
        assert!(error.to_string().contains("--resume"), "{error}");
        assert_eq!(crate::failure::code_of(&error), magex_runtime::exit::CANNOT_CREATE);
        drop(claim);
        std::fs::remove_file(dir.join(CONFIG)).unwrap();
        std::fs::write(dir.join("thesis.tex"), "").unwrap();
        assert!(!begin().unwrap_err().to_string().contains("--resume"));
        assert!(config_of(&dir).unwrap_err().to_string().contains("not a run folder"));
    }

    #[test]
    fn corrupt_checkpoints_are_named() {
        let error = CheckpointError::File {
            path: "runs/x/checkpoints/000010/state.json".into(),
            reason: "its checksum differs from the manifest".into(),
        };
        assert_eq!(
            what_is_wrong(&error),
            "checkpoint 000010 is corrupt (state.json: its checksum differs from the manifest)"
        );
    }
}
