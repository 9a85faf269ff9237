//! Checkpoints: everything that learning changes, written so that a kill at any byte leaves the previous one usable.
//!
//! A checkpoint is a folder `checkpoints/<iteration>` with `weights.safetensors` (actor, critic, commander),
//! `optimiser.safetensors` (Adam moments), `state.json` (counters, value statistics) and, written last, `manifest.json`
//! with the SHA-256 of each. It is written under a temporary name, flushed to disk, and renamed.

use crate::adam::Adam;
use crate::commander::CommanderState;
use crate::gae::ValueNorm;
use crate::mappo::ExecutorState;
use magex_nets::params::{ParamError, Params, from_safetensors, to_safetensors};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Format of the folder; readers refuse a newer one.
pub const FORMAT: u32 = 1;

/// Why a checkpoint could not be written or read.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The file system refused.
    #[error("checkpoint {path}: {error}")]
    Io {
        /// Which file or folder.
        path: PathBuf,
        /// What the system said.
        error: std::io::Error,
    },
    /// A file is missing, truncated or altered.
    #[error("checkpoint {path}: {reason}")]
    Corrupt {
        /// Which file or folder.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The weights do not fit the configuration.
    #[error(transparent)]
    Weights(#[from] ParamError),
    /// There is none.
    #[error("{0}: no usable checkpoint; start the run anew with another --out")]
    None(PathBuf),
}

/// Counters and statistics of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Progress {
    /// Format of the checkpoint.
    pub format: u32,
    /// Identity of the run.
    pub run_id: String,
    /// Fingerprint of the effective configuration.
    pub config_sha256: String,
    /// Iterations completed.
    pub iteration: u32,
    /// Joint environment steps trained on.
    pub joint_env_steps: u64,
    /// Consecutive evaluations at or above the target.
    pub on_target: u32,
    /// Seconds spent before this checkpoint, over all processes of the run.
    pub wall_s: f64,
    /// Running statistics of returns.
    pub value_norm: ValueNorm,
    /// Updates of each optimiser: actor, critic, commander.
    pub adam_steps: [u64; 3],
}

/// Everything that learning changes.
#[derive(Debug, Clone, PartialEq)]
pub struct Learned {
    /// Actor, critic, their optimisers, value statistics.
    pub executor: ExecutorState,
    /// Scheduler and its optimiser.
    pub commander: CommanderState,
}

impl Learned {
    /// The weights file: all networks. Its SHA-256 is the identity of what was learned.
    pub fn weights(&self) -> Result<Vec<u8>, ParamError> {
        let (e, c) = (&self.executor, &self.commander);
        to_safetensors(&[("actor", &e.actor), ("critic", &e.critic), ("commander", &c.params)], "{\"format\":1}")
    }

    /// What actors and commanders need: everything but the critic.
    pub fn broadcast(&self) -> Result<Vec<u8>, ParamError> {
        to_safetensors(&[("actor", &self.executor.actor), ("commander", &self.commander.params)], "{\"format\":1}")
    }

    fn moments(&self) -> Result<Vec<u8>, ParamError> {
        let (e, c) = (&self.executor, &self.commander);
        let with =
            |params: &Params, numbers: &[f32]| Params { entries: params.entries.clone(), numbers: numbers.to_vec() };
        let sets = [
            ("actor.first", with(&e.actor, &e.actor_adam.first)),
            ("actor.second", with(&e.actor, &e.actor_adam.second)),
            ("critic.first", with(&e.critic, &e.critic_adam.first)),
            ("critic.second", with(&e.critic, &e.critic_adam.second)),
            ("commander.first", with(&c.params, &c.adam.first)),
            ("commander.second", with(&c.params, &c.adam.second)),
        ];
        let named: Vec<(&str, &Params)> = sets.iter().map(|(name, params)| (*name, params)).collect();
        to_safetensors(&named, "{\"format\":1}")
    }
}

