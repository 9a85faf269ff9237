//! What writing to a run folder asks of the file system, one step at a time: a test can cut it off at each of them.

use magex_runtime::limits::explained;
use std::fs::{self, File};
use std::io;
use std::path::Path;

/// The steps, taken on the real file system; tests put something in between.
pub trait Disk: std::fmt::Debug + Send {
    /// Makes a folder and those above it.
    fn create_dir(&mut self, path: &Path) -> io::Result<()> {
        fs::create_dir_all(path)
    }

    /// Makes or replaces a file. A kill may leave part of it.
    fn write(&mut self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        fs::write(path, bytes).map_err(explained)
    }

    /// Returns once a file, or the entries of a folder, would survive a power cut.
    fn sync(&mut self, path: &Path) -> io::Result<()> {
        File::open(path)?.sync_all()
    }

    /// Gives a file or folder another name, at once.
    fn rename(&mut self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(from, to)
    }

    /// Removes a folder and what is in it. A kill may leave part of it.
    fn remove_dir(&mut self, path: &Path) -> io::Result<()> {
        fs::remove_dir_all(path)
    }
}

/// The real one.
#[derive(Debug, Clone, Copy, Default)]
pub struct FileSystem;

impl Disk for FileSystem {}

/// Replaces a file as a whole: a reader sees the old one or the new one, also after a kill or a power cut.
pub fn replace_file(disk: &mut dyn Disk, folder: &Path, name: &str, bytes: &[u8]) -> io::Result<()> {
    let temporary = folder.join(format!(".{name}.tmp"));
    let written = disk.write(&temporary, bytes).and_then(|()| disk.sync(&temporary));
    if let Err(error) = written {
        // Half a file is of no use and takes room, which may be what is missing.
        let _ = fs::remove_file(&temporary);
        return Err(error);
    }
    disk.rename(&temporary, &folder.join(name))?;
    disk.sync(folder)
}
