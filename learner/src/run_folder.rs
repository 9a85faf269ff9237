//! Run folders: what is in one, and the process that begins or continues a run in it.

use crate::checkpoint;
use crate::checkpoint::disk::{Disk, FileSystem, replace_file};
use crate::run_lock::{LOCK_FILE, LockError, RunLock};
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// The effective configuration.
pub const CONFIG_FILE: &str = "config.toml";
/// What the root of a new file system contains, what a process that began nothing may leave, and half a configuration.
const NOTHING: [&str; 3] = ["lost+found", LOCK_FILE, ".config.toml.tmp"];
/// What a run writes before its first iteration is complete.
const BEGINNING: [&str; 7] =
    [CONFIG_FILE, ".config.toml.tmp", "metrics.jsonl", "checkpoints", "replay", "logs", "tensorboard"];

/// What a run folder contains.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunFolderState {
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
    pub fn of(out: &Path) -> Self {
        let names: Vec<String> = match fs::read_dir(out) {
            Ok(entries) => entries
                .filter_map(Result::ok)
                .map(|entry| entry.file_name().to_string_lossy().into_owned())
                .filter(|name| !NOTHING.contains(&name.as_str()))
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

/// Why a run can be neither begun nor continued in a folder.
#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    /// Something is there.
    #[error("{} exists; {}", .0.display(), remedy(*.1))]
    Exists(PathBuf, RunFolderState),
    /// A link that leads nowhere.
    #[error("{} is a symbolic link to {}, which does not exist; create that folder, or remove the link", .0.display(), .1.display())]
    Dangling(PathBuf, PathBuf),
    /// The folder or a file in it cannot be written.
    #[error("{}: {}", .0.display(), .1)]
    Io(PathBuf, std::io::Error),
    /// Another process writes to it.
    #[error(transparent)]
    Lock(#[from] LockError),
}

impl FolderError {
    /// What the system says, if a file or folder cannot be used.
    pub fn io(&self) -> Option<&std::io::Error> {
        match self {
            Self::Io(_, error) | Self::Lock(LockError::File { error, .. }) => Some(error),
            _ => None,
        }
    }
}

fn remedy(state: RunFolderState) -> &'static str {
    match state {
        RunFolderState::Run | RunFolderState::Begun => {
            "add --resume to continue the run in it, or choose another folder"
        }
        _ => "it is not a run folder, or its checkpoints are missing; choose another folder",
    }
}

/// A run folder that this process may write to, until this is dropped.
#[derive(Debug)]
pub struct Claim {
    /// The lock.
    pub lock: RunLock,
    folder: PathBuf,
    /// The folders that were made, the deepest first; `None` if there was something in the folder before.
    made: Option<Vec<PathBuf>>,
}

impl Claim {
    /// Creates the folder of a new run with its configuration, and locks it. The folder of another run is never changed; with
    /// `again`, a run that ended before its first checkpoint begins again.
    ///
    /// # Errors
    /// Something else is there, another process writes to it, or it cannot be written.
    pub fn begin(out: &Path, toml: &str, command: &str, again: bool) -> Result<Self, FolderError> {
        Self::begin_on(&FileSystem, out, toml, command, again)
    }

    /// [`Self::begin`] on a disk of the caller's.
    ///
    /// # Errors
    /// As those of `begin`.
    pub fn begin_on(disk: &dyn Disk, out: &Path, toml: &str, command: &str, again: bool) -> Result<Self, FolderError> {
        let refused = || match RunFolderState::of(out) {
            RunFolderState::Empty => None,
            RunFolderState::Begun if again => None,
            state => Some(FolderError::Exists(out.to_owned(), state)),
        };
        if let Ok(target) = fs::read_link(out)
            && !out.exists()
        {
            return Err(FolderError::Dangling(out.to_owned(), target));
        }
        // Before anything is written: the lock file does not belong into a folder of something else.
        if let Some(error) = refused() {
            return Err(error);
        }
        let made: Vec<PathBuf> = out.ancestors().take_while(|path| !path.exists()).map(Path::to_owned).collect();
        let io = |error| FolderError::Io(out.to_owned(), error);
        let mut claim = create(disk, &made).map_err(io).and_then(|()| {
            let lock = RunLock::acquire(out, command)?;
            Ok(Self { lock, folder: out.to_owned(), made: None })
        })?;
        // Another process may have begun a run meanwhile.
        if let Some(error) = refused() {
            return Err(error);
        }
        match RunFolderState::of(out) {
            RunFolderState::Empty => claim.made = Some(made),
            _ => tracing::info!("nothing has been trained in this folder; beginning again"),
        }
        match replace_file(disk, out, CONFIG_FILE, toml.as_bytes()) {
            Ok(()) => Ok(claim),
            Err(error) => {
                claim.abandon();
                Err(io(error))
            }
        }
    }

    /// Locks the folder of a run that continues; `inherited` is the descriptor of the lock that a supervisor handed on.
    ///
    /// # Errors
    /// Another process writes to it, or it cannot be written.
    pub fn resume(out: &Path, command: &str, inherited: Option<i32>) -> Result<Self, FolderError> {
        let lock = match inherited {
            Some(descriptor) => RunLock::inherited(out, descriptor, command)?,
            None => RunLock::acquire(out, command)?,
        };
        Ok(Self { lock, folder: out.to_owned(), made: None })
    }

    /// Removes what [`Self::begin`] and the run made, because nothing was started. Does nothing to a folder that was not empty,
    /// or in which an iteration was trained.
    pub fn abandon(&self) {
        let trained = fs::metadata(self.folder.join("metrics.jsonl")).is_ok_and(|file| file.len() > 0);
        let Some(made) = self.made.as_ref().filter(|_| !trained) else { return };
        for name in BEGINNING.iter().chain([&LOCK_FILE]) {
            let path = self.folder.join(name);
            let removed = if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
            if let Err(error) =
                removed.or_else(|error| if error.kind() == ErrorKind::NotFound { Ok(()) } else { Err(error) })
            {
                tracing::debug!(%error, path = %path.display(), "cannot be removed");
            }
        }
        // Fails where something else is in it.
        made.iter().for_each(|path| drop(fs::remove_dir(path)));
    }
}

/// Makes folders, the deepest of which comes first, so that they survive a power cut.
fn create(disk: &dyn Disk, folders: &[PathBuf]) -> std::io::Result<()> {
    for folder in folders.iter().rev().filter(|folder| !folder.as_os_str().is_empty()) {
        disk.create_dir(folder)?;
        let above = folder.parent().filter(|above| !above.as_os_str().is_empty());
        disk.sync(above.unwrap_or(Path::new(".")))?;
    }
    Ok(())
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
        let cases: [(&[&str], RunFolderState); 11] = [
            (&[], RunFolderState::Empty),
            (&[".lock", ".config.toml.tmp"], RunFolderState::Empty),
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

    #[test]
    fn what_began_nothing_leaves_nothing_and_what_was_there_stays() {
        let place = tempfile::tempdir().unwrap();
        let (out, here) = (place.path().join("a/b/run"), place.path().join("here"));
        let claim = Claim::begin(&out, "", "test", false).unwrap();
        fs::create_dir_all(out.join("checkpoints/000000")).unwrap();
        assert!(matches!(Claim::begin(&out, "", "test", false), Err(FolderError::Exists(_, RunFolderState::Run))));
        claim.abandon();
        assert!(!place.path().join("a").exists());
        // What was trained stays.
        let claim = Claim::begin(&out, "", "test", false).unwrap();
        fs::write(out.join("metrics.jsonl"), "{}\n").unwrap();
        claim.abandon();
        assert!(out.join(CONFIG_FILE).exists());
        // An empty folder of the user's stays, and so does what a run left before.
        fs::create_dir(&here).unwrap();
        Claim::begin(&here, "", "test", false).unwrap().abandon();
        assert!(fs::read_dir(&here).unwrap().next().is_none());
        drop(Claim::begin(&here, "", "test", false).unwrap());
        Claim::begin(&here, "x = 1", "test", true).unwrap().abandon();
        assert_eq!(fs::read_to_string(here.join(CONFIG_FILE)).unwrap(), "x = 1");
        // A folder of something else does not even get a lock file.
        let thesis = place.path().join("thesis");
        fs::create_dir(&thesis).unwrap();
        fs::write(thesis.join("thesis.tex"), "").unwrap();
        let error = Claim::begin(&thesis, "", "test", true).unwrap_err().to_string();
        assert!(error.contains("not a run folder") && !thesis.join(LOCK_FILE).exists(), "{error}");
        let link = place.path().join("link");
        std::os::unix::fs::symlink("nowhere", &link).unwrap();
        let error = Claim::begin(&link, "", "test", false).unwrap_err().to_string();
        assert!(error.contains("symbolic link to nowhere"), "{error}");
    }
}
