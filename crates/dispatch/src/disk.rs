//! Missions on disk: one redb file, one row per mission, every change durable before it is answered.
//!
//! After a write that failed the database refuses all others, and whether that write is in the file nobody knows. So the
//! file is opened anew before the next one, and made what the service knows: that is what was acknowledged.

use crate::mission::Mission;
use redb::{Database, ReadableDatabase as _, ReadableTable as _, TableDefinition, TableError};
use std::collections::{BTreeMap, HashSet};
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Mission name → record.
const MISSIONS: TableDefinition<'_, &str, &[u8]> = TableDefinition::new("missions");
/// What the file is.
const ABOUT: TableDefinition<'_, &str, u64> = TableDefinition::new("about");
/// Format of the records; a file with a later one is refused.
const FORMAT: u64 = 1;
/// Memory for pages, bytes: the missions themselves are in memory anyway.
const CACHE: usize = 4 << 20;
/// Opening a file reads all of it. A disk that is full is not tried with every call.
pub const PAUSE: Duration = Duration::from_secs(1);

/// Why the file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum DiskError {
    /// The database.
    #[error("{0}")]
    Database(Box<redb::Error>),
    /// Another process has it.
    #[error("another commander uses it; give each its own --data folder")]
    InUse,
    /// A later version of this program wrote it.
    #[error("its format is {0}, this program knows {FORMAT}; use the program that wrote it, or another --data folder")]
    Format(u64),
    /// A record is damaged.
    #[error("the record of mission '{0}' cannot be read: {1}")]
    Record(String, String),
    /// It failed a moment ago.
    #[error("the last write failed; the file is opened anew at the first change after {PAUSE:?}")]
    Resting,
}

impl<E: Into<redb::Error>> From<E> for DiskError {
    fn from(error: E) -> Self {
        match error.into() {
            redb::Error::DatabaseAlreadyOpen => Self::InUse,
            other => Self::Database(Box::new(other)),
        }
    }
}

/// Opens the database, or makes it.
type Opener = Box<dyn Fn() -> Result<Database, redb::Error> + Send + Sync>;

/// The file.
pub struct Disk {
    opener: Opener,
    /// None after a failure.
    database: Option<Database>,
    /// When it failed last.
    failed: Option<Instant>,
    pause: Duration,
}

impl fmt::Debug for Disk {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Disk").field("database", &self.database).field("failed", &self.failed).finish_non_exhaustive()
    }
}

impl Disk {
    /// Opens the file, or makes it.
    ///
    /// # Errors
    /// A file that cannot be opened, is in use, or is of a later format.
    pub fn open(path: &Path) -> Result<Self, DiskError> {
        let path: PathBuf = path.to_owned();
        let opener = move || Ok(Database::builder().set_cache_size(CACHE).create(&path)?);
        Self::opened_by(Box::new(opener), PAUSE)
    }

    /// The same with any database. After a failure it is opened again, though not within `pause`.
    ///
    /// # Errors
    /// As [`Disk::open`].
    pub fn opened_by(opener: Opener, pause: Duration) -> Result<Self, DiskError> {
        let database = opener()?;
        prepare(&database)?;
        Ok(Self { opener, database: Some(database), failed: None, pause })
    }

    /// All missions, by name.
    ///
    /// # Errors
    /// The file, and a record that cannot be read.
    pub fn load(&self) -> Result<Vec<Mission>, DiskError> {
        let read = self.database.as_ref().ok_or(DiskError::Resting)?.begin_read()?;
        let table = read.open_table(MISSIONS)?;
        let mut missions = Vec::new();
        for row in table.iter()? {
            let (id, record) = row?;
            let damaged = |error: String| DiskError::Record(id.value().to_owned(), error);
            missions.push(Mission::decode(record.value()).map_err(|error| damaged(error.to_string()))?);
        }
        Ok(missions)
    }

    /// Writes and removes missions at once, durably. `kept` is all that was acknowledged.
    ///
    /// # Errors
    /// The file. Then nothing has changed for whoever asks this service, and the file is opened anew before the next change.
    pub fn change(
        &mut self,
        put: &[&Mission],
        remove: &[&str],
        kept: &BTreeMap<String, Arc<Mission>>,
    ) -> Result<(), DiskError> {
        if self.database.is_none() && self.failed.is_some_and(|since| since.elapsed() < self.pause) {
            return Err(DiskError::Resting);
        }
        let changed = self.try_change(put, remove, kept);
        if changed.is_err() {
            // The file is let go of here, so that it can be opened again.
            (self.database, self.failed) = (None, Some(Instant::now()));
        }
        changed
    }

    fn try_change(
        &mut self,
        put: &[&Mission],
        remove: &[&str],
        kept: &BTreeMap<String, Arc<Mission>>,
    ) -> Result<(), DiskError> {
        let database = match self.database.take() {
            Some(database) => database,
            None => {
                let database = (self.opener)()?;
                prepare(&database)?;
                mirror(&database, kept)?;
                database
            }
        };
        write(&database, put, remove)?;
        self.database = Some(database);
        Ok(())
    }
}

fn write(database: &Database, put: &[&Mission], remove: &[&str]) -> Result<(), DiskError> {
    let write = database.begin_write()?;
    {
        let mut table = write.open_table(MISSIONS)?;
        for mission in put {
            table.insert(mission.id(), mission.encode().as_slice())?;
        }
        for id in remove {
            table.remove(*id)?;
        }
    }
    write.commit()?;
    Ok(())
}

/// Makes the tables if there are none. A file that has them is only read: it opens on a full disk, too.
fn prepare(database: &Database) -> Result<(), DiskError> {
    let read = database.begin_read()?;
    let format = match read.open_table(ABOUT) {
        Ok(about) => about.get("format")?.map(|found| found.value()),
        Err(TableError::TableDoesNotExist(_)) => None,
        Err(error) => return Err(error.into()),
    };
    match format {
        Some(FORMAT) => return Ok(()),
        Some(other) => return Err(DiskError::Format(other)),
        None => {}
    }
    let write = database.begin_write()?;
    write.open_table(ABOUT)?.insert("format", FORMAT)?;
    write.open_table(MISSIONS)?;
    write.commit()?;
    Ok(())
}

/// Makes the file what is kept: without a change that was written although it failed, and with everything that was
/// acknowledged even if the file was taken away.
fn mirror(database: &Database, kept: &BTreeMap<String, Arc<Mission>>) -> Result<(), DiskError> {
    let (mut same, mut strange) = (HashSet::new(), Vec::new());
    {
        let read = database.begin_read()?;
        let table = read.open_table(MISSIONS)?;
        for row in table.iter()? {
            let (id, record) = row?;
            match kept.get(id.value()) {
                Some(mission) if mission.encode() == record.value() => drop(same.insert(mission.id())),
                Some(_) => {}
                None => strange.push(id.value().to_owned()),
            }
        }
    }
    let put: Vec<&Mission> = kept.values().map(Arc::as_ref).filter(|mission| !same.contains(mission.id())).collect();
    if put.is_empty() && strange.is_empty() {
        return Ok(());
    }
    write(database, &put, &strange.iter().map(String::as_str).collect::<Vec<_>>())
}
