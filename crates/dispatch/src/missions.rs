//! All missions of a service: bounded in number and age, in memory, and on disk if there is one. Readers never wait for
//! the disk.

use crate::disk::{Disk, DiskError};
use crate::mission::{Mission, MissionLimits};
use magex_proto::v1;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};

/// How many missions there may be, and how large and old they become.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bounds {
    /// All missions.
    pub total: usize,
    /// Those of one owner.
    pub per_owner: usize,
    /// Size and life of each.
    pub each: MissionLimits,
}

impl Default for Bounds {
    fn default() -> Self {
        let each = MissionLimits { members: 1000, lifetime_ms: 24 * 3_600_000 };
        Self { total: 1000, per_owner: 100, each }
    }
}

/// Why a mission was not kept.
#[derive(Debug, thiserror::Error)]
pub enum KeepError {
    /// The name is taken.
    #[error("mission '{0}' exists")]
    Exists(String),
    /// There is none of this name.
    #[error("there is no mission '{0}'")]
    Missing(String),
    /// Too many.
    #[error("{0}")]
    Full(String),
    /// Somebody else changed it meanwhile.
    #[error("mission '{id}' is at revision {found}")]
    Changed {
        /// Its name.
        id: String,
        /// Its revision now.
        found: u64,
    },
    /// The service has ended.
    #[error("the missions are closed")]
    Closed,
    /// The disk.
    #[error("the missions cannot be written: {0}")]
    Disk(#[from] DiskError),
}

/// Where changes go.
#[derive(Debug)]
enum Journal {
    /// Nowhere: missions live as long as the process.
    Memory,
    Disk(Disk),
    Closed,
}

impl Journal {
    fn change(&self, put: &[&Mission], remove: &[&str]) -> Result<(), KeepError> {
        match self {
            Self::Memory => Ok(()),
            Self::Disk(disk) => Ok(disk.change(put, remove)?),
            Self::Closed => Err(KeepError::Closed),
        }
    }
}

/// The missions.
#[derive(Debug)]
pub struct Missions {
    kept: RwLock<BTreeMap<String, Arc<Mission>>>,
    /// Held by whoever changes something, from the check to the end of the write.
    writing: Mutex<Journal>,
    bounds: Bounds,
}

impl Missions {
    /// Those on disk, if there is one; without it they live as long as the process.
    ///
    /// # Errors
    /// The disk.
    pub fn open(disk: Option<Disk>, bounds: Bounds) -> Result<Self, DiskError> {
        let loaded = disk.as_ref().map(Disk::load).transpose()?.unwrap_or_default();
        let kept = loaded.into_iter().map(|mission| (mission.id().to_owned(), Arc::new(mission))).collect();
        let writing = Mutex::new(disk.map_or(Journal::Memory, Journal::Disk));
        Ok(Self { kept: RwLock::new(kept), writing, bounds })
    }

    /// The bounds in force.
    pub fn bounds(&self) -> &Bounds {
        &self.bounds
    }

    /// The mission of this name.
    pub fn get(&self, id: &str) -> Option<Arc<Mission>> {
        self.read().get(id).cloned()
    }

    /// Up to `count` missions after this name that pass, by name.
    pub fn page(&self, after: &str, count: usize, pass: impl Fn(&Mission) -> bool) -> Vec<Arc<Mission>> {
        let beyond = (std::ops::Bound::Excluded(after), std::ops::Bound::Unbounded);
        self.read()
            .range::<str, _>(beyond)
            .map(|(_, mission)| mission)
            .filter(|m| pass(m))
            .take(count)
            .cloned()
            .collect()
    }

    /// Keeps a new mission.
    ///
    /// # Errors
    /// Its name is taken, there are too many, or the disk.
    pub fn insert(&self, mission: Mission) -> Result<Arc<Mission>, KeepError> {
        let journal = self.lock();
        {
            let kept = self.read();
            if kept.contains_key(mission.id()) {
                return Err(KeepError::Exists(mission.id().to_owned()));
            }
            self.room(&kept, &mission.assignment.owner)?;
        }
        self.put(&journal, mission)
    }

