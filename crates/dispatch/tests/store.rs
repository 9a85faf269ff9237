//! Limits of missions in bytes, and their file: a failed write loses no acknowledged mission, and writing resumes once possible.

#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stderr, reason = "helpers of tests")]

use magex_dispatch::answer::Planned;
use magex_dispatch::disk::{Disk, DiskError, PAUSE};
use magex_dispatch::engine;
use magex_dispatch::mission::{Mission, MissionLimits};
use magex_dispatch::missions::{Bounds, KeepError, Missions};
use magex_dispatch::{AssignError, Problem};
use magex_proto::v1;
use redb::{Database, StorageBackend};
use std::collections::BTreeMap;
use std::io;
use std::process::Command;
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

const LIMITS: MissionLimits = MissionLimits { members: 100, lifetime_ms: 60_000 };

fn planner(problem: &Problem) -> Result<Planned, AssignError> {
    let plan = engine::solve(problem, problem.scheduler, &|| true)?;
    Ok(Planned { plan, fallback_reason: String::new(), weights: None })
}

fn member(id: &str, x: f64) -> v1::Member {
    v1::Member { id: id.into(), position: vec![x, 0.0], ..Default::default() }
}

fn make(id: &str, owner: &str) -> Mission {
    let request = v1::CreateMissionRequest {
        mission_id: id.into(),
        agents: vec![member("a", 0.0), member("b", 10.0)],
        goals: vec![member("x", 1.0), member("y", 11.0)],
        ..Default::default()
    };
    Mission::create(request, owner, "", 1000, &LIMITS, &planner).unwrap()
}

fn update(mission: &Mission, request: v1::UpdateMissionRequest) -> Mission {
    mission.update(request, 2000, &LIMITS, &planner).unwrap()
}

fn full(result: Result<Arc<Mission>, KeepError>) -> String {
    match result {
        Err(KeepError::Full(text)) => text,
        other => panic!("{other:?}"),
    }
}

#[test]
fn one_owner_leaves_room_for_others() {
    let one = make("1", "me").bytes();
    let missions = Missions::open(None, Bounds { owner_bytes: 2 * one, ..Bounds::default() }).unwrap();
    missions.insert(make("1", "me")).unwrap();
    let second = missions.insert(make("2", "me")).unwrap();
    let text = full(missions.insert(make("3", "me")));
    assert!(text.contains(&format!("one client may take {} bytes", 2 * one)), "{text}");
    // A mission does not grow beyond what it could have been made with, either.
    let more: Vec<_> = (0..50).map(|k| member(&format!("more{k}"), k as f64)).collect();
    let larger = update(&second, v1::UpdateMissionRequest { agents: more, ..Default::default() });
    assert!(full(missions.replace(larger, 1)).contains("one client"));
    missions.insert(make("3", "you")).unwrap();
    // What goes makes room, whichever way it goes.
    missions.remove("1", |_| true).unwrap();
    missions.insert(make("4", "me")).unwrap();
    assert_eq!(missions.expire(61_000).unwrap().len(), 3);
    missions.insert(make("5", "me")).unwrap();
    missions.insert(make("6", "me")).unwrap();
}

#[test]
fn what_changed_last_counts() {
    // Nothing changed with the last update: what the next one says about every agent is new.
    let quiet = update(&make("1", "me"), v1::UpdateMissionRequest::default());
    assert!(quiet.assignment.changes.is_empty());
    let missions = Missions::open(None, Bounds { owner_bytes: quiet.bytes(), ..Bounds::default() }).unwrap();
    let kept = missions.insert(quiet).unwrap();
    let crossed = v1::UpdateMissionRequest { agents: vec![member("a", 10.0), member("b", 0.0)], ..Default::default() };
    let next = update(&kept, crossed);
    assert_eq!((next.size(), next.assignment.changes.len()), (kept.size(), 2));
    assert!(full(missions.replace(next, 2)).contains("one client"));
}

/// A disk in memory that accepts a number of writes and then fails until there is room.
#[derive(Debug, Default)]
struct Small {
    bytes: Mutex<Vec<u8>>,
    left: AtomicI64,
}

impl Small {
    fn room(&self, writes: i64) {
        self.left.store(writes, Ordering::SeqCst);
    }

    fn take(&self) -> io::Result<()> {
        match self.left.fetch_sub(1, Ordering::SeqCst) {
            left if left > 0 => Ok(()),
            _ => Err(io::Error::from(io::ErrorKind::StorageFull)),
        }
    }

