//! All missions of a service: bounded in number and age, in memory, and on disk if there is one. Readers never wait for
//! the disk.

use crate::disk::{Disk, DiskError};
use crate::mission::{Mission, MissionLimits};
use magex_proto::v1;
use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};

/// How many missions there may be, and how large and old they become.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bounds {
    /// All missions.
    pub total: usize,
    /// Those of one owner.
    pub per_owner: usize,
    /// Bytes of all missions, as they are on the wire, with what changed last.
    pub bytes: usize,
    /// Bytes of one owner's: nobody takes all of them alone.
    pub owner_bytes: usize,
    /// Size and life of each.
    pub each: MissionLimits,
}

impl Default for Bounds {
    fn default() -> Self {
        let each = MissionLimits { members: 1000, lifetime_ms: 24 * 3_600_000 };
        Self { total: 1000, per_owner: 100, bytes: 256 << 20, owner_bytes: 64 << 20, each }
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
    #[error(
        "the missions cannot be written, so nothing was changed: {0}; make room on the disk of --data and try again"
    )]
    Disk(#[from] DiskError),
}

/// By name.
type Kept = BTreeMap<String, Arc<Mission>>;

/// Where changes go.
#[derive(Debug)]
enum Journal {
    /// Nowhere: missions live as long as the process.
    Memory,
    Disk(Disk),
    Closed,
}

impl Journal {
    fn change(&mut self, put: &[&Mission], remove: &[&str], kept: &Kept) -> Result<(), KeepError> {
        match self {
            Self::Memory => Ok(()),
            Self::Disk(disk) => Ok(disk.change(put, remove, kept)?),
            Self::Closed => Err(KeepError::Closed),
        }
    }
}

/// What only a change needs.
#[derive(Debug)]
struct Writing {
    journal: Journal,
    /// Bytes of each mission, of each owner's, and of all.
    sizes: HashMap<String, usize>,
    owners: HashMap<String, usize>,
    bytes: usize,
}

impl Writing {
    /// Counts a mission; `None` when it is gone. A mission never changes its owner.
    fn resize(&mut self, mission: &Mission, size: Option<usize>) {
        let (id, owner) = (mission.id(), mission.assignment.owner.as_str());
        let before = match size {
            Some(size) => self.sizes.insert(id.to_owned(), size),
            None => self.sizes.remove(id),
        };
        let (before, after) = (before.unwrap_or(0), size.unwrap_or(0));
        let owned = self.owned(owner) - before + after;
        match owned {
            0 => self.owners.remove(owner),
            _ => self.owners.insert(owner.to_owned(), owned),
        };
        self.bytes = self.bytes - before + after;
    }

    fn owned(&self, owner: &str) -> usize {
        self.owners.get(owner).copied().unwrap_or(0)
    }
}

/// The missions.
#[derive(Debug)]
pub struct Missions {
    kept: RwLock<Kept>,
    /// Held by whoever changes something, from the check to the end of the write.
    writing: Mutex<Writing>,
    bounds: Bounds,
}

impl Missions {
    /// Those on disk, if there is one; without it they live as long as the process.
    ///
    /// # Errors
    /// The disk.
    pub fn open(disk: Option<Disk>, bounds: Bounds) -> Result<Self, DiskError> {
        let loaded = disk.as_ref().map(Disk::load).transpose()?.unwrap_or_default();
        let journal = disk.map_or(Journal::Memory, Journal::Disk);
        let mut writing = Writing { journal, sizes: HashMap::new(), owners: HashMap::new(), bytes: 0 };
        loaded.iter().for_each(|mission| writing.resize(mission, Some(mission.bytes())));
        let kept = loaded.into_iter().map(|mission| (mission.id().to_owned(), Arc::new(mission))).collect();
        Ok(Self { kept: RwLock::new(kept), writing: Mutex::new(writing), bounds })
    }

    /// How many there are.
    pub fn count(&self) -> usize {
        self.kept.read().unwrap_or_else(PoisonError::into_inner).len()
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
        let mut writing = self.lock();
        {
            let kept = self.read();
            if kept.contains_key(mission.id()) {
                return Err(KeepError::Exists(mission.id().to_owned()));
            }
            self.room(&kept, &mission.assignment.owner)?;
        }
        self.put(&mut writing, mission)
    }

