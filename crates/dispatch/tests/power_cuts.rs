//! A power cut at any moment of writing missions: whatever the disk forgot of what was not synced, the file opens, and holds the
//! acknowledged missions, with or without the change that was not answered yet.

#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests")]

use magex_core::rng::{Key, Purpose, Stream};
use magex_dispatch::answer::Planned;
use magex_dispatch::disk::{Disk, DiskError};
use magex_dispatch::engine;
use magex_dispatch::mission::{Mission, MissionLimits};
use magex_dispatch::missions::{Bounds, Missions};
use magex_dispatch::{AssignError, Problem};
use magex_proto::v1;
use redb::{Database, StorageBackend};
use std::collections::BTreeMap;
use std::io;
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// Changes of a history.
const CHANGES: u32 = 40;
/// What a disk writes as a whole.
const SECTOR: usize = 512;

type State = BTreeMap<String, Mission>;

#[derive(Debug, Clone)]
enum Step {
    Resize(u64),
    Write(u64, Vec<u8>),
    Sync,
    /// The change that leads to this state was acknowledged.
    Acknowledge(State),
}

/// A disk in memory that remembers every step.
#[derive(Debug, Default)]
struct Recorder {
    bytes: Mutex<Vec<u8>>,
    steps: Mutex<Vec<Step>>,
}

impl Recorder {
    fn of(bytes: Vec<u8>) -> Arc<Self> {
        Arc::new(Self { bytes: Mutex::new(bytes), steps: Mutex::default() })
    }

    fn take(&self, step: Step) {
        apply(&mut self.bytes.lock().unwrap(), &step);
        self.steps.lock().unwrap().push(step);
    }

    fn open(self: &Arc<Self>) -> Result<Disk, DiskError> {
        let backend = self.clone();
        let opener = move || Ok(Database::builder().create_with_backend(Backend(backend.clone()))?);
        Disk::opened_by(Box::new(opener), Duration::ZERO)
    }
}

fn apply(bytes: &mut Vec<u8>, step: &Step) {
    match step {
        Step::Resize(length) => bytes.resize(*length as usize, 0),
        Step::Write(offset, data) => {
            let (from, to) = (*offset as usize, *offset as usize + data.len());
            // The change of the length that made room for it may be forgotten.
            bytes.resize(bytes.len().max(to), 0);
            bytes[from..to].copy_from_slice(data);
        }
        Step::Sync | Step::Acknowledge(_) => {}
    }
}

#[derive(Debug)]
struct Backend(Arc<Recorder>);

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

    fn set_len(&self, length: u64) -> io::Result<()> {
        self.0.take(Step::Resize(length));
        Ok(())
    }

    fn sync_data(&self) -> io::Result<()> {
        self.0.take(Step::Sync);
        Ok(())
    }

    fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        self.0.take(Step::Write(offset, data.to_vec()));
        Ok(())
    }
}

fn planner(problem: &Problem) -> Result<Planned, AssignError> {
    let plan = engine::solve(problem, problem.scheduler, &|| true)?;
    Ok(Planned { plan, fallback_reason: String::new(), weights: None })
}

const LIMITS: MissionLimits = MissionLimits { members: 100, lifetime_ms: 60_000 };

fn known(missions: &Missions) -> State {
    let all = missions.page("", 10_000, |_| true);
    all.into_iter().map(|mission| (mission.id().to_owned(), Mission::clone(&mission))).collect()
}

/// One of: a new mission, another revision of one, the end of one.
fn change(missions: &Missions, stream: &mut Stream) {
    let agents = |stream: &mut Stream| {
        let member = |k| v1::Member {
            id: format!("a{k}"),
            position: vec![if k % 2 == 0 { 0.5 } else { 3.5 }, 1.0],
            ..v1::Member::default()
        };
        (0..=stream.below(30)).map(member).collect::<Vec<_>>()
    };
    let all: Vec<Mission> = known(missions).into_values().collect();
    let one = (!all.is_empty()).then(|| all[stream.below(all.len() as u32) as usize].clone());
    match (stream.below(4), one) {
        (0, Some(mission)) => drop(missions.remove(mission.id(), |_| true).unwrap()),
        (1 | 2, Some(mission)) => {
            let request = v1::UpdateMissionRequest { agents: agents(stream), ..Default::default() };
            let next = mission.update(request, 2000, &LIMITS, &planner).unwrap();
            missions.replace(next, mission.assignment.revision).unwrap();
        }
        _ => {
            let id = format!("m{}", stream.bits32());
            let agents = agents(stream);
            let request =
                v1::CreateMissionRequest { mission_id: id, goals: agents.clone(), agents, ..Default::default() };
            missions.insert(Mission::create(request, "me", "", 1000, &LIMITS, &planner).unwrap()).unwrap();
        }
    }
}

