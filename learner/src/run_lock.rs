//! One writer per run folder: the lock that every process holds that writes to one.
//!
//! It is a lock of the file `.lock` in the folder, which the system releases when the last process that holds it ends,
//! however it ends. `magex train` hands its open file to the learner that it supervises: both hold the same lock, and a
//! learner that outlives a killed supervisor for a moment still keeps other processes out.

use magex_runtime::process;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Error, ErrorKind, Write as _};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Name of the file. Its lines say which processes hold the lock: `HOST PID COMMAND`, and a word when it is stopping.
pub const LOCK_FILE: &str = ".lock";
/// The last line after a holder was told to stop.
const STOPPING: &str = "stopping";

/// How long a process waits for a holder that is stopping: longer than a learner takes to stop.
const PATIENCE: Duration = Duration::from_secs(20);
/// How long it waits for any other one: its signal may still be on the way.
const GRACE: Duration = Duration::from_secs(2);
const POLL: Duration = Duration::from_millis(20);

/// Why a folder cannot be locked.
#[derive(Debug, thiserror::Error)]
pub enum LockError {
    /// Another process writes to it.
    #[error(
        "{}: {holder} writes to this run folder, and still did after {waited} s; stop it or wait for its end, or choose another --out",
        .folder.display()
    )]
    Held {
        /// The folder.
        folder: PathBuf,
        /// The process that holds the lock.
        holder: String,
        /// Seconds.
        waited: u64,
    },
    /// The lock file cannot be used.
    #[error("{}: {error}; the run folder must be writable", .path.display())]
    File {
        /// The lock file.
        path: PathBuf,
        /// What the system says.
        error: Error,
    },
    /// The descriptor that the supervisor named is not the lock of this folder.
    #[error("descriptor {descriptor} is not the lock of {}", .folder.display())]
    NotInherited {
        /// As it was named.
        descriptor: i32,
        /// The folder.
        folder: PathBuf,
    },
}

/// The right to write to a run folder, for as long as it exists.
#[derive(Debug)]
pub struct RunLock {
    /// Opened for appending. The lock of a supervised learner is the supervisor's open file, not this one.
    file: File,
}

impl RunLock {
    /// Locks an existing folder for `command`. Waits for another holder to end: `PATIENCE` if it is stopping,
    /// otherwise `GRACE`.
    ///
    /// # Errors
    /// The other one does not end, or the lock file cannot be used.
    pub fn acquire(folder: &Path, command: &str) -> Result<Self, LockError> {
        let path = folder.join(LOCK_FILE);
        let failed = |error| LockError::File { path: path.clone(), error };
        let (start, mut told) = (Instant::now(), false);
        loop {
            let file = open(&path).map_err(failed)?;
            match file.try_lock() {
                // A command that started nothing removes its lock file: the lock of a removed file protects nothing.
                Ok(()) if is_at(&file, &path) => {
                    file.set_len(0).map_err(failed)?;
                    return Self::signed(file, command).map_err(failed);
                }
                Ok(()) => continue,
                Err(TryLockError::WouldBlock) => {}
                Err(TryLockError::Error(error)) if error.kind() == ErrorKind::Interrupted => continue,
                Err(TryLockError::Error(error)) => {
                    // Some network file systems have no locks.
                    tracing::warn!(%error, path = %path.display(), "the run folder cannot be locked: start only one process on it");
                    return Self::signed(file, command).map_err(failed);
                }
            }
            let holder = Holder::of(&path);
            if start.elapsed() >= if holder.ends { PATIENCE } else { GRACE } {
                let (folder, waited) = (folder.to_owned(), start.elapsed().as_secs());
                return Err(LockError::Held { folder, holder: holder.name, waited });
            }
            if holder.ends && !told {
                told = true;
                let (holder, patience_s) = (holder.name, PATIENCE.as_secs());
                tracing::info!(holder, patience_s, "waiting for the process that still writes to the run folder");
            }
            std::thread::sleep(POLL);
        }
    }

    /// The lock that the supervisor of this process holds through an open file that it handed on.
    ///
    /// # Errors
    /// The descriptor is something else.
    pub fn inherited(folder: &Path, descriptor: i32, command: &str) -> Result<Self, LockError> {
        let path = folder.join(LOCK_FILE);
        let own = std::fs::metadata(format!("/proc/self/fd/{descriptor}"));
        let same =
            matches!((own, std::fs::metadata(&path)), (Ok(a), Ok(b)) if (a.dev(), a.ino()) == (b.dev(), b.ino()));
        if !same {
            return Err(LockError::NotInherited { descriptor, folder: folder.to_owned() });
        }
        open(&path).and_then(|file| Self::signed(file, command)).map_err(|error| LockError::File { path, error })
    }