    /// Whether one more mission of this owner may be kept.
    ///
    /// # Errors
    /// [`KeepError::Full`].
    pub fn check_room(&self, owner: &str) -> Result<(), KeepError> {
        self.room(&self.read(), owner)
    }

    fn room(&self, kept: &Kept, owner: &str) -> Result<(), KeepError> {
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
        let mut writing = self.lock();
        // Somebody else's that has taken the name meanwhile is none of this owner's business, not even that it is there.
        match self.get(mission.id()).filter(|now| now.assignment.owner == mission.assignment.owner) {
            None => return Err(KeepError::Missing(mission.id().to_owned())),
            Some(now)
                if now.assignment.revision != was || now.assignment.created_ms != mission.assignment.created_ms =>
            {
                return Err(KeepError::Changed { id: mission.id().to_owned(), found: now.assignment.revision });
            }
            Some(_) => {}
        }
        self.put(&mut writing, mission)
    }

    /// Forgets a mission, if it is one that `may` be forgotten: looked at and removed in one step, so that what is removed
    /// is what was looked at.
    ///
    /// # Errors
    /// There is none, or it may not (which is told as if there were none), or the disk.
    pub fn remove(&self, id: &str, may: impl FnOnce(&Mission) -> bool) -> Result<Arc<Mission>, KeepError> {
        let mut writing = self.lock();
        let found = self.get(id).filter(|mission| may(mission));
        let mission = found.ok_or_else(|| KeepError::Missing(id.to_owned()))?;
        writing.journal.change(&[], &[id], &self.read())?;
        writing.resize(&mission, None);
        self.write().remove(id);
        Ok(mission)
    }

    /// Forgets missions whose time is over at `now` (milliseconds since 1970), and returns them.
    ///
    /// # Errors
    /// The disk.
    pub fn expire(&self, now: i64) -> Result<Vec<Arc<Mission>>, KeepError> {
        let mut writing = self.lock();
        let old: Vec<Arc<Mission>> =
            self.read().values().filter(|mission| mission.assignment.expires_ms <= now).cloned().collect();
        if old.is_empty() {
            return Ok(old);
        }
        let ids: Vec<&str> = old.iter().map(|mission| mission.id()).collect();
        writing.journal.change(&[], &ids, &self.read())?;
        old.iter().for_each(|mission| writing.resize(mission, None));
        let mut kept = self.write();
        ids.iter().for_each(|id| drop(kept.remove(*id)));
        drop(kept);
        Ok(old)
    }

    /// Lets go of the disk. Nothing changes any more.
    pub fn close(&self) {
        self.lock().journal = Journal::Closed;
    }

    fn put(&self, writing: &mut Writing, mission: Mission) -> Result<Arc<Mission>, KeepError> {
        let size = mission.bytes();
        let before = writing.sizes.get(mission.id()).copied().unwrap_or(0);
        // One that does not grow is always taken: it is how a full service gets smaller.
        if size > before {
            let (owned, bounds) = (writing.owned(&mission.assignment.owner), &self.bounds);
            for (whose, taken, most) in
                [("one client", owned, bounds.owner_bytes), ("all clients", writing.bytes, bounds.bytes)]
            {
                if taken - before + size > most {
                    let more = size - before;
                    let problem = format!(
                        "the missions of {whose} may take {most} bytes; they take {taken}, and this would be {more} more; delete some"
                    );
                    return Err(KeepError::Full(problem));
                }
            }
        }
        writing.journal.change(&[&mission], &[], &self.read())?;
        writing.resize(&mission, Some(size));
        let mission = Arc::new(mission);
        self.write().insert(mission.id().to_owned(), mission.clone());
        Ok(mission)
    }

    // A thread that died between two steps left nothing half done: the map changes in one step.
    fn read(&self) -> RwLockReadGuard<'_, Kept> {
        self.kept.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self) -> RwLockWriteGuard<'_, Kept> {
        self.kept.write().unwrap_or_else(PoisonError::into_inner)
    }

    fn lock(&self) -> MutexGuard<'_, Writing> {
        self.writing.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Whether a filter of sources lets one through.
pub fn passes(filter: v1::MissionSource, source: v1::MissionSource) -> bool {
    filter == v1::MissionSource::Unspecified || filter == source
}
