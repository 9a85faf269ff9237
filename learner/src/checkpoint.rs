//! Checkpoints: everything that learning changes, written so that a kill at any byte leaves the previous one usable.
//!
//! A checkpoint is a folder `checkpoints/<iteration>` with `weights.safetensors` (every network of [`Learned`]),
//! `optimiser.safetensors` (what their optimisers remember), `state.json` (counters, value statistics) and, written last, `manifest.json`
//! with the SHA-256 of each. It is written under a temporary name, flushed to disk, and renamed. Of a replay buffer it has the
//! hashes: the episodes are in files of their own, which checkpoints share (`checkpoint/replay.rs`).

pub mod disk;
mod replay;

pub use replay::FOLDER as REPLAY;

use self::disk::{Disk, FileSystem};
use crate::train::gae::ValueNorm;
use crate::train::learned::{Learned, Moments, Network};
use crate::train::replay::Replay;
use magex_core::sha256;
use magex_nets::params::{ParamError, Params, to_safetensors};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// Format of the folder; readers reject any other.
pub const FORMAT: u32 = 4;

/// Why a checkpoint could not be written or read.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// A file or folder cannot be read or written, or a file is truncated or altered.
    #[error("checkpoint {path}: {reason}")]
    File {
        /// Which file or folder.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The weights do not fit the configuration.
    #[error(transparent)]
    Weights(#[from] ParamError),
    /// Another release wrote it.
    #[error(
        "checkpoint {path}: format {format}, written by {writer}, which reads it; this is magex {VERSION}, which reads format {FORMAT}: resume with the release that wrote it, or start the run anew with another --out",
        writer = writer(*format)
    )]
    Format {
        /// Which folder.
        path: PathBuf,
        /// Its format.
        format: u32,
    },
    /// There are some, and all are damaged.
    #[error(
        "{run}: none of the {count} checkpoints is usable; the newest: {newest}; restore a backup, or start anew with another --out"
    )]
    Unusable {
        /// Folder of the run.
        run: PathBuf,
        /// How many there are.
        count: usize,
        /// What is wrong with the newest.
        newest: Box<CheckpointError>,
    },
    /// There is none.
    #[error("{0}: no usable checkpoint; start the run anew with another --out")]
    None(PathBuf),
}

const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Turns what is wrong with a file or folder into the error that names it.
fn in_file<R: ToString>(path: &Path) -> impl FnOnce(R) -> CheckpointError + use<'_, R> {
    move |reason| CheckpointError::File { path: path.to_owned(), reason: reason.to_string() }
}

fn writer(format: u32) -> &'static str {
    match format {
        1 => "magex 0.1.0 (commit 389f705)",
        // These two have the same files; what is computed on from them has other bits.
        2 => "magex 0.2.0 (commit aa62ae4 or before)",
        3 => "magex 0.2.0 (commit e39ac1d or before)",
        _ => "another release of magex",
    }
}

/// Counters of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Progress {
    /// Identity of the run.
    pub run_id: String,
    /// Fingerprint of the effective configuration.
    pub config_sha256: String,
    /// The effective configuration, TOML; empty in older checkpoints.
    #[serde(default)]
    pub config: String,
    /// Iterations completed.
    pub iteration: u32,
    /// Joint environment steps trained on.
    pub joint_env_steps: u64,
    /// Consecutive evaluations at or above the target, those of completed iterations.
    pub on_target: u32,
    /// Seconds spent before this checkpoint, over all processes of the run.
    pub wall_s: f64,
}

/// state.json: what learning changes beside weights and moments, and the counters.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct State {
    format: u32,
    progress: Progress,
    value_norm: ValueNorm,
    /// Updates done by each network's optimiser, Adam or another.
    adam_steps: BTreeMap<String, u64>,
    /// Iterations in the replay buffer, with the SHA-256 of their files; not there for algorithms without one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    replay: Option<BTreeMap<u32, String>>,
}

/// What the optimisers remember: `<network>.first.…` and `<network>.second.…`, as far as a network's optimiser has them.
fn moments(learned: &Learned) -> Result<Vec<u8>, ParamError> {
    let with = |network: &Network, which: &str, values: &[f32]| {
        let params = Params { entries: network.params.entries.clone(), values: values.to_vec() };
        (!values.is_empty()).then(|| (format!("{}.{which}", network.name), params))
    };
    let of = |network: &Network| {
        [with(network, "first", &network.moments.first), with(network, "second", &network.moments.second)]
    };
    let sets: Vec<(String, Params)> = learned.networks.iter().flat_map(of).flatten().collect();
    let named: Vec<(&str, &Params)> = sets.iter().map(|(name, params)| (name.as_str(), params)).collect();
    to_safetensors(&named, "{\"format\":1}")
}

