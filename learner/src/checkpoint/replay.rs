//! The files of a replay buffer: `replay/<iteration>-<hash>.safetensors`, one per iteration, written once and shared by all
//! checkpoints whose buffers reach back that far. So a checkpoint writes the episodes since the last one, not the whole buffer.

use super::disk::{Disk, replace_file};
use super::{CheckpointError, in_file};
use crate::train::replay::{Block, Replay};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// Its folder in a run.
pub const FOLDER: &str = "replay";

fn folder(run: &Path) -> PathBuf {
    run.join(FOLDER)
}

/// Writes the blocks that have no file yet. A file has its name only when it is complete and safe from a power cut, and its name
/// says what is in it.
pub(super) fn write(disk: &dyn Disk, run: &Path, replay: &Replay) -> Result<(), CheckpointError> {
    let folder = folder(run);
    disk.create_dir(&folder).map_err(in_file(&folder))?;
    for block in replay.blocks() {
        let name = Block::file(block.iteration, &block.sha256);
        let path = folder.join(&name);
        if !path.exists() {
            let bytes = block.encode().map_err(in_file(&path))?;
            replace_file(disk, &folder, &name, &bytes).map_err(in_file(&path))?;
        }
    }
    Ok(())
}

/// The buffer of the checkpoint in `checkpoint`, into an empty one.
pub(super) fn read(
    checkpoint: &Path,
    empty: &Replay,
    index: &BTreeMap<u32, String>,
) -> Result<Replay, CheckpointError> {
    let run = checkpoint.parent().and_then(Path::parent).unwrap_or(checkpoint);
    let mut replay = empty.clone();
    for (&iteration, sha256) in index {
        let path = folder(run).join(Block::file(iteration, sha256));
        let bytes = fs::read(&path).map_err(in_file(&path))?;
        replay.restore(iteration, sha256, &bytes).map_err(in_file(&path))?;
    }
    Ok(replay)
}

/// Removes the files of some iterations, and half-written ones.
pub(super) fn remove(disk: &dyn Disk, run: &Path, which: impl Fn(u32) -> bool) {
    for entry in fs::read_dir(folder(run)).into_iter().flatten().filter_map(Result::ok) {
        let name = entry.file_name();
        let name = name.to_string_lossy();
        let iteration = name.split('-').next().and_then(|digits| digits.parse().ok());
        let goes = iteration.is_some_and(&which) || name.starts_with('.');
        if goes && let Err(error) = disk.remove_file(&entry.path()) {
            // It only takes room.
            tracing::warn!(%error, path = %entry.path().display(), "old episodes cannot be removed");
        }
    }
}