    fn signed(mut file: File, command: &str) -> std::io::Result<Self> {
        let line = format!("{} {} {command}\n", process::host(), std::process::id());
        match file.write_all(line.as_bytes()) {
            // The line only informs: a full disk does not keep a run from resuming.
            Err(error) if !matches!(error.kind(), ErrorKind::StorageFull | ErrorKind::FileTooLarge) => Err(error),
            _ => Ok(Self { file }),
        }
    }

    /// Tells processes that want the folder that this one was told to stop.
    pub fn stopping(&self) {
        if let Err(error) = (&self.file).write_all(format!("{STOPPING}\n").as_bytes()) {
            tracing::debug!(%error, "the lock file cannot be written");
        }
    }
}

impl AsFd for RunLock {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.file.as_fd()
    }
}

fn open(path: &Path) -> std::io::Result<File> {
    OpenOptions::new().create(true).read(true).append(true).open(path)
}

/// Whether the open file is the one at the path.
fn is_at(file: &File, path: &Path) -> bool {
    matches!((file.metadata(), std::fs::metadata(path)), (Ok(a), Ok(b)) if (a.dev(), a.ino()) == (b.dev(), b.ino()))
}

/// What the lock file says about the process that holds the lock.
struct Holder {
    name: String,
    /// It was told to stop, or the supervisor that began is gone.
    ends: bool,
}

impl Holder {
    fn of(path: &Path) -> Self {
        let text = std::fs::read_to_string(path).unwrap_or_default();
        let host = process::host();
        let lives = |line: &&str| {
            let mut words = line.split(' ');
            let (at, pid) = (words.next(), words.next().unwrap_or_default());
            at != Some(host.as_str()) || Path::new("/proc").join(pid).exists()
        };
        let signed = || text.lines().filter(|line| *line != STOPPING);
        let name = signed().find(lives).and_then(|line| {
            let mut words = line.splitn(3, ' ');
            let (at, pid, command) = (words.next()?, words.next()?, words.next()?);
            let place = if at == host { String::new() } else { format!(" on {at}") };
            Some(format!("process {pid} ({command}){place}"))
        });
        let ends = text.lines().any(|line| line == STOPPING) || !signed().next().is_some_and(|line| lives(&line));
        Self { name: name.unwrap_or_else(|| "another process".to_owned()), ends }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_second_is_refused_with_the_name_of_the_first_and_let_in_when_that_ends() {
        let folder = tempfile::tempdir().unwrap();
        let first = RunLock::acquire(folder.path(), "magex train").unwrap();
        let error = RunLock::acquire(folder.path(), "magex learner").unwrap_err().to_string();
        let pid = std::process::id();
        assert!(error.contains(&format!("process {pid} (magex train)")), "{error}");
        assert!(error.contains(&folder.path().display().to_string()), "{error}");
        // One that is stopping is waited for, longer than any other.
        first.stopping();
        let ending = std::thread::spawn(move || {
            std::thread::sleep(GRACE + Duration::from_millis(200));
            drop(first);
        });
        RunLock::acquire(folder.path(), "magex learner").unwrap();
        ending.join().unwrap();
    }

    #[test]
    fn the_lock_of_a_removed_file_is_taken_anew() {
        let folder = tempfile::tempdir().unwrap();
        let _removed = RunLock::acquire(folder.path(), "a").unwrap();
        std::fs::remove_file(folder.path().join(LOCK_FILE)).unwrap();
        RunLock::acquire(folder.path(), "b").unwrap();
    }

    #[test]
    fn a_descriptor_of_something_else_is_no_lock() {
        let folder = tempfile::tempdir().unwrap();
        let error = RunLock::inherited(folder.path(), 0, "magex learner").unwrap_err();
        assert!(matches!(error, LockError::NotInherited { descriptor: 0, .. }), "{error}");
    }

    #[test]
    fn a_holder_of_another_machine_is_named_with_it_and_one_whose_supervisor_is_gone_is_ending() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "elsewhere 12 magex learner\n").unwrap();
        let holder = Holder::of(file.path());
        assert_eq!((holder.name.as_str(), holder.ends), ("process 12 (magex learner) on elsewhere", false));
        let (host, pid) = (process::host(), std::process::id());
        std::fs::write(file.path(), format!("{host} 999999999 magex train\n{host} {pid} magex learner\n")).unwrap();
        let holder = Holder::of(file.path());
        assert_eq!((holder.name, holder.ends), (format!("process {pid} (magex learner)"), true));
    }
}
