//! A power cut at any moment of a run: whatever the disk forgot of what was not synced, the run continues from its last complete
//! checkpoint or a later one, with the same bits, and with the lines of all its iterations.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex_core::config::{Algorithm, ExecutorKind, MappoConfig, RunConfig};
use magex_core::ids::RunId;
use magex_core::rng::{Key, Purpose};
use magex_core::task::RewardTarget;
use magex_learner::checkpoint;
use magex_learner::checkpoint::disk::Disk;
use magex_learner::report::observer::RunObserver;
use magex_learner::run_folder::{CONFIG_FILE, Claim, RunFolderState};
use magex_learner::train::learned::Learned;
use magex_learner::trainer::Trainer;
use magex_tests::forgetful::{Model, Recorder, Step};
use magex_tests::{drive, small, train};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};
use std::time::Duration;

const ITERATIONS: u32 = 6;

fn mappo() -> RunConfig {
    let mut config = small(ExecutorKind::Local, 3, ITERATIONS.into());
    (config.executor.hidden, config.run.keep_checkpoints) = (8, 2);
    config.validated().unwrap()
}

/// With episodes in files of their own.
fn qmix() -> RunConfig {
    let mut config = mappo();
    (config.run.algorithm, config.task.reward_target) = (Algorithm::Qmix, RewardTarget::Team);
    (config.executor.kind, config.executor.recurrent, config.executor.hidden) = (ExecutorKind::Flat, true, 16);
    config.mappo = MappoConfig::default();
    let q = &mut config.qmix;
    (q.buffer_episodes, q.batch_episodes, q.episodes_per_gradient_step) = (20, 6, 4);
    config.validated().unwrap()
}

/// What an undisturbed run learns: its state after each iteration, and the hash at its end.
struct Known {
    config: RunConfig,
    toml: String,
    states: Vec<Learned>,
    sha256: String,
}

impl Known {
    fn of(config: RunConfig) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let mut all = config.clone();
        (all.run.checkpoint_every, all.run.keep_checkpoints) = (1, 1000);
        let sha256 = train(&all, folder.path(), 1, 1).sha256;
        let fresh = tempfile::tempdir().unwrap();
        let template = Trainer::create(&config, RunId("r".into()), fresh.path(), 1).unwrap().learned().clone();
        let read = |folder: &PathBuf| checkpoint::read(folder, &template).unwrap().1;
        let states: Vec<Learned> = checkpoint::list(folder.path()).iter().map(read).collect();
        assert_eq!(states.len(), ITERATIONS as usize + 1);
        Self { toml: config.to_toml().unwrap(), config, states, sha256 }
    }
}

/// Numbers of steps after which the checkpoint of an iteration was complete.
type Complete = Arc<Mutex<Vec<(usize, u32)>>>;

#[derive(Debug)]
struct Witness(Arc<Recorder>, Complete);

impl RunObserver for Witness {
    fn checkpoint(&mut self, _took: Duration, written: Option<&Path>) {
        let name = written.unwrap().file_name().unwrap().to_str().unwrap();
        self.1.lock().unwrap().push((self.0.steps().len(), name.parse().unwrap()));
    }
}

/// The steps of a run in `run` below a folder: what was there before, and what is promised.
struct Trace {
    before: Model,
    steps: Vec<Step>,
    complete: Vec<(usize, u32)>,
}

impl Trace {
    /// A run from its first file to its last; one that is there continues.
    fn record(known: &Known, root: &Path) -> Self {
        let (before, recorder) = (Model::of(root), Arc::new(Recorder::new(root)));
        let (run, disk, complete) = (root.join("run"), recorder.clone() as Arc<dyn Disk>, Complete::default());
        let mut trainer = if RunFolderState::of(&run) == RunFolderState::Run {
            let (newest, ..) = checkpoint::read_latest(&run, &known.states[0]).unwrap();
            complete.lock().unwrap().push((0, newest.iteration));
            Trainer::resume_on(disk, &known.config, &run, 1).unwrap().0
        } else {
            Claim::begin_on(&*recorder, &run, &known.toml, "test", true).unwrap();
            let id = RunId("r".into());
            let trainer = Trainer::create_on(disk, None, &known.config, id, &run, 1).unwrap();
            complete.lock().unwrap().push((recorder.steps().len(), 0));
            trainer
        };
        trainer.observe(Witness(recorder.clone(), complete.clone()));
        assert_eq!(drive(trainer, &known.config, 1, &Arc::new(AtomicBool::new(false))).sha256, known.sha256);
        let complete = complete.lock().unwrap().clone();
        Self { before, steps: recorder.steps(), complete }
    }

