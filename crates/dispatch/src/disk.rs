//! Missions on disk: one redb file, one row per mission, every change durable before it is answered.

use crate::mission::Mission;
use redb::{Database, ReadableDatabase as _, ReadableTable as _, TableDefinition};
use std::path::Path;

/// Mission name → record.
const MISSIONS: TableDefinition<'_, &str, &[u8]> = TableDefinition::new("missions");
/// What the file is.
const ABOUT: TableDefinition<'_, &str, u64> = TableDefinition::new("about");
/// Format of the records; a file with a later one is refused.
const FORMAT: u64 = 1;
/// Memory for pages, bytes: the missions themselves are in memory anyway.
const CACHE: usize = 4 << 20;

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
}

impl<E: Into<redb::Error>> From<E> for DiskError {
    fn from(error: E) -> Self {
        match error.into() {
            redb::Error::DatabaseAlreadyOpen => Self::InUse,
            other => Self::Database(Box::new(other)),
        }
    }
}

/// An open file.
#[derive(Debug)]
pub struct Disk {
    database: Database,
}

impl Disk {
    /// Opens the file, or makes it.
    ///
    /// # Errors
    /// A file that cannot be opened, is in use, or is of a later format.
    pub fn open(path: &Path) -> Result<Self, DiskError> {
        let database = Database::builder().set_cache_size(CACHE).create(path)?;
        let write = database.begin_write()?;
        {
            let mut about = write.open_table(ABOUT)?;
            let format = about.get("format")?.map(|found| found.value());
            match format {
                None => drop(about.insert("format", FORMAT)?),
                Some(FORMAT) => {}
                Some(other) => return Err(DiskError::Format(other)),
            }
            write.open_table(MISSIONS)?;
        }
        write.commit()?;
        Ok(Self { database })
    }

    /// All missions, by name.
    ///
    /// # Errors
    /// The file, and a record that cannot be read.
    pub fn load(&self) -> Result<Vec<Mission>, DiskError> {
        let read = self.database.begin_read()?;
        let table = read.open_table(MISSIONS)?;
        let mut missions = Vec::new();
        for row in table.iter()? {
            let (id, record) = row?;
            let damaged = |error: String| DiskError::Record(id.value().to_owned(), error);
            missions.push(Mission::decode(record.value()).map_err(|error| damaged(error.to_string()))?);
        }
        Ok(missions)
    }

    /// Writes and removes missions at once, durably.
    ///
    /// # Errors
    /// The file; then nothing has changed.
    pub fn change(&self, put: &[&Mission], remove: &[&str]) -> Result<(), DiskError> {
        let write = self.database.begin_write()?;
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
}
