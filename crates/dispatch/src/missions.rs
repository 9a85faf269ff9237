//! All missions of a service, in memory and optionally on disk, bounded in number and age. Readers never wait for the disk.
//!
//! An update replaces revision r by r + 1 under one lock: it checks that r is still current, writes r + 1 to disk, and shows it
//! to readers. If r has changed, the caller plans again.

use crate::clock::{Clock, Mark, Now};
use crate::disk::{Disk, DiskError, Kept};
use crate::mission::{Mission, MissionLimits};
use magex_proto::v1;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};

/// Limits of the missions of a service.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bounds {
    /// Missions of all owners.
    pub total: usize,
    /// Missions of one owner.
    pub per_owner: usize,
    /// Bytes of all missions on the wire, including their latest changes.
    pub bytes: usize,
    /// Bytes of the missions of one owner.
    pub owner_bytes: usize,
    /// Limits of each mission.
    pub each: MissionLimits,
}

impl Default for Bounds {
    fn default() -> Self {
        let each = MissionLimits { members: 1000, lifetime_ms: 24 * 3_600_000 };
        Self { total: 1000, per_owner: 100, bytes: 256 << 20, owner_bytes: 64 << 20, each }
    }
}

/// Why a mission was not stored.
#[derive(Debug, thiserror::Error)]
pub enum KeepError {
    /// The name is in use.
    #[error("mission_id: mission '{0}' exists; choose another name")]
    Exists(String),
    /// There is no mission of this name.
    #[error("there is no mission '{0}'")]
    Missing(String),
    /// A limit is reached.
    #[error("{0}")]
    Full(String),
    /// It changed concurrently.
    #[error("mission '{id}' is at revision {found}; read it again")]
    Changed {
        /// Its name.
        id: String,
        /// Its revision now.
        found: u64,
    },
    /// The service has stopped.
    #[error("the missions are closed")]
    Closed,
    /// The disk.
    #[error("the missions cannot be written, so nothing was changed: {0}; free space on the disk of --data and retry")]
    Disk(#[from] DiskError),
}

/// The state that only changes use.
#[derive(Debug, Default)]
struct WriteState {
    /// Without a file, missions are lost when the process ends.
    disk: Option<Disk>,
    closed: bool,
    /// Bytes of each mission, of each owner's, and of all.
    sizes: HashMap<String, usize>,
    owners: HashMap<String, usize>,
    bytes: usize,
}

impl WriteState {
    /// Writes a change to the file.
    fn change(&mut self, put: &[&Mission], remove: &[&str], kept: &Kept, clock: &Clock) -> Result<(), KeepError> {
        match &mut self.disk {
            _ if self.closed => Err(KeepError::Closed),
            Some(disk) => {
                disk.set_mark(clock.mark());
                Ok(disk.change(put, remove, kept)?)
            }
            None => Ok(()),
        }
    }

    /// Writes a file again that was removed or replaced.
    fn tend(&mut self, kept: &Kept) -> Result<(), KeepError> {
        self.disk.as_mut().map_or(Ok(()), |disk| Ok(disk.tend(kept)?))
    }

    /// Sets the size of a mission; `None` when it is removed. A mission never changes its owner.
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
    /// Held by a change from its check to the end of its write.
    writing: Mutex<WriteState>,
    /// The limits.
    pub bounds: Bounds,
    /// The clock of their lifetimes.
    pub clock: Clock,
}

impl Missions {
    /// Loads the missions of a file; without a file they are lost when the process ends.
    pub fn open(disk: Option<Disk>, bounds: Bounds) -> Result<Self, DiskError> {
        let loaded = disk.as_ref().map(Disk::load).transpose()?.unwrap_or_default();
        let mark = disk.as_ref().map(Disk::mark).transpose()?.flatten();
        // Without a mark the clock was the time of day, and the last that is known of it are the missions themselves.
        let last = loaded.iter().map(|mission| mission.assignment.updated_ms).max();
        let clock = Clock::resume(mark.or_else(|| Some(Mark { clock_ms: last?, ..Mark::default() })));
        let mut writing = WriteState { disk, ..WriteState::default() };
        loaded.iter().for_each(|mission| writing.resize(mission, Some(mission.bytes())));
        let kept = loaded.into_iter().map(|mission| (mission.id().to_owned(), Arc::new(mission))).collect();
        Ok(Self { kept: RwLock::new(kept), writing: Mutex::new(writing), bounds, clock })
    }

    /// Number of missions.
    pub fn count(&self) -> usize {
        self.read().len()
    }

    /// The mission of this name.
    pub fn get(&self, id: &str) -> Option<Arc<Mission>> {
        self.read().get(id).cloned()
    }

    /// Up to `count` missions after this name that pass the filter, by name.
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

    /// Stores a new mission. Fails if its name is in use, a limit is reached, or the write failed.
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

    /// Whether one more mission of this owner may be stored.
    pub fn check_room(&self, owner: &str) -> Result<(), KeepError> {
        self.room(&self.read(), owner)
    }

