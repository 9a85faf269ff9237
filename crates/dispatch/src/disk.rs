//! Missions on disk: one redb file, one row per mission; every change is durable before it is acknowledged.
//!
//! After a failed write the database rejects all further writes, and it is unknown whether the failed write is in the file. So
//! before the next write the file is reopened and made equal to the missions in memory, which are the acknowledged ones. The same
//! happens when the file was removed, moved or replaced: the open one would take writes that no restart finds.

pub(crate) mod data_file;

use crate::clock::Mark;
use crate::mission::Mission;
use data_file::DataFile;
use redb::{Database, ReadableDatabase as _, ReadableTable as _, TableDefinition, TableError};
use std::collections::{BTreeMap, HashSet};
use std::fmt;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Mission name → record.
const MISSIONS: TableDefinition<'_, &str, &[u8]> = TableDefinition::new("missions");
/// Properties of the file.
const ABOUT: TableDefinition<'_, &str, u64> = TableDefinition::new("about");
/// Names of the parts of a [`Mark`] there, in its order.
const MARK: [&str; 4] = ["clock_ms", "boot_ms", "boot", "day_ms"];
/// Format of the records; a file with another one is rejected.
const FORMAT: u64 = 3;
/// Pause after a failed write before the file is reopened: opening reads all of it.
pub const PAUSE: Duration = Duration::from_secs(1);

/// Why the file is unusable.
#[derive(Debug, thiserror::Error)]
pub enum DiskError {
    /// The database.
    #[error("{0}")]
    Database(Box<redb::Error>),
    /// Another process has opened it.
    #[error("another commander uses it; give each commander its own --data folder")]
    InUse,
    /// Another version of this program wrote it.
    #[error("{}; use that version, or another --data folder", other_format(.0))]
    Format(u64),
    /// A record is damaged.
    #[error("the record of mission '{0}' is damaged: {1}")]
    Record(String, String),
    /// Another program removed, moved or replaced the file, again and again.
    #[error("another program removed or replaced the file while it was written")]
    Gone,
    /// The last write failed less than [`PAUSE`] ago.
    #[error("the last write failed; the file is reopened at the first change after {PAUSE:?}")]
    Paused,
}

impl<E: Into<redb::Error>> From<E> for DiskError {
    fn from(error: E) -> Self {
        match error.into() {
            redb::Error::DatabaseAlreadyOpen => Self::InUse,
            other => Self::Database(Box::new(other)),
        }
    }
}

fn other_format(format: &u64) -> String {
    let own = env!("CARGO_PKG_VERSION");
    match format {
        1 => format!("written by magex 0.1.0 (commit 389f705), which reads it; this is magex {own}"),
        2 => format!("written by magex 0.2.0 (commit 3cfb71e or before), which reads it; this is magex {own}"),
        other => format!("its format is {other}; this is magex {own}, which reads format {FORMAT}"),
    }
}

/// All acknowledged missions, by name.
pub(crate) type Kept = BTreeMap<String, Arc<Mission>>;

/// Opens or creates the database.
type Opener = Box<dyn Fn() -> Result<Database, redb::Error> + Send + Sync>;

/// Where the database is.
enum Place {
    File(DataFile),
    Elsewhere(Opener),
}

/// The file.
pub struct Disk {
    place: Place,
    /// `None` after a failed write.
    database: Option<Database>,
    /// Time of the last failed write.
    failed: Option<Instant>,
    pause: Duration,
    /// The clock at the next change.
    mark: Mark,
}

impl Place {
    /// Opens or creates the database, and does `first` to it before anything else.
    fn open(&mut self, first: impl Fn(&Database) -> Result<(), DiskError>) -> Result<Database, DiskError> {
        match self {
            Self::File(file) => file.open(first),
            Self::Elsewhere(opener) => {
                let database = opener()?;
                first(&database)?;
                Ok(database)
            }
        }
    }

    fn is_there(&self) -> bool {
        match self {
            Self::File(file) => file.is_there(),
            Self::Elsewhere(_) => true,
        }
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File(file) => write!(f, "{}", file.path().display()),
            Self::Elsewhere(_) => f.write_str("memory"),
        }
    }
}

impl fmt::Debug for Disk {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Disk").field("database", &self.database).field("failed", &self.failed).finish_non_exhaustive()
    }
}

impl Disk {
    /// Opens or creates the file. Fails if it cannot be opened, is in use, or has another format.
    pub fn open(path: &Path) -> Result<Self, DiskError> {
        Self::at(Place::File(DataFile::new(path)), PAUSE)
    }

    /// The same with any database, which is reopened at the earliest `pause` after a failed write.
    pub fn opened_by(opener: Opener, pause: Duration) -> Result<Self, DiskError> {
        Self::at(Place::Elsewhere(opener), pause)
    }

    fn at(mut place: Place, pause: Duration) -> Result<Self, DiskError> {
        let database = place.open(prepare)?;
        Ok(Self { place, database: Some(database), failed: None, pause, mark: Mark::default() })
    }

