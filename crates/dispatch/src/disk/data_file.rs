//! The file of the missions under its path: opened so that its name survives a power cut, and noticed when it is another one.

use super::DiskError;
use redb::Database;
use redb::backends::FileBackend;
use rustix::fs::{CWD, RenameFlags, renameat_with};
use rustix::io::Errno;
use std::fs::{self, File, OpenOptions};
use std::io::{Error, ErrorKind};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

/// Page cache, bytes: small, because the missions themselves are in memory.
const CACHE: usize = 4 << 20;

/// Which file it is, whatever its name.
type Identity = (u64, u64);

/// The file at a path.
pub(super) struct DataFile {
    path: PathBuf,
    /// The one that was opened last.
    opened: Option<Identity>,
}

impl DataFile {
    pub(super) fn new(path: &Path) -> Self {
        Self { path: path.to_owned(), opened: None }
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Whether the file that was opened last is still the one at the path.
    pub(super) fn is_there(&self) -> bool {
        self.opened.is_some() && identity(&self.path) == self.opened
    }

    /// Opens or creates the file, and its folder, and does `first` to it before it has its name. One that another program put in
    /// the place of an opened one is kept beside it: it may be a backup.
    pub(super) fn open(&mut self, first: impl Fn(&Database) -> Result<(), DiskError>) -> Result<Database, DiskError> {
        if self.opened.is_some() && !self.is_there() && self.path.exists() {
            self.set_aside()?;
        }
        let folder = self.path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        fs::create_dir_all(folder).map_err(io)?;
        let new = !self.path.exists();
        // A power cut while it is made leaves a file that cannot be opened: it gets its name when it is complete.
        let path = if new { self.unfinished(folder) } else { self.path.clone() };
        let file = OpenOptions::new().read(true).write(true).create(true).truncate(new).open(&path).map_err(io)?;
        let opened = file.metadata().map(|meta| (meta.dev(), meta.ino())).map_err(io)?;
        let database = Database::builder().set_cache_size(CACHE).create_with_backend(FileBackend::new(file)?)?;
        first(&database)?;
        if new {
            self.name(&path)?;
        }
        // A file whose name is lost in a power cut is lost.
        for entry in [Some(folder), folder.parent()].into_iter().flatten() {
            let entry = if entry.as_os_str().is_empty() { Path::new(".") } else { entry };
            match File::open(entry).and_then(|entry| entry.sync_all()) {
                Err(error) if error.kind() != ErrorKind::PermissionDenied => return Err(io(error)),
                _ => {}
            }
        }
        self.opened = Some(opened);
        Ok(database)
    }

    /// Where a new file is made. What a power cut left of others is removed.
    fn unfinished(&self, folder: &Path) -> PathBuf {
        let name = |end: &str| {
            self.path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned()) + end
        };
        for entry in fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok) {
            if entry.file_name().to_string_lossy().starts_with(&name(".new-")) {
                // It only takes room.
                let _ = fs::remove_file(entry.path());
            }
        }
        folder.join(name(&format!(".new-{}", std::process::id())))
    }

    /// Gives a complete file its name, unless another commander was faster.
    fn name(&self, unfinished: &Path) -> Result<(), DiskError> {
        let named = renameat_with(CWD, unfinished, CWD, &self.path, RenameFlags::NOREPLACE);
        match named {
            Ok(()) => Ok(()),
            Err(Errno::EXIST) => Err(DiskError::InUse),
            // Some network file systems cannot refuse to replace.
            Err(Errno::INVAL | Errno::NOSYS) => fs::rename(unfinished, &self.path).map_err(io),
            Err(error) => Err(io(error.into())),
        }
    }

    fn set_aside(&self) -> Result<(), DiskError> {
        // Not from under another commander, which would hold its lock.
        let other = OpenOptions::new().read(true).write(true).open(&self.path).map_err(io)?;
        let locked = Database::builder().set_cache_size(CACHE).create_with_backend(FileBackend::new(other)?);
        if let Err(redb::DatabaseError::DatabaseAlreadyOpen) = locked {
            return Err(DiskError::InUse);
        }
        let mut names = (1..1000).map(|number| self.path.with_extension(format!("redb.found-{number}")));
        let aside = names.find(|aside| !aside.exists()).ok_or_else(|| io(Error::from(ErrorKind::AlreadyExists)))?;
        fs::rename(&self.path, &aside).map_err(io)?;
        tracing::warn!(file = %aside.display(), "another file was in the place of the missions; it is kept here");
        Ok(())
    }
}

fn identity(path: &Path) -> Option<Identity> {
    fs::metadata(path).ok().map(|meta| (meta.dev(), meta.ino()))
}

fn io(error: Error) -> DiskError {
    redb::Error::Io(error).into()
}