    /// The same run on a program that does not sync some things.
    fn without(&self, unsynced: impl Fn(&Path) -> bool) -> Self {
        let kept = |step: &Step| !matches!(step, Step::Sync(path) if unsynced(path));
        let mut complete = self.complete.clone();
        complete.iter_mut().for_each(|(at, _)| *at = self.steps[..*at].iter().filter(|step| kept(step)).count());
        let steps = self.steps.iter().filter(|step| kept(step)).cloned().collect();
        Self { before: self.before.clone(), steps, complete }
    }

    /// Cuts the power after each step, `times` with different losses. Returns the number of cuts, or what is wrong after one.
    fn cut_everywhere(&self, known: &Known, seed: u64, times: u32) -> Result<u32, String> {
        let (mut model, mut cuts) = (self.before.clone(), 0);
        for done in 0..=self.steps.len() {
            if done > 0 {
                model.step(&self.steps[done - 1]);
            }
            let promised = self.complete.iter().rev().find(|(at, _)| *at <= done).map(|(_, iteration)| *iteration);
            for time in 0..times {
                let mut stream = Key::new(seed, Purpose::Spawn, &[done as u32, time]).stream();
                let place = tempfile::tempdir().unwrap();
                model.after_power_cut(&mut stream, place.path());
                let last = done.checked_sub(1).map(|last| &self.steps[last]);
                check(known, &place.path().join("run"), promised, stream.below(40) == 0)
                    .map_err(|wrong| format!("seed {seed}, cut {done}.{time}, after {}: {wrong}", told(last)))?;
                cuts += 1;
            }
        }
        Ok(cuts)
    }
}

fn told(step: Option<&Step>) -> String {
    let mut text = format!("{step:?}");
    text.truncate(120);
    text
}

/// The oracle: the run goes on with what was promised, or begins again if nothing was.
fn check(known: &Known, run: &Path, promised: Option<u32>, to_the_end: bool) -> Result<(), String> {
    let holds = |what: &str, right: bool| if right { Ok(()) } else { Err(what.to_owned()) };
    let trainer = match RunFolderState::of(run) {
        RunFolderState::Empty | RunFolderState::Begun => {
            holds("nothing is left of the run", promised.is_none())?;
            Claim::begin(run, &known.toml, "test", true).map_err(|error| error.to_string())?;
            Trainer::create(&known.config, RunId("r".into()), run, 1).map_err(|error| error.to_string())?
        }
        RunFolderState::Run => {
            holds(
                "another config.toml",
                fs::read_to_string(run.join(CONFIG_FILE)).is_ok_and(|text| text == known.toml),
            )?;
            let complete = run.join("summary.json").exists();
            let (trainer, skipped) = Trainer::resume(&known.config, run, 1).map_err(|error| error.to_string())?;
            holds(&format!("{skipped:?}"), skipped.is_empty())?;
            let iteration =
                checkpoint::read_latest(run, &known.states[0]).map_err(|error| error.to_string())?.0.iteration;
            holds(&format!("iteration {iteration}, promised {promised:?}"), Some(iteration) >= promised)?;
            holds("other numbers", *trainer.learned() == known.states[iteration as usize])?;
            holds(&format!("missing lines: {:?}", trainer.missing_lines()), trainer.missing_lines().is_empty())?;
            let last = if complete { iteration + 1 } else { iteration };
            holds("not the lines of its iterations", lines(run) == (0..last).collect::<Vec<_>>())?;
            trainer
        }
        RunFolderState::Other => return Err("the folder is taken for something else".to_owned()),
    };
    if to_the_end {
        let ran = drive(trainer, &known.config, 1, &Arc::new(AtomicBool::new(false)));
        holds("other weights at the end", ran.sha256 == known.sha256)?;
        holds("not all lines at the end", lines(run) == (0..=ITERATIONS).collect::<Vec<_>>())?;
    }
    Ok(())
}