    /// All missions, by name. Fails if a record is damaged.
    pub fn load(&self) -> Result<Vec<Mission>, DiskError> {
        let read = self.database.as_ref().ok_or(DiskError::Paused)?.begin_read()?;
        let table = read.open_table(MISSIONS)?;
        let mut missions = Vec::new();
        for row in table.iter()? {
            let (id, record) = row?;
            let damaged = |error: String| DiskError::Record(id.value().to_owned(), error);
            missions.push(Mission::decode(record.value()).map_err(|error| damaged(error.to_string()))?);
        }
        Ok(missions)
    }

    /// The clock at the last change; `None` in a file of a version that did not write it down.
    pub fn mark(&self) -> Result<Option<Mark>, DiskError> {
        let read = self.database.as_ref().ok_or(DiskError::Paused)?.begin_read()?;
        let about = read.open_table(ABOUT)?;
        let mut values = [0; MARK.len()];
        for (name, value) in MARK.iter().zip(&mut values) {
            let Some(found) = about.get(*name)? else { return Ok(None) };
            *value = found.value();
        }
        let [clock, boot_ms, boot, day] = values;
        Ok(Some(Mark { clock_ms: clock as i64, boot_ms: boot_ms as i64, boot, day_ms: day as i64 }))
    }

    /// The clock that the next change writes down.
    pub fn set_mark(&mut self, mark: Mark) {
        self.mark = mark;
    }

    /// Writes and removes missions in one durable transaction. `kept` are all acknowledged missions.
    /// After a failed write nothing has changed for clients, and the file is reopened before the next change.
    pub fn change(&mut self, put: &[&Mission], remove: &[&str], kept: &Kept) -> Result<(), DiskError> {
        self.with_file(kept, |database, mark| write(database, put, remove, mark))
    }

    /// Writes a file that another program removed, moved or replaced again, without waiting for a change.
    pub fn tend(&mut self, kept: &Kept) -> Result<(), DiskError> {
        if self.database.is_some() && !self.place.is_there() { self.with_file(kept, |_, _| Ok(())) } else { Ok(()) }
    }

    /// Runs `action` on the open file, and once more on a new one if it is not the file at the path.
    fn with_file(
        &mut self,
        kept: &Kept,
        action: impl Fn(&Database, &Mark) -> Result<(), DiskError>,
    ) -> Result<(), DiskError> {
        for _ in 0..2 {
            // A failed write drops the database, which closes the file, so that it can be reopened.
            let database = match self.database.take() {
                Some(database) => Ok(database),
                None if self.failed.is_some_and(|since| since.elapsed() < self.pause) => return Err(DiskError::Paused),
                None => self.reopen(kept),
            };
            match database.and_then(|database| action(&database, &self.mark).map(|()| database)) {
                // What was written is there only if the file is.
                Ok(database) if self.place.is_there() => {
                    self.database = Some(database);
                    return Ok(());
                }
                Ok(_) => tracing::error!(
                    file = %self.place, "the file of the missions was removed, moved or replaced; writing all of it again"
                ),
                Err(error) => {
                    self.failed = Some(Instant::now());
                    return Err(error);
                }
            }
        }
        self.failed = Some(Instant::now());
        Err(DiskError::Gone)
    }

    fn reopen(&mut self, kept: &Kept) -> Result<Database, DiskError> {
        let mark = &self.mark;
        self.place.open(|database| {
            prepare(database)?;
            mirror(database, kept, mark)
        })
    }
}

fn write(database: &Database, put: &[&Mission], remove: &[&str], mark: &Mark) -> Result<(), DiskError> {
    let write = database.begin_write()?;
    {
        let mut table = write.open_table(MISSIONS)?;
        for mission in put {
            table.insert(mission.id(), mission.encode().as_slice())?;
        }
        for id in remove {
            table.remove(*id)?;
        }
        let mut about = write.open_table(ABOUT)?;
        let Mark { clock_ms, boot_ms, boot, day_ms } = *mark;
        for (name, value) in MARK.into_iter().zip([clock_ms as u64, boot_ms as u64, boot, day_ms as u64]) {
            about.insert(name, value)?;
        }
    }
    write.commit()?;
    Ok(())
}

/// Creates missing tables. A file that has them is only read, so that it opens on a full disk, too.
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

/// Makes the file equal to `kept`: removes a change that failed but was written, and restores acknowledged missions.
fn mirror(database: &Database, kept: &Kept, mark: &Mark) -> Result<(), DiskError> {
    let (mut same, mut unknown) = (HashSet::new(), Vec::new());
    {
        let read = database.begin_read()?;
        let table = read.open_table(MISSIONS)?;
        for row in table.iter()? {
            let (id, record) = row?;
            match kept.get(id.value()) {
                Some(mission) if mission.encode() == record.value() => drop(same.insert(mission.id())),
                Some(_) => {}
                None => unknown.push(id.value().to_owned()),
            }
        }
    }
    let put: Vec<&Mission> = kept.values().map(Arc::as_ref).filter(|mission| !same.contains(mission.id())).collect();
    if put.is_empty() && unknown.is_empty() {
        return Ok(());
    }
    write(database, &put, &unknown.iter().map(String::as_str).collect::<Vec<_>>(), mark)
}
