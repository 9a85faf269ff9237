//! What writing to a run folder asks of the file system, one step at a time: a test can cut it off at each of them, and forget
//! what was not synced.

use magex_runtime::limits::explained;
use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Write as _};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

/// The steps, taken on the real file system; tests put something in between.
pub trait Disk: std::fmt::Debug + Send + Sync {
    /// Makes a folder, unless it is there. Those above it must exist: a run folder that was removed is not made again.
    fn create_dir(&self, path: &Path) -> io::Result<()> {
        fs::create_dir(path).or_else(|error| match error.kind() {
            ErrorKind::AlreadyExists if path.is_dir() => Ok(()),
            _ => Err(error),
        })
    }

    /// Makes or replaces a file. A kill may leave part of it.
    fn write(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        fs::write(path, bytes).map_err(explained)
    }

    /// Adds to a file that exists. A kill may leave part of it.
    fn append(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        OpenOptions::new().append(true).open(path)?.write_all(bytes).map_err(explained)
    }

    /// Cuts a file that exists to a length.
    fn truncate(&self, path: &Path, length: u64) -> io::Result<()> {
        OpenOptions::new().write(true).open(path)?.set_len(length)
    }

    /// Returns once a file, or the entries of a folder, would survive a power cut.
    fn sync(&self, path: &Path) -> io::Result<()> {
        File::open(path)?.sync_all()
    }

    /// Gives a file or folder another name in the same folder, at once.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(from, to)
    }

    /// Removes a file.
    fn remove_file(&self, path: &Path) -> io::Result<()> {
        fs::remove_file(path)
    }

    /// Removes a folder and what is in it. A kill may leave part of it.
    fn remove_dir(&self, path: &Path) -> io::Result<()> {
        fs::remove_dir_all(path)
    }
}

/// The real one.
#[derive(Debug, Clone, Copy, Default)]
pub struct FileSystem;

impl Disk for FileSystem {}

/// Replaces a file as a whole: a reader sees the old one or the new one, also after a kill or a power cut.
pub fn replace_file(disk: &dyn Disk, folder: &Path, name: &str, bytes: &[u8]) -> io::Result<()> {
    let temporary = folder.join(format!(".{name}.tmp"));
    let written = disk.write(&temporary, bytes).and_then(|()| disk.sync(&temporary));
    if let Err(error) = written {
        // Half a file is of no use and takes room, which may be what is missing.
        let _ = disk.remove_file(&temporary);
        return Err(error);
    }
    disk.rename(&temporary, &folder.join(name))?;
    disk.sync(folder)
}

/// Which file or folder is at a path, whatever it was called before.
pub(crate) fn identity(path: &Path) -> Option<(u64, u64)> {
    fs::metadata(path).ok().map(|meta| (meta.dev(), meta.ino()))
}

/// A run folder as it was when its run was opened. Before every write it must still be there: what is written to a folder that
/// was removed, moved or replaced would be lost, or part of another run.
#[derive(Debug, Clone)]
pub(crate) struct Place {
    folder: PathBuf,
    identity: Option<(u64, u64)>,
}

impl Place {
    pub(crate) fn of(folder: &Path) -> Self {
        Self { folder: folder.to_owned(), identity: identity(folder) }
    }

    pub(crate) fn folder(&self) -> &Path {
        &self.folder
    }

    /// Fails while another folder, or none, is at the path; like a full disk, this may end.
    pub(crate) fn check(&self) -> io::Result<()> {
        let now = identity(&self.folder);
        if now == self.identity {
            return Ok(());
        }
        let what = if now.is_some() { "replaced" } else { "removed or moved" };
        Err(io::Error::new(ErrorKind::NotFound, format!("the run folder was {what}; put it back")))
    }
}