    /// Whether one more mission of this owner may be kept.
    ///
    /// # Errors
    /// [`KeepError::Full`].
    pub fn check_room(&self, owner: &str) -> Result<(), KeepError> {
        self.room(&self.read(), owner)
    }

    fn room(&self, kept: &BTreeMap<String, Arc<Mission>>, owner: &str) -> Result<(), KeepError> {
        if kept.len() >= self.bounds.total {
            return Err(KeepError::Full(format!("the service keeps {} missions; delete some", self.bounds.total)));
        }
        let own = kept.values().filter(|mission| mission.assignment.owner == owner).count();
        if own >= self.bounds.per_owner {
            return Err(KeepError::Full(format!(
                "a client has at most {} missions; delete some",
                self.bounds.per_owner
            )));
        }
        Ok(())
    }

    /// Keeps the successor of the mission's revision `was`.
    ///
    /// # Errors
    /// It is gone or has another revision, or the disk.
    pub fn replace(&self, mission: Mission, was: u64) -> Result<Arc<Mission>, KeepError> {
        let journal = self.lock();
        match self.get(mission.id()) {
            None => return Err(KeepError::Missing(mission.id().to_owned())),
            Some(now)
                if now.assignment.revision != was || now.assignment.created_ms != mission.assignment.created_ms =>
            {
                return Err(KeepError::Changed { id: mission.id().to_owned(), found: now.assignment.revision });
            }
            Some(_) => {}
        }
        self.put(&journal, mission)
    }

    /// Forgets a mission.
    ///
    /// # Errors
    /// There is none, or the disk.
    pub fn remove(&self, id: &str) -> Result<Arc<Mission>, KeepError> {
        let journal = self.lock();
        let mission = self.get(id).ok_or_else(|| KeepError::Missing(id.to_owned()))?;
        journal.change(&[], &[id])?;
        self.write().remove(id);
        Ok(mission)
    }

    /// Forgets missions whose time is over at `now` (milliseconds since 1970), and returns them.
    ///
    /// # Errors
    /// The disk.
    pub fn expire(&self, now: i64) -> Result<Vec<Arc<Mission>>, KeepError> {
        let journal = self.lock();
        let old: Vec<Arc<Mission>> =
            self.read().values().filter(|mission| mission.assignment.expires_ms <= now).cloned().collect();
        if old.is_empty() {
            return Ok(old);
        }
        let ids: Vec<&str> = old.iter().map(|mission| mission.id()).collect();
        journal.change(&[], &ids)?;
        let mut kept = self.write();
        ids.iter().for_each(|id| drop(kept.remove(*id)));
        drop(kept);
        Ok(old)
    }

    /// Lets go of the disk. Nothing changes any more.
    pub fn close(&self) {
        *self.lock() = Journal::Closed;
    }

    fn put(&self, journal: &Journal, mission: Mission) -> Result<Arc<Mission>, KeepError> {
        journal.change(&[&mission], &[])?;
        let mission = Arc::new(mission);
        self.write().insert(mission.id().to_owned(), mission.clone());
        Ok(mission)
    }

    // A thread that died between two steps left nothing half done: the map changes in one step.
    fn read(&self) -> RwLockReadGuard<'_, BTreeMap<String, Arc<Mission>>> {
        self.kept.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self) -> RwLockWriteGuard<'_, BTreeMap<String, Arc<Mission>>> {
        self.kept.write().unwrap_or_else(PoisonError::into_inner)
    }

    fn lock(&self) -> MutexGuard<'_, Journal> {
        self.writing.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Whether a filter of sources lets one through.
pub fn passes(filter: v1::MissionSource, source: v1::MissionSource) -> bool {
    filter == v1::MissionSource::Unspecified || filter == source
}