    fn open(disk: &Arc<Self>) -> Result<Disk, DiskError> {
        let backend = disk.clone();
        let opener = move || Ok(Database::builder().create_with_backend(Backend(backend.clone()))?);
        Disk::opened_by(Box::new(opener), Duration::ZERO)
    }
}

#[derive(Debug)]
struct Backend(Arc<Small>);

impl StorageBackend for Backend {
    fn len(&self) -> io::Result<u64> {
        Ok(self.0.bytes.lock().unwrap().len() as u64)
    }

    fn read(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
        let bytes = self.0.bytes.lock().unwrap();
        let from = offset as usize;
        out.copy_from_slice(bytes.get(from..from + out.len()).ok_or(io::ErrorKind::UnexpectedEof)?);
        Ok(())
    }

    fn set_len(&self, len: u64) -> io::Result<()> {
        self.0.take()?;
        self.0.bytes.lock().unwrap().resize(len as usize, 0);
        Ok(())
    }

    fn sync_data(&self) -> io::Result<()> {
        // The data is written all the same: whether a commit that failed here happened is unknown.
        self.0.take()
    }

    fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        self.0.take()?;
        self.0.bytes.lock().unwrap()[offset as usize..][..data.len()].copy_from_slice(data);
        Ok(())
    }
}

/// What another process finds in the file as it is now.
fn found(disk: &Small) -> BTreeMap<String, Mission> {
    let copy = Small { bytes: Mutex::new(disk.bytes.lock().unwrap().clone()), left: AtomicI64::new(i64::MAX) };
    let missions = Small::open(&Arc::new(copy)).unwrap().load().unwrap();
    missions.into_iter().map(|mission| (mission.id().to_owned(), mission)).collect()
}

fn known(missions: &Missions) -> BTreeMap<String, Mission> {
    let all = missions.page("", 10_000, |_| true);
    all.into_iter().map(|mission| (mission.id().to_owned(), Mission::clone(&mission))).collect()
}

#[test]
fn a_full_disk_loses_nothing_and_works_again_when_there_is_room() {
    let (mut failures, mut unharmed) = (0, 0);
    // Full after every single write that there is.
    for writes in 0.. {
        let disk = Arc::new(Small::default());
        disk.room(i64::MAX);
        let missions = Missions::open(Some(Small::open(&disk).unwrap()), Bounds::default()).unwrap();
        let kept = missions.insert(make("kept", "me")).unwrap();
        missions.insert(make("gone", "me")).unwrap();
        disk.room(writes);
        let moved = v1::UpdateMissionRequest { agents: vec![member("a", 3.0)], ..Default::default() };
        let results = [
            missions.insert(make("new", "me")).map(drop),
            missions.replace(update(&kept, moved), 1).map(drop),
            missions.remove("gone", |_| true).map(drop),
        ];
        let failed = results.iter().filter(|result| matches!(result, Err(KeepError::Disk(_)))).count();
        assert_eq!(results.iter().filter(|result| result.is_err()).count(), failed, "{results:?}");
        failures += failed;
        // What was acknowledged can be asked for meanwhile.
        let now = known(&missions);
        assert_eq!(now.contains_key("new"), results[0].is_ok());
        assert_eq!(now["kept"].assignment.revision, if results[1].is_ok() { 2 } else { 1 });
        assert_eq!(now.contains_key("gone"), results[2].is_err());
        // A kill at this moment leaves what was acknowledged; the call that failed may have come through.
        let crashed = found(&disk);
        assert!(crashed["kept"].assignment.revision >= now["kept"].assignment.revision, "after {writes} writes");
        assert!(crashed.contains_key("new") || results[0].is_err(), "after {writes} writes");
        disk.room(i64::MAX);
        missions.insert(make("late", "me")).unwrap();
        assert_eq!(found(&disk), known(&missions), "after {writes} writes");
        unharmed += usize::from(failed == 0);
        if unharmed == 3 {
            break;
        }
    }
    assert!(failures > 10, "{failures} failures: the disk was never full");
}