    fn room(&self, kept: &Kept, owner: &str) -> Result<(), KeepError> {
        let own = kept.values().filter(|mission| mission.assignment.owner == owner).count();
        let (total, per_owner) = (self.bounds.total, self.bounds.per_owner);
        for (limited, count, most) in [("service", kept.len(), total), ("client", own, per_owner)] {
            if count >= most {
                return Err(KeepError::Full(format!("the {limited} is at its limit of {most} missions; delete some")));
            }
        }
        Ok(())
    }

    /// Stores the successor of the mission's revision `was`. Fails if it was deleted or has another one.
    pub fn replace(&self, mission: Mission, was: u64) -> Result<Arc<Mission>, KeepError> {
        let mut writing = self.lock();
        // Another owner's mission of the same name must look like a missing one.
        match self.get(mission.id()).filter(|now| now.assignment.owner == mission.assignment.owner) {
            None => Err(KeepError::Missing(mission.id().to_owned())),
            Some(now)
                if (now.assignment.revision, now.assignment.created_ms) == (was, mission.assignment.created_ms) =>
            {
                self.put(&mut writing, mission)
            }
            Some(now) => Err(KeepError::Changed { id: mission.id().to_owned(), found: now.assignment.revision }),
        }
    }

    /// Deletes a mission if `may` allows it. Check and deletion are atomic. Without permission the mission seems to be missing.
    pub fn remove(&self, id: &str, may: impl FnOnce(&Mission) -> bool) -> Result<Arc<Mission>, KeepError> {
        let mut writing = self.lock();
        let found = self.get(id).filter(|mission| may(mission));
        let mission = found.ok_or_else(|| KeepError::Missing(id.to_owned()))?;
        writing.change(&[], &[id], &self.read(), &self.clock)?;
        writing.resize(&mission, None);
        self.write().remove(id);
        Ok(mission)
    }

    /// Deletes the missions that have expired, and returns them. Called often: a file that was removed is written again.
    pub fn expire(&self, now: impl Into<Now>) -> Result<Vec<Arc<Mission>>, KeepError> {
        let (mut writing, now) = (self.lock(), now.into());
        let old: Vec<Arc<Mission>> = self.read().values().filter(|mission| mission.expired(&now)).cloned().collect();
        if old.is_empty() {
            writing.tend(&self.read())?;
            return Ok(old);
        }
        let ids: Vec<&str> = old.iter().map(|mission| mission.id()).collect();
        writing.change(&[], &ids, &self.read(), &self.clock)?;
        old.iter().for_each(|mission| writing.resize(mission, None));
        let mut kept = self.write();
        ids.iter().for_each(|id| drop(kept.remove(*id)));
        drop(kept);
        Ok(old)
    }

    /// Writes the clock down, so that after a crash and another boot little is counted twice.
    pub fn note_time(&self) -> Result<(), KeepError> {
        let (mut writing, kept) = (self.lock(), self.read());
        if kept.is_empty() { Ok(()) } else { writing.change(&[], &[], &kept, &self.clock) }
    }

    /// Closes the file; further changes fail.
    pub fn close(&self) {
        // If it cannot be written, missions live a little longer after another boot.
        let _ = self.note_time();
        let mut writing = self.lock();
        (writing.disk, writing.closed) = (None, true);
    }

    fn put(&self, writing: &mut WriteState, mission: Mission) -> Result<Arc<Mission>, KeepError> {
        let size = mission.bytes();
        let before = writing.sizes.get(mission.id()).copied().unwrap_or(0);
        // A mission that does not grow is always accepted, so that a full service can shrink.
        if size > before {
            let (owned, bounds) = (writing.owned(&mission.assignment.owner), &self.bounds);
            for (owner, used, limit) in
                [("one client", owned, bounds.owner_bytes), ("all clients", writing.bytes, bounds.bytes)]
            {
                if used - before + size > limit {
                    let more = size - before;
                    let problem = format!(
                        "the missions of {owner} may take {limit} bytes; {used} are used, and this one needs {more} more; delete some"
                    );
                    return Err(KeepError::Full(problem));
                }
            }
        }
        writing.change(&[&mission], &[], &self.read(), &self.clock)?;
        writing.resize(&mission, Some(size));
        let mission = Arc::new(mission);
        self.write().insert(mission.id().to_owned(), mission.clone());
        Ok(mission)
    }

    // The map changes in one step, so a panic cannot leave it inconsistent.
    fn read(&self) -> RwLockReadGuard<'_, Kept> {
        self.kept.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self) -> RwLockWriteGuard<'_, Kept> {
        self.kept.write().unwrap_or_else(PoisonError::into_inner)
    }

    fn lock(&self) -> MutexGuard<'_, WriteState> {
        self.writing.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Whether a source passes a filter.
pub fn passes(filter: v1::MissionSource, source: v1::MissionSource) -> bool {
    filter == v1::MissionSource::Unspecified || filter == source
}