#[derive(Deserialize)]
struct Format {
    format: u32,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Manifest {
    format: u32,
    sha256: BTreeMap<String, String>,
}

const MANIFEST: &str = "manifest.json";
const FILES: [&str; 3] = ["weights.safetensors", "optimiser.safetensors", "state.json"];

/// Writes a checkpoint below `run/checkpoints` and removes the oldest beyond `keep`. Returns its folder.
pub fn write(run: &Path, progress: &Progress, learned: &Learned, keep: u32) -> Result<PathBuf, CheckpointError> {
    write_on(&FileSystem, run, progress, learned, keep)
}

/// [`write()`] on a disk of the caller's.
pub fn write_on(
    disk: &dyn Disk,
    run: &Path,
    progress: &Progress,
    learned: &Learned,
    keep: u32,
) -> Result<PathBuf, CheckpointError> {
    write_keeping(disk, run, progress, learned, (keep, None))
}

/// [`write_on`] that also keeps the newest checkpoint of an iteration up to `back_to`, which a return may need.
pub(crate) fn write_keeping(
    disk: &dyn Disk,
    run: &Path,
    progress: &Progress,
    learned: &Learned,
    (keep, back_to): (u32, Option<u32>),
) -> Result<PathBuf, CheckpointError> {
    let parent = run.join("checkpoints");
    let name = format!("{:06}", progress.iteration);
    let (temporary, folder) = (parent.join(format!(".{name}.tmp")), parent.join(&name));
    if let Some(replay) = &learned.replay {
        replay::write(disk, run, replay)?;
    }
    disk.create_dir(&parent).map_err(in_file(&parent))?;
    if let Err(error) = fill(disk, &temporary, progress, learned) {
        // Half a checkpoint is of no use and takes room, which may be what is missing.
        let _ = disk.remove_dir(&temporary);
        return Err(error);
    }
    // The same iteration once more, after a resume or at a stop: the old one goes only when the new one is in its place.
    // In between it is found under its other name.
    let replaced = parent.join(format!(".{name}.old"));
    if folder.exists() {
        if replaced.exists() {
            disk.remove_dir(&replaced).map_err(in_file(&replaced))?;
        }
        disk.rename(&folder, &replaced).map_err(in_file(&folder))?;
    }
    disk.rename(&temporary, &folder).map_err(in_file(&folder))?;
    // The renames must survive a power cut before anything older goes, and with the first one the folder that they are in.
    disk.sync(&parent).map_err(in_file(&parent))?;
    disk.sync(run).map_err(in_file(run))?;
    let needed = back_to.and_then(|iteration| up_to(run, iteration).pop());
    let newest_first = list(run).into_iter().rev();
    let old = newest_first.skip(keep.max(1) as usize).filter(|old| Some(old) != needed.as_ref());
    let surplus = std::iter::once(replaced).filter(|old| old.exists()).chain(old);
    for old in surplus {
        if let Err(error) = disk.remove_dir(&old) {
            // The checkpoint itself is there.
            tracing::warn!(%error, path = %old.display(), "an old checkpoint cannot be removed");
        }
    }
    if let Some(replay) = &learned.replay {
        let oldest = list(run).first().and_then(|folder| numbered(folder.clone())).map_or(0, |(number, ..)| number);
        replay::remove(disk, run, |iteration| u64::from(iteration) + (replay.block_count() as u64) < oldest);
    }
    Ok(folder)
}

/// Everything that a checkpoint consists of, under its temporary name, safe from a power cut.
fn fill(disk: &dyn Disk, folder: &Path, progress: &Progress, learned: &Learned) -> Result<(), CheckpointError> {
    if folder.exists() {
        disk.remove_dir(folder).map_err(in_file(folder))?;
    }
    disk.create_dir(folder).map_err(in_file(folder))?;
    let state = State {
        format: FORMAT,
        progress: progress.clone(),
        value_norm: learned.value_norm,
        adam_steps: learned.networks.iter().map(|network| (network.name.clone(), network.moments.steps)).collect(),
        replay: learned.replay.as_ref().map(Replay::index),
    };
    let state = serde_json::to_vec_pretty(&state).map_err(in_file(&folder.join("state.json")))?;
    let mut contents: Vec<(&str, Vec<u8>)> =
        FILES.into_iter().zip([learned.weights()?, moments(learned)?, state]).collect();
    let sha256 = contents.iter().map(|(file, bytes)| ((*file).to_owned(), sha256::hex(bytes))).collect();
    let manifest = serde_json::to_vec_pretty(&Manifest { format: FORMAT, sha256 });
    contents.push((MANIFEST, manifest.map_err(in_file(&folder.join(MANIFEST)))?));
    for (file, bytes) in contents {
        let path = folder.join(file);
        disk.write(&path, &bytes).map_err(in_file(&path))?;
        disk.sync(&path).map_err(in_file(&path))?;
    }
    disk.sync(folder).map_err(in_file(folder))
}

/// Removes what a kill left of checkpoints that were being written, and the episodes of iterations from `iteration` on, which will
/// be collected again. No other process may be writing.
pub fn clean(disk: &dyn Disk, run: &Path, iteration: u32) {
    replay::remove(disk, run, |other| other >= iteration);
    let entries = fs::read_dir(run.join("checkpoints")).into_iter().flatten().filter_map(Result::ok);
    for path in entries.map(|entry| entry.path()).filter(|path| hidden(path, ".tmp").is_some()) {
        if let Err(error) = disk.remove_dir(&path) {
            // It only takes room.
            tracing::warn!(%error, path = %path.display(), "an unfinished checkpoint cannot be removed");
        }
    }
}

/// Checkpoint folders of a run, oldest first. Unfinished ones are not listed.
pub fn list(run: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(run.join("checkpoints")).into_iter().flatten().filter_map(Result::ok);
    let mut folders: Vec<(u64, bool, PathBuf)> = entries.filter_map(|entry| numbered(entry.path())).collect();
    folders.sort_unstable();
    // One that a kill left under its other name counts only as long as nothing is in its place.
    let names: Vec<u64> = folders.iter().filter(|(.., in_place, _)| *in_place).map(|(number, ..)| *number).collect();
    let counts = |(number, in_place, _): &(u64, bool, PathBuf)| *in_place || !names.contains(number);
    folders.into_iter().filter(counts).map(|(.., path)| path).collect()
}

/// Checkpoints of iterations up to this one, oldest first.
fn up_to(run: &Path, iteration: u32) -> Vec<PathBuf> {
    let older = |path: &PathBuf| numbered(path.clone()).is_some_and(|(number, ..)| number <= iteration.into());
    list(run).into_iter().filter(older).collect()
}

/// Renames the checkpoints so that no resume continues from them.
pub(crate) fn set_aside(run: &Path) {
    if let Err(error) = fs::rename(run.join("checkpoints"), run.join("checkpoints.tainted")) {
        tracing::error!(%error, path = %run.display(), "the checkpoints cannot be set aside; do not continue from them");
    }
}

/// Goes back: the newest checkpoint of an iteration up to this one that can be read. All newer ones are removed.
pub(crate) fn go_back(run: &Path, iteration: u32, template: &Learned) -> Option<(Progress, Learned)> {
    let (folder, found) = up_to(run, iteration).into_iter().rev().find_map(|folder| {
        let found = read(&folder, template).inspect_err(|error| tracing::warn!(%error, "skipped a checkpoint")).ok()?;
        Some((folder, found))
    })?;
    for newer in list(run).into_iter().rev().take_while(|path| *path != folder) {
        if let Err(error) = fs::remove_dir_all(&newer) {
            tracing::error!(%error, path = %newer.display(), "a checkpoint that must not be used cannot be removed; remove it");
        }
    }
    clean(&FileSystem, run, found.0.iteration);
    Some(found)
}

/// `000012` and `.000012.old`: the number, and whether the folder is in its place.
fn numbered(path: PathBuf) -> Option<(u64, bool, PathBuf)> {
    let replaced = hidden(&path, ".old");
    let number = replaced.or_else(|| number(path.file_name()?.to_str()?))?;
    Some((number, replaced.is_none(), path))
}

/// The number of `.000012` with an ending.
fn hidden(path: &Path, ending: &str) -> Option<u64> {
    number(path.file_name()?.to_str()?.strip_prefix('.')?.strip_suffix(ending)?)
}

fn number(digits: &str) -> Option<u64> {
    digits.bytes().all(|byte| byte.is_ascii_digit()).then(|| digits.parse().ok())?
}

/// Checks a checkpoint's hashes and reads it into networks laid out like `template`, and its replay buffer if `template` has one.
pub fn read(folder: &Path, template: &Learned) -> Result<(Progress, Learned), CheckpointError> {
    let corrupt = |file: &str, reason: &str| in_file(&folder.join(file))(reason);
    let load = |file: &str| fs::read(folder.join(file)).map_err(in_file(&folder.join(file)));
    let bytes = load(MANIFEST)?;
    // The format decides what else is in there.
    let Format { format } = serde_json::from_slice(&bytes).map_err(in_file(&folder.join(MANIFEST)))?;
    if format != FORMAT {
        // A flipped bit looks like another format, but only in one of two places.
        return match load("state.json").map(|state| serde_json::from_slice(&state)) {
            Ok(Ok(Format { format: FORMAT })) => {
                Err(corrupt(MANIFEST, &format!("format {format} is not that of state.json")))
            }
            _ => Err(CheckpointError::Format { path: folder.to_owned(), format }),
        };
    }
    let manifest: Manifest = serde_json::from_slice(&bytes).map_err(in_file(&folder.join(MANIFEST)))?;
    let mut contents = Vec::new();
    for file in FILES {
        let bytes = load(file)?;
        if manifest.sha256.get(file) != Some(&sha256::hex(&bytes)) {
            return Err(corrupt(file, "its checksum differs from the manifest"));
        }
        contents.push(bytes);
    }
    let state: State = serde_json::from_slice(&contents[2]).map_err(in_file(&folder.join("state.json")))?;
    let restore = |network: &Network| {
        let (name, entries) = (&network.name, &network.params.entries);
        let load = |bytes: &[u8], name: &str| Params::load(entries.clone(), bytes, name);
        let steps = state.adam_steps.get(name);
        let steps = *steps.ok_or_else(|| corrupt("state.json", &format!("adam_steps.{name} is missing")))?;
        let params = load(&contents[0], name)?;
        let moment = |which: &str, fresh: &[f32]| match fresh.is_empty() {
            true => Ok(Vec::new()),
            false => load(&contents[1], &format!("{name}.{which}")).map(|moment| moment.values),
        };
        let first = moment("first", &network.moments.first)?;
        let second = moment("second", &network.moments.second)?;
        Ok(Network { params, moments: Moments { first, second, steps }, ..network.clone() })
    };
    let networks = template.networks.iter().map(restore).collect::<Result<Vec<_>, CheckpointError>>()?;
    let replay = match &template.replay {
        Some(empty) => {
            let index = state.replay.ok_or_else(|| corrupt("state.json", "replay is missing"))?;
            Some(replay::read(folder, empty, &index)?)
        }
        None => None,
    };
    Ok((state.progress, Learned { networks, value_norm: state.value_norm, replay, about: template.about.clone() }))
}

/// Rejects a run folder whose newest checkpoint has another format, before anything else in it is read: its configuration
/// may have other keys.
pub fn check_format(run: &Path) -> Result<(), CheckpointError> {
    let Some(path) = list(run).pop() else { return Ok(()) };
    let format = |file: &str| {
        let Format { format } = serde_json::from_slice(&fs::read(path.join(file)).ok()?).ok()?;
        Some(format)
    };
    match (format(MANIFEST), format("state.json")) {
        // One file alone may have a flipped bit: `read` tells damage from another format.
        (Some(format), Some(same)) if format == same && format != FORMAT => {
            Err(CheckpointError::Format { path, format })
        }
        _ => Ok(()),
    }
}

/// The configuration that the newest undamaged checkpoint was made with, whatever its networks look like.
pub fn configuration(run: &Path) -> Option<String> {
    #[derive(Deserialize)]
    struct Counters {
        progress: Progress,
    }
    let read = |folder: &PathBuf| {
        let (manifest, state) = (fs::read(folder.join(MANIFEST)).ok()?, fs::read(folder.join("state.json")).ok()?);
        let manifest: Manifest = serde_json::from_slice(&manifest).ok()?;
        let whole = manifest.sha256.get("state.json") == Some(&sha256::hex(&state));
        serde_json::from_slice::<Counters>(&state).ok().filter(|_| whole)
    };
    list(run).iter().rev().find_map(read).map(|state| state.progress.config).filter(|config| !config.is_empty())
}

/// The newest checkpoint that can be read, and what was wrong with the newer ones. One of another format is not damage: what
/// it holds is not given up for an older one.
pub fn read_latest(run: &Path, like: &Learned) -> Result<(Progress, Learned, Vec<CheckpointError>), CheckpointError> {
    let mut skipped = Vec::new();
    for folder in list(run).iter().rev() {
        match read(folder, like) {
            Ok((progress, learned)) => return Ok((progress, learned, skipped)),
            Err(error @ CheckpointError::Format { .. }) => return Err(error),
            Err(error) => skipped.push(error),
        }
    }
    let count = skipped.len();
    Err(match skipped.into_iter().next() {
        Some(newest) if count == 1 => newest,
        Some(newest) => CheckpointError::Unusable { run: run.to_owned(), count, newest: Box::new(newest) },
        None => CheckpointError::None(run.to_owned()),
    })
}

#[cfg(test)]
mod tests;