/// Opens a file and changes missions in it; returns the steps, from the first one on.
fn history(before: Vec<u8>, stream: &mut Stream) -> Vec<Step> {
    let recorder = Recorder::of(before);
    let missions = Missions::open(Some(recorder.open().unwrap()), Bounds::default()).unwrap();
    recorder.take(Step::Acknowledge(known(&missions)));
    for _ in 0..CHANGES {
        change(&missions, stream);
        recorder.take(Step::Acknowledge(known(&missions)));
    }
    recorder.steps.lock().unwrap().clone()
}

/// What a power cut may leave: all that was synced, and any of the writes since then, or sectors of them.
fn after_power_cut(durable: &[u8], since: &[Step], stream: &mut Stream) -> Vec<u8> {
    let (mut bytes, style) = (durable.to_vec(), stream.below(4));
    let first = stream.below(since.len() as u32 + 1) as usize;
    for (at, step) in since.iter().enumerate() {
        let kept = match style {
            0 => true,
            1 => at < first,
            _ => stream.below(2) == 0,
        };
        match step {
            Step::Write(offset, data) if style == 3 && kept => {
                for (number, sector) in data.chunks(SECTOR).enumerate().filter(|_| stream.below(2) == 0) {
                    apply(&mut bytes, &Step::Write(offset + (number * SECTOR) as u64, sector.to_vec()));
                }
            }
            step if kept => apply(&mut bytes, step),
            _ => {}
        }
    }
    bytes
}

/// Cuts the power after each of the steps, `times` with different losses. `before` was durable at the first.
fn cut_everywhere(before: &[u8], steps: &[Step], stream: &mut Stream, times: u32) -> (u32, Vec<u8>) {
    let (mut durable, mut since, mut cuts, mut sample) = (before.to_vec(), Vec::new(), 0, Vec::new());
    let states: Vec<&State> =
        steps.iter().filter_map(|s| if let Step::Acknowledge(s) = s { Some(s) } else { None }).collect();
    let mut acknowledged: usize = 0;
    for (at, step) in steps.iter().enumerate() {
        match step {
            Step::Sync => since.drain(..).for_each(|step| apply(&mut durable, &step)),
            Step::Acknowledge(_) => acknowledged += 1,
            other => since.push(other.clone()),
        }
        for time in 0..times {
            let image = after_power_cut(&durable, &since, stream);
            let disk = Recorder::of(image.clone()).open();
            let disk = disk.unwrap_or_else(|error| panic!("step {at}.{time}: {error}"));
            let loaded = disk.load().unwrap_or_else(|error| panic!("step {at}.{time}: {error}"));
            let found: State = loaded.into_iter().map(|mission| (mission.id().to_owned(), mission)).collect();
            let now = acknowledged.checked_sub(1).map(|last| states[last]);
            let allowed =
                now.is_none_or(|now| found == *now) || states.get(acknowledged).is_some_and(|next| found == **next);
            assert!(allowed, "step {at}.{time}: not what was acknowledged, nor that and the next change");
            cuts += 1;
            if at == steps.len() / 2 {
                sample.clone_from(&image);
            }
        }
    }
    (cuts, sample)
}

/// A file gets its name when it is made (`a_file_that_was_half_made…`): that it is there is where a history begins.
fn fresh() -> Vec<u8> {
    let recorder = Recorder::of(Vec::new());
    drop(recorder.open().unwrap());
    recorder.bytes.lock().unwrap().clone()
}

/// Histories from an empty file, and from what a power cut left.
fn cut(histories: u32, times: u32) -> u32 {
    let mut cuts = 0;
    for number in 0..histories {
        let mut stream = Key::new(number.into(), Purpose::Request, &[]).stream();
        let mut before = fresh();
        for _ in 0..2 {
            let steps = history(before.clone(), &mut stream);
            let (done, left) = cut_everywhere(&before, &steps, &mut stream, times);
            (cuts, before) = (cuts + done, left);
        }
    }
    cuts
}

/// After every step of making a file: it has no name yet, or opens.
#[test]
fn a_file_that_was_half_made_is_made_again() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("missions.redb");
    let recorder = Recorder::of(Vec::new());
    drop(recorder.open().unwrap());
    let steps = recorder.steps.lock().unwrap().clone();
    let mut unreadable = 0;
    for done in 1..=steps.len() {
        let mut half = Vec::new();
        steps[..done].iter().for_each(|step| apply(&mut half, step));
        unreadable += u32::from(Recorder::of(half.clone()).open().is_err());
        std::fs::write(folder.path().join("missions.redb.new-1"), half).unwrap();
        assert!(Disk::open(&path).unwrap().load().unwrap().is_empty());
        std::fs::remove_file(&path).unwrap();
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "what was half made is removed");
    }
    assert!(unreadable > 0, "a half-made file opens, so it would not need another name");
}

#[test]
fn a_power_cut_after_any_step_loses_no_acknowledged_change() {
    let cuts = cut(1, 1);
    assert!(cuts > 300, "{cuts} cuts");
}

#[test]
#[ignore = "takes minutes; .ci/long"]
fn ten_thousand_power_cuts() {
    let cuts = cut(6, 4);
    println!("{cuts} power cuts");
    assert!(cuts >= 10_000, "{cuts} cuts");
}
