//! The state of a run folder when a learner is started on it.

use crate::checkpoint;
use std::fs;
use std::path::Path;

pub(crate) const CONFIG_FILE: &str = "config.toml";

/// What a run folder contains.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum RunFolderState {
    /// Nothing, or no folder.
    Empty,
    /// A run whose learner ended before its first checkpoint was complete: nothing has been trained.
    Begun,
    /// A run that can be continued, or is complete.
    Run,
    /// Something else, or a run without checkpoints.
    Other,
}

impl RunFolderState {
    /// Inspects a folder. An unreadable folder counts as [`Self::Other`], which is never overwritten.
    pub(crate) fn of(out: &Path) -> Self {
        let names: Vec<String> = match fs::read_dir(out) {
            Ok(entries) => entries
                .filter_map(Result::ok)
                .map(|entry| entry.file_name().to_string_lossy().into_owned())
                // The root of a new file system contains this folder.
                .filter(|name| name != "lost+found")
                .collect(),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Self::Empty,
            Err(_) => return Self::Other,
        };
        if names.is_empty() {
            return Self::Empty;
        }
        if !checkpoint::list(out).is_empty() {
            return Self::Run;
        }
        let has = |name: &str| names.iter().any(|own| own == name);
        // Every iteration writes a line before any later checkpoint.
        let untrained = fs::metadata(out.join("metrics.jsonl")).map_or(true, |file| file.len() == 0);
        let complete = has("summary.json") || has("weights.safetensors");
        if has(CONFIG_FILE) && untrained && !complete { Self::Begun } else { Self::Other }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state_of(files: &[&str]) -> RunFolderState {
        let folder = tempfile::tempdir().unwrap();
        for name in files {
            let path = folder.path().join(name.trim_end_matches('+'));
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            match name.ends_with('/') {
                true => fs::create_dir_all(&path).unwrap(),
                false => fs::write(&path, if name.ends_with('+') { "{}\n" } else { "" }).unwrap(),
            }
        }
        RunFolderState::of(folder.path())
    }

    #[test]
    fn only_an_untrained_run_may_begin_again() {
        assert_eq!(RunFolderState::of(Path::new("/nowhere/at/all")), RunFolderState::Empty);
        let cases: [(&[&str], RunFolderState); 10] = [
            (&[], RunFolderState::Empty),
            (&["lost+found/"], RunFolderState::Empty),
            (&["config.toml"], RunFolderState::Begun),
            (&["config.toml+", "metrics.jsonl", "checkpoints/.000000.tmp/weights.safetensors"], RunFolderState::Begun),
            (&["config.toml", "metrics.jsonl", "checkpoints/000000/manifest.json"], RunFolderState::Run),
            // An unreadable checkpoint needs an operator's decision.
            (&["checkpoints/000005/"], RunFolderState::Run),
            (&["config.toml", "metrics.jsonl+"], RunFolderState::Other),
            (&["config.toml", "summary.json"], RunFolderState::Other),
            (&["config.toml", "weights.safetensors"], RunFolderState::Other),
            (&["thesis.doc"], RunFolderState::Other),
        ];
        for (files, expected) in cases {
            assert_eq!(state_of(files), expected, "{files:?}");
        }
    }
}