#[test]
fn a_disk_that_failed_is_not_tried_with_every_call() {
    let disk = Arc::new(Small::default());
    disk.room(i64::MAX);
    let backend = disk.clone();
    let opener = move || Ok(Database::builder().create_with_backend(Backend(backend.clone()))?);
    let pause = Duration::from_secs(3600);
    let missions = Missions::open(Some(Disk::opened_by(Box::new(opener), pause).unwrap()), Bounds::default()).unwrap();
    disk.room(0);
    let Err(KeepError::Disk(DiskError::Database(_))) = missions.insert(make("1", "me")) else { panic!("no failure") };
    disk.room(i64::MAX);
    let Err(resting) = missions.insert(make("1", "me")) else { panic!("tried at once") };
    assert!(matches!(resting, KeepError::Disk(DiskError::Paused)) && resting.to_string().contains("free space"));
}

#[test]
fn a_file_that_was_taken_away_is_written_again() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("missions.redb");
    let failing = Arc::new(AtomicI64::new(1));
    let (file, first) = (path.clone(), failing.clone());
    // The first one that is opened is a disk that fails; the next is the file.
    let opener = move || match first.swap(0, Ordering::SeqCst) {
        1 => {
            let disk = Small::default();
            disk.room(40);
            Ok(Database::builder().create_with_backend(Backend(Arc::new(disk)))?)
        }
        _ => Ok(Database::builder().create(&file)?),
    };
    let disk = Disk::opened_by(Box::new(opener), Duration::ZERO).unwrap();
    let missions = Missions::open(Some(disk), Bounds::default()).unwrap();
    let mut made = Vec::new();
    while let Ok(mission) = missions.insert(make(&format!("m{}", made.len()), "me")) {
        made.push(mission);
        assert!(made.len() < 50, "the disk never failed");
    }
    assert!(!made.is_empty());
    missions.insert(make("late", "me")).unwrap();
    let all = known(&missions);
    missions.close();
    let on_disk = Disk::open(&path).unwrap().load().unwrap();
    assert_eq!(on_disk.len(), made.len() + 1);
    assert!(on_disk.iter().all(|mission| all[mission.id()] == *mission));
}

/// Every way in which another program takes the file away: after each, the next change is on disk with all that was acknowledged.
#[test]
fn a_removed_moved_or_replaced_file_is_noticed_with_the_next_change() {
    let place = tempfile::tempdir().unwrap();
    let (folder, away) = (place.path().join("data"), place.path().join("away"));
    let path = folder.join("missions.redb");
    std::fs::create_dir(&folder).unwrap();
    let missions = Missions::open(Some(Disk::open(&path).unwrap()), Bounds::default()).unwrap();
    missions.insert(make("kept", "me")).unwrap();
    std::fs::copy(&path, place.path().join("backup")).unwrap();
    let ways: [(&str, &dyn Fn()); 5] = [
        ("the file is removed", &|| std::fs::remove_file(&path).unwrap()),
        ("the folder is removed", &|| std::fs::remove_dir_all(&folder).unwrap()),
        ("the folder is moved", &|| std::fs::rename(&folder, &away).unwrap()),
        ("a backup is moved there", &|| std::fs::rename(place.path().join("backup"), &path).unwrap()),
        ("something else is there", &|| {
            std::fs::remove_file(&path).unwrap();
            std::fs::write(&path, "no database").unwrap();
        }),
    ];
    for (number, (what, way)) in ways.into_iter().enumerate() {
        way();
        missions.insert(make(&format!("m{number}"), "me")).unwrap_or_else(|error| panic!("{what}: {error}"));
        // As after a kill at this moment.
        let copy = place.path().join("copy");
        std::fs::copy(&path, &copy).unwrap();
        let on_disk = Disk::open(&copy).unwrap().load().unwrap();
        assert_eq!(on_disk.len(), number + 2, "{what}");
        std::fs::remove_file(copy).unwrap();
    }
    // What was in the way is kept: the backup can still be read.
    let backup = Disk::open(&folder.join("missions.redb.found-1")).unwrap().load().unwrap();
    assert_eq!(backup.len(), 1);
    assert_eq!(std::fs::read_to_string(folder.join("missions.redb.found-2")).unwrap(), "no database");
    // Without a change, the sweep notices.
    std::fs::remove_dir_all(&folder).unwrap();
    assert!(missions.expire(1000).unwrap().is_empty());
    assert!(path.exists());
    // Where nothing can be written, nothing is acknowledged, until it can.
    std::fs::remove_dir_all(&folder).unwrap();
    std::fs::write(&folder, "a file in the way").unwrap();
    let error = missions.insert(make("late", "me")).unwrap_err();
    assert!(matches!(error, KeepError::Disk(DiskError::Database(_))), "{error}");
    assert!(missions.get("late").is_none());
    std::fs::remove_file(&folder).unwrap();
    std::thread::sleep(PAUSE);
    missions.insert(make("late", "me")).unwrap();
    missions.close();
    assert_eq!(Disk::open(&path).unwrap().load().unwrap().len(), 7);
}

