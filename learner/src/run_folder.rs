//! How a run folder stands when a learner is started on it.

use crate::checkpoint;
use std::fs;
use std::path::Path;

/// What there is in the folder of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Standing {
    /// Nothing, or no folder.
    Empty,
    /// What a learner leaves that died before its first checkpoint was whole: nothing of it has been trained.
    Begun,
    /// A run that can be continued, or is complete.
    Run,
    /// Something else, or a run whose checkpoints are gone.
    Other,
}

impl Standing {
    /// Looks at a folder. A folder that cannot be read counts as something else: it must not be written over.
    pub(crate) fn of(out: &Path) -> Self {
        let names: Vec<String> = match fs::read_dir(out) {
            Ok(entries) => entries
                .filter_map(Result::ok)
                .map(|entry| entry.file_name().to_string_lossy().into_owned())
                // The root of a new file system is not quite empty.
                .filter(|name| name != "lost+found")
                .collect(),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Self::Empty,
            Err(_) => return Self::Other,
        };
        if names.is_empty() {
            return Self::Empty;
        }
        if checkpoint::list(out).is_ok_and(|checkpoints| !checkpoints.is_empty()) {
            return Self::Run;
        }
        let has = |name: &str| names.iter().any(|own| own == name);
        // A line is written after every iteration, before any later checkpoint.
        let untrained = fs::metadata(out.join("metrics.jsonl")).map_or(true, |file| file.len() == 0);
        let complete = has("summary.json") || has("weights.safetensors");
        if has(crate::cli::CONFIG_FILE) && untrained && !complete { Self::Begun } else { Self::Other }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn standing(files: &[&str]) -> Standing {
        let folder = tempfile::tempdir().unwrap();
        for name in files {
            let path = folder.path().join(name.trim_end_matches('+'));
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            match name.ends_with('/') {
                true => fs::create_dir_all(&path).unwrap(),
                false => fs::write(&path, if name.ends_with('+') { "{}\n" } else { "" }).unwrap(),
            }
        }
        Standing::of(folder.path())
    }

    #[test]
    fn only_what_was_never_trained_may_begin_again() {
        assert_eq!(Standing::of(Path::new("/nowhere/at/all")), Standing::Empty);
        let cases: [(&[&str], Standing); 10] = [
            (&[], Standing::Empty),
            (&["lost+found/"], Standing::Empty),
            (&["config.toml"], Standing::Begun),
            (&["config.toml+", "metrics.jsonl", "checkpoints/.000000.tmp/weights.safetensors"], Standing::Begun),
            (&["config.toml", "metrics.jsonl", "checkpoints/000000/manifest.json"], Standing::Run),
            // A checkpoint that cannot be read is for a person to look at.
            (&["checkpoints/000005/"], Standing::Run),
            (&["config.toml", "metrics.jsonl+"], Standing::Other),
            (&["config.toml", "summary.json"], Standing::Other),
            (&["config.toml", "weights.safetensors"], Standing::Other),
            (&["thesis.doc"], Standing::Other),
        ];
        for (files, expected) in cases {
            assert_eq!(standing(files), expected, "{files:?}");
        }
    }
}