/// SHA-256 in lower-case hex.
pub fn sha256_hex(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Manifest {
    format: u32,
    sha256: BTreeMap<String, String>,
}

const FILES: [&str; 3] = ["weights.safetensors", "optimiser.safetensors", "state.json"];

/// Writes a checkpoint below `run/checkpoints` and removes the oldest beyond `keep`. Returns its folder.
pub fn write(run: &Path, progress: &Progress, learned: &Learned, keep: u32) -> Result<PathBuf, CheckpointError> {
    let parent = run.join("checkpoints");
    let name = format!("{:06}", progress.iteration);
    let (temporary, folder) = (parent.join(format!(".{name}.tmp")), parent.join(&name));
    let io = |path: &Path| {
        let path = path.to_owned();
        move |error| CheckpointError::Io { path, error }
    };
    if temporary.exists() {
        fs::remove_dir_all(&temporary).map_err(io(&temporary))?;
    }
    fs::create_dir_all(&temporary).map_err(io(&temporary))?;
    let state = serde_json::to_vec_pretty(progress)
        .map_err(|e| CheckpointError::Corrupt { path: folder.join("state.json"), reason: e.to_string() })?;
    let contents = [learned.weights()?, learned.moments()?, state];
    let mut manifest = Manifest { format: FORMAT, sha256: BTreeMap::new() };
    for (file, bytes) in FILES.iter().zip(&contents) {
        write_file(&temporary.join(file), bytes)?;
        manifest.sha256.insert((*file).to_owned(), sha256_hex(bytes));
    }
    let bytes = serde_json::to_vec_pretty(&manifest)
        .map_err(|e| CheckpointError::Corrupt { path: folder.join("manifest.json"), reason: e.to_string() })?;
    write_file(&temporary.join("manifest.json"), &bytes)?;
    // The same iteration once more, after a resume or at a stop: the old one goes only when the new one is in its place.
    let replaced = parent.join(format!(".{name}.old"));
    if replaced.exists() {
        fs::remove_dir_all(&replaced).map_err(io(&replaced))?;
    }
    if folder.exists() {
        fs::rename(&folder, &replaced).map_err(io(&folder))?;
    }
    fs::rename(&temporary, &folder).map_err(io(&folder))?;
    if replaced.exists() {
        fs::remove_dir_all(&replaced).map_err(io(&replaced))?;
    }
    // The rename itself must survive a power cut.
    File::open(&parent).and_then(|d| d.sync_all()).map_err(io(&parent))?;
    let surplus = list(run)?;
    for old in surplus.iter().rev().skip(keep.max(1) as usize) {
        fs::remove_dir_all(old).map_err(io(old))?;
    }
    Ok(folder)
}

fn write_file(path: &Path, bytes: &[u8]) -> Result<(), CheckpointError> {
    let write = || -> std::io::Result<()> {
        let mut file = File::create(path)?;
        file.write_all(bytes)?;
        file.sync_all()
    };
    write().map_err(|error| CheckpointError::Io { path: path.to_owned(), error })
}

/// Checkpoint folders of a run, oldest first. Unfinished ones are not listed.
pub fn list(run: &Path) -> Result<Vec<PathBuf>, CheckpointError> {
    let parent = run.join("checkpoints");
    let Ok(entries) = fs::read_dir(&parent) else { return Ok(Vec::new()) };
    let mut folders: Vec<PathBuf> = entries
        .filter_map(Result::ok)
        .map(|e| e.path())
        .filter(|p| p.file_name().is_some_and(|n| n.to_string_lossy().chars().all(|c| c.is_ascii_digit())))
        .collect();
    folders.sort_by_key(|p| p.file_name().and_then(|n| n.to_string_lossy().parse::<u64>().ok()));
    Ok(folders)
}

/// Checks a checkpoint's hashes and reads it into networks laid out like `template`.
pub fn read(folder: &Path, template: &Learned) -> Result<(Progress, Learned), CheckpointError> {
    let corrupt = |file: &str, reason: String| CheckpointError::Corrupt { path: folder.join(file), reason };
    let load = |file: &str| {
        fs::read(folder.join(file)).map_err(|error| CheckpointError::Io { path: folder.join(file), error })
    };
    let manifest: Manifest =
        serde_json::from_slice(&load("manifest.json")?).map_err(|e| corrupt("manifest.json", e.to_string()))?;
    if manifest.format > FORMAT {
        return Err(corrupt("manifest.json", format!("format {} is newer than {FORMAT}", manifest.format)));
    }
    let mut contents = Vec::new();
    for file in FILES {
        let bytes = load(file)?;
        if manifest.sha256.get(file) != Some(&sha256_hex(&bytes)) {
            return Err(corrupt(file, "its checksum differs from the manifest".to_owned()));
        }
        contents.push(bytes);
    }
    let progress: Progress = serde_json::from_slice(&contents[2]).map_err(|e| corrupt("state.json", e.to_string()))?;
    let mut learned = template.clone();
    from_safetensors(&contents[0], "actor", &mut learned.executor.actor)?;
    from_safetensors(&contents[0], "critic", &mut learned.executor.critic)?;
    from_safetensors(&contents[0], "commander", &mut learned.commander.params)?;
    let moments = |prefix: &str, layout: &Params, steps: u64| -> Result<Adam, CheckpointError> {
        let mut numbers = [layout.clone(), layout.clone()];
        from_safetensors(&contents[1], &format!("{prefix}.first"), &mut numbers[0])?;
        from_safetensors(&contents[1], &format!("{prefix}.second"), &mut numbers[1])?;
        let [first, second] = numbers;
        Ok(Adam { first: first.numbers, second: second.numbers, steps })
    };
    learned.executor.actor_adam = moments("actor", &template.executor.actor, progress.adam_steps[0])?;
    learned.executor.critic_adam = moments("critic", &template.executor.critic, progress.adam_steps[1])?;
    learned.commander.adam = moments("commander", &template.commander.params, progress.adam_steps[2])?;
    learned.executor.value_norm = progress.value_norm;
    Ok((progress, learned))
}

/// The newest checkpoint that can be read, and what was wrong with the newer ones.
pub fn read_latest(
    run: &Path,
    template: &Learned,
) -> Result<(Progress, Learned, Vec<CheckpointError>), CheckpointError> {
    let mut skipped = Vec::new();
    for folder in list(run)?.iter().rev() {
        match read(folder, template) {
            Ok((progress, learned)) => return Ok((progress, learned, skipped)),
            Err(error) => skipped.push(error),
        }
    }
    match skipped.pop() {
        Some(newest) if skipped.is_empty() => Err(newest),
        _ => Err(CheckpointError::None(run.to_owned())),
    }
}

#[cfg(test)]
mod tests;