#[test]
fn a_file_that_another_commander_uses_is_not_taken_from_it() {
    let place = tempfile::tempdir().unwrap();
    let (own, other) = (place.path().join("own.redb"), place.path().join("other.redb"));
    let missions = Missions::open(Some(Disk::open(&own).unwrap()), Bounds::default()).unwrap();
    let theirs = Missions::open(Some(Disk::open(&other).unwrap()), Bounds::default()).unwrap();
    std::fs::rename(&other, &own).unwrap();
    let error = missions.insert(make("1", "me")).unwrap_err();
    assert!(matches!(error, KeepError::Disk(DiskError::InUse)), "{error}");
    // The other one's file is gone from its path, so it is written there again.
    theirs.insert(make("2", "you")).unwrap();
    std::thread::sleep(PAUSE);
    missions.insert(make("1", "me")).unwrap();
    missions.close();
    theirs.close();
    let names = |path| Disk::open(path).unwrap().load().unwrap().iter().map(|m| m.id().to_owned()).collect::<Vec<_>>();
    assert_eq!((names(&own), names(&other)), (vec!["1".to_owned()], vec!["2".to_owned()]));
}

/// A small file system; unmounted when dropped.
struct Mounted(tempfile::TempDir);

impl Drop for Mounted {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(self.0.path()).status();
    }
}

#[test]
fn a_real_disk_that_was_full_is_used_again() {
    let folder = tempfile::tempdir().unwrap();
    let mount = Command::new("mount").args(["-t", "tmpfs", "-o", "size=4m", "magex-test"]).arg(folder.path()).status();
    if !mount.is_ok_and(|status| status.success()) {
        assert!(
            std::env::var_os("MAGEX_CI_MOUNT").is_none(),
            "a small file system cannot be mounted, and must be here"
        );
        eprintln!("NOT CHECKED: a full disk below the missions; this user cannot mount a small file system");
        return;
    }
    let disk = Mounted(folder);
    let (path, ballast) = (disk.0.path().join("missions.redb"), disk.0.path().join("ballast"));
    let bounds = Bounds { total: 10_000, ..Bounds::default() };
    let missions = Missions::open(Some(Disk::open(&path).unwrap()), bounds).unwrap();
    missions.insert(make("first", "me")).unwrap();
    let mut file = std::fs::File::create(&ballast).unwrap();
    while io::Write::write_all(&mut file, &[0; 4096]).is_ok() {}
    drop(file);
    // The file has some room inside: it is full when it has to grow.
    let mut many = (0..5000).map(|k| missions.insert(make(&format!("m{k}"), &format!("owner{k}"))));
    let failure = many.find_map(Result::err).unwrap();
    assert!(matches!(failure, KeepError::Disk(_)), "{failure}");
    std::thread::sleep(PAUSE);
    let failure = missions.insert(make("still-full", "me")).unwrap_err();
    assert!(matches!(failure, KeepError::Disk(DiskError::Database(_))), "{failure}");
    let before = known(&missions);
    std::fs::remove_file(&ballast).unwrap();
    std::thread::sleep(PAUSE);
    missions.remove("first", |_| true).unwrap();
    missions.insert(make("late", "me")).unwrap();
    let after = known(&missions);
    assert!(after.len() == before.len() && after.contains_key("late"));
    missions.close();
    let on_disk = Disk::open(&path).unwrap().load().unwrap();
    assert_eq!(on_disk.into_iter().map(|m| (m.id().to_owned(), m)).collect::<BTreeMap<_, _>>(), after);
}

#[test]
fn a_file_of_an_older_format_is_rejected_with_the_version_that_reads_it() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("missions.redb");
    for (format, version) in [(1, "0.1.0 (commit 389f705)"), (2, "0.2.0 (commit 3cfb71e or before)")] {
        let about = redb::TableDefinition::<&str, u64>::new("about");
        let write = Database::create(&path).unwrap().begin_write().unwrap();
        write.open_table(about).unwrap().insert("format", format).unwrap();
        write.commit().unwrap();
        let error = Disk::open(&path).unwrap_err().to_string();
        assert!(error.starts_with(&format!("written by magex {version}, which reads it; this is magex ")), "{error}");
        assert!(error.ends_with("--data folder"), "{error}");
    }
}