fn lines(run: &Path) -> Vec<u32> {
    let text = fs::read_to_string(run.join("metrics.jsonl")).unwrap_or_default();
    let number = |line: &str| serde_json::from_str::<serde_json::Value>(line).ok()?["iteration"].as_u64();
    // A line that is none is no iteration's.
    text.lines().map(|line| number(line).map_or(u32::MAX, |number| number as u32)).collect()
}

/// Power cuts in whole runs, and in runs that continue after one.
fn cut(times: u32) -> u32 {
    let mut cuts = 0;
    for (number, config) in [mappo(), qmix()].into_iter().enumerate() {
        let known = Known::of(config);
        let root = tempfile::tempdir().unwrap();
        let whole = Trace::record(&known, root.path());
        cuts += whole.cut_everywhere(&known, number as u64, times).unwrap();
        // Fewer of them where a test must be quick.
        let continuations = if times > 1 { 2 } else { 1 - number };
        for again in 0..continuations {
            let mut model = whole.before.clone();
            whole.steps[..whole.steps.len() * (1 + again) / 3].iter().for_each(|step| model.step(step));
            let root = tempfile::tempdir().unwrap();
            let mut stream = Key::new(9, Purpose::Spawn, &[again as u32]).stream();
            model.after_power_cut(&mut stream, root.path());
            let continued = Trace::record(&known, root.path());
            cuts += continued.cut_everywhere(&known, 10 + number as u64, times).unwrap();
        }
    }
    cuts
}

#[test]
fn a_power_cut_after_any_step_of_a_run_loses_nothing_that_was_complete() {
    let cuts = cut(1);
    assert!(cuts > 300, "{cuts} cuts");
}

/// Every sync is needed: without any one of them a power cut loses something.
#[test]
fn without_one_of_its_syncs_a_run_would_lose_something() {
    let known = Known::of(mappo());
    let root = tempfile::tempdir().unwrap();
    let whole = Trace::record(&known, root.path());
    let below = |path: &Path, folder: &str| path.parent() == Some(Path::new(folder));
    let unfinished = |path: &Path| path.extension().is_some_and(|end| end == "tmp");
    type Case<'a> = (&'a str, &'a dyn Fn(&Path) -> bool);
    let cases: [Case<'_>; 7] = [
        ("the folder that the run is in", &|path| path == Path::new("")),
        ("the run folder", &|path| path == Path::new("run")),
        ("config.toml", &|path| path == Path::new("run/.config.toml.tmp")),
        ("metrics.jsonl", &|path| path == Path::new("run/metrics.jsonl")),
        ("the folder of the checkpoints", &|path| path == Path::new("run/checkpoints")),
        ("the folder of a checkpoint", &|path| below(path, "run/checkpoints") && unfinished(path)),
        ("the files of a checkpoint", &|path| path.parent().is_some_and(|above| below(above, "run/checkpoints"))),
    ];
    for (what, unsynced) in cases {
        let without = whole.without(unsynced);
        assert!(without.steps.len() < whole.steps.len(), "{what} is not synced");
        let lost = (0..20).find_map(|seed| without.cut_everywhere(&known, seed, 1).err());
        assert!(lost.is_some(), "{what} is synced, and nothing is lost without it");
    }
}

#[test]
#[ignore = "takes minutes; .ci/long"]
fn ten_thousand_power_cuts() {
    let cuts = cut(20);
    println!("{cuts} power cuts");
    assert!(cuts >= 10_000, "{cuts} cuts");
}
