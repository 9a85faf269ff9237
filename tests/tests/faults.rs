//! Real processes, and a network and a disk that fail them: training goes on or resumes by itself, and learns the same bits.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stderr, reason = "helpers of tests")]

use magex_core::config::{ExecutorKind, RunConfig};
use magex_core::ids::RunId;
use magex_learner::checkpoint::disk::{Disk, FileSystem};
use magex_learner::checkpoint::{self, CheckpointError};
use magex_learner::trainer::Trainer;
use magex_tests::proxy::{Faults, Proxy};
use magex_tests::relay::Relay;
use magex_tests::sandbox::{Cluster, Process, Setup, wait_until};
use magex_tests::small_disk::SmallDisk;
use magex_tests::{drive, small, train};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

fn undisturbed(config: &RunConfig) -> String {
    train(config, tempfile::tempdir().unwrap().path(), 1, 1).sha256
}

/// Long enough to be disturbed in the middle.
fn long() -> RunConfig {
    small(ExecutorKind::Local, 5, 40)
}

#[test]
fn a_network_that_delays_loses_flips_and_resets_changes_nothing() {
    let config = long();
    let mut cluster = Cluster::start_with(&config, Setup { wires: Some(11), ..Setup::default() });
    cluster.start_actor();
    cluster.start_actor();
    let none = Faults::default();
    let weathers = [
        Faults { delay: Duration::from_millis(20), ..none },
        Faults { corrupt_every: Some(60_000), ..none },
        Faults { bytes_per_second: Some(400_000), ..none },
        Faults { drop_every: Some(60_000), ..none },
    ];
    for (round, weather) in weathers.into_iter().enumerate() {
        cluster.wait_for_iteration(2 + 8 * round as u32);
        cluster.wires().all().iter().for_each(|wire| wire.set(weather));
        cluster.wait_for_iteration(6 + 8 * round as u32);
        cluster.wires().all().iter().for_each(|wire| {
            wire.reset();
            wire.set(none);
        });
    }
    let sum = |of: fn(&Proxy) -> u64| cluster.wires().all().iter().map(|wire| of(wire)).sum::<u64>();
    assert!(sum(Proxy::flipped) > 0 && sum(Proxy::lost) > 0, "there was damage");
    assert_eq!(cluster.finish(), undisturbed(&config));
    assert!(cluster.actors.iter_mut().all(|actor| actor.wait().success()), "the actors lived through it");
}

#[test]
fn half_open_connections_are_given_up_and_made_anew() {
    let config = small(ExecutorKind::Local, 5, 30);
    let mut cluster = Cluster::start_with(&config, Setup { wires: Some(12), ..Setup::default() });
    cluster.start_actor();
    cluster.start_actor();
    cluster.wait_for_iteration(4);
    // Nothing is closed, nothing is said: not a byte of a goodbye, in any direction.
    cluster.wires().all().iter().for_each(|wire| wire.set(Faults { mute: true, ..Faults::default() }));
    let start = Instant::now();
    wait_until("the learner to give both actors up", || cluster.status().unwrap().actors.is_empty());
    assert!(start.elapsed() <= Duration::from_secs(3), "a lease of 2 s and one more: {:?}", start.elapsed());
    cluster.wires().all().iter().for_each(|wire| wire.set(Faults::default()));
    assert_eq!(cluster.finish(), undisturbed(&config));
}

#[test]
fn a_stopped_and_a_mute_actor_are_evicted_within_a_lease() {
    let config = small(ExecutorKind::Local, 5, 100_000);
    let mut cluster = Cluster::start(&config);
    let mute = Proxy::start(cluster.learner_address(), 1);
    cluster.start_actor();
    cluster.start_actor_at(&mute.address(), &[]);
    let present = |cluster: &Cluster| cluster.status().map_or(0, |status| status.actors.len());
    wait_until("both actors", || present(&cluster) == 2);
    cluster.actors[0].signal("STOP");
    mute.set(Faults { mute: true, ..Faults::default() });
    let start = Instant::now();
    wait_until("both to be evicted", || present(&cluster) == 0);
    let took = start.elapsed();
    assert!(took <= Duration::from_secs(3), "a lease of 2 s and one more: {took:?}");
    assert_eq!(cluster.learner.log().matches("fell silent").count(), 2, "{}", cluster.learner.log());
    // The work goes on with an actor that is new, and with the two that come back.
    let reached = cluster.status().unwrap().iteration;
    cluster.start_actor();
    cluster.wait_for_iteration(reached + 3);
    cluster.actors[0].signal("CONT");
    mute.set(Faults::default());
    wait_until("all three", || present(&cluster) == 3);
}

#[test]
fn repeated_reordered_and_damaged_results_change_nothing() {
    let config = long();
    let mut cluster = Cluster::start(&config);
    let relay = Relay::start(cluster.learner_address(), 5);
    cluster.start_actor_at(relay.address(), &[]);
    cluster.start_actor_at(relay.address(), &[]);
    cluster.wait_for_iteration(36);
    let ledger = cluster.status().unwrap().ledger.unwrap();
    assert!(ledger.duplicate > 0 && ledger.rejected > 0, "{ledger:?}");
    let done = &relay.mischief;
    for count in [&done.repeated, &done.reordered, &done.damaged] {
        assert!(count.load(Ordering::SeqCst) > 0, "{done:?}");
    }
    assert_eq!(cluster.finish(), undisturbed(&config));
}

#[test]
fn a_full_disk_ends_nothing_and_tears_no_line() {
    let Some(disk) = SmallDisk::mount("16m") else { return };
    // Many more iterations than are needed: what is waited for is what the learner says, not how far it has come.
    let iterations = 600;
    let config = small(ExecutorKind::Local, 5, iterations);
    let run = disk.path().join("run");
    let mut cluster = Cluster::start_with(&config, Setup { run: Some(run.clone()), ..Setup::default() });
    cluster.start_actor();
    cluster.wait_for_iteration(6);
    disk.fill();
    for message in ["checkpoint failed; the previous one remains valid", "metrics.jsonl cannot be written"] {
        wait_until(message, || cluster.learner.log().contains(message));
    }
    // A kill now falls back to the checkpoint before.
    cluster.learner.kill();
    disk.make_room();
    let kept = newest(&run);
    let said = |cluster: &Cluster, what: &str| cluster.learner.log().matches(what).count();
    let before = said(&cluster, "checkpoint failed; the previous one remains valid");
    cluster.resume_learner();
    wait_until("a checkpoint of its own", || newest(&run) > kept);
    disk.fill();
    wait_until("a full disk", || said(&cluster, "checkpoint failed; the previous one remains valid") > before);
    disk.make_room();
    wait_until("checkpoints again", || cluster.learner.log().contains("checkpoints can be written again"));
    disk.fill();
    // The end of the run waits for room.
    wait_until("the end of the run", || cluster.learner.log().contains("the run's last files cannot be written"));
    assert!(cluster.learner.running());
    disk.make_room();
    assert_eq!(cluster.finish(), undisturbed(&config));
    let text = std::fs::read_to_string(run.join("metrics.jsonl")).unwrap();
    let lines: Vec<u64> = text
        .lines()
        .map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap()["iteration"].as_u64().unwrap())
        .collect();
    let expected: Vec<u64> = (0..=iterations).collect();
    assert_eq!(lines, expected, "every line is there, whole and once");
}

/// The last of a run's checkpoints.
fn newest(run: &Path) -> Option<PathBuf> {
    checkpoint::list(run).pop()
}

/// A disk that is cut off, as by a kill, at one step: half of what that step writes is there, and nothing after it happens.
#[derive(Debug)]
struct CutDisk {
    left: AtomicUsize,
}

impl CutDisk {
    fn step(&self, whole: impl FnOnce() -> std::io::Result<()>, half: impl FnOnce()) -> std::io::Result<()> {
        let left = self.left.load(Ordering::SeqCst);
        self.left.store(left.saturating_sub(1), Ordering::SeqCst);
        if left > 1 {
            return whole();
        }
        if left == 1 {
            half();
        }
        Err(std::io::Error::other("cut off"))
    }
}

impl Disk for CutDisk {
    fn create_dir(&self, path: &Path) -> std::io::Result<()> {
        self.step(|| FileSystem.create_dir(path), || {})
    }

    fn write(&self, path: &Path, bytes: &[u8]) -> std::io::Result<()> {
        self.step(|| FileSystem.write(path, bytes), || FileSystem.write(path, &bytes[..bytes.len() / 2]).unwrap())
    }

    fn sync(&self, path: &Path) -> std::io::Result<()> {
        self.step(|| FileSystem.sync(path), || {})
    }

    fn rename(&self, from: &Path, to: &Path) -> std::io::Result<()> {
        self.step(|| FileSystem.rename(from, to), || {})
    }

    fn remove_dir(&self, path: &Path) -> std::io::Result<()> {
        let half = || {
            // Some of it goes before the end.
            if let Some(Ok(entry)) = std::fs::read_dir(path).unwrap().next() {
                std::fs::remove_file(entry.path()).unwrap();
            }
        };
        self.step(|| FileSystem.remove_dir(path), half)
    }
}

fn copy_run(from: &Path, to: &Path) {
    assert!(Command::new("cp").arg("-a").arg(from.join(".")).arg(to).status().unwrap().success());
}

#[test]
fn a_kill_at_any_step_of_writing_a_checkpoint_leaves_a_run_that_learns_the_same_bits() {
    let mut config = small(ExecutorKind::Local, 5, 4);
    (config.run.checkpoint_every, config.run.keep_checkpoints) = (1, 1);
    let expected = undisturbed(&config);
    let never = Arc::new(AtomicBool::new(false));
    // A run that stands at iteration 2, and what it will have learned at 3.
    let base = tempfile::tempdir().unwrap();
    let stop = Arc::new(AtomicBool::new(true));
    drive(Trainer::create(&config, RunId("r".into()), base.path(), 1).unwrap(), &config, 1, &stop);
    drive(Trainer::resume(&config, base.path(), 1).unwrap().0, &config, 1, &stop);
    let ahead = tempfile::tempdir().unwrap();
    copy_run(base.path(), ahead.path());
    drive(Trainer::resume(&config, ahead.path(), 1).unwrap().0, &config, 1, &stop);
    let template = Trainer::resume(&config, ahead.path(), 1).unwrap().0.learned().clone();
    let (three, learned, _) = checkpoint::read_latest(ahead.path(), &template).unwrap();
    let (two, before, _) = checkpoint::read_latest(base.path(), &template).unwrap();
    assert_eq!((two.iteration, three.iteration), (2, 3));
    // A new iteration with an old one to remove, and the same iteration once more, which replaces the only one there is.
    for (progress, weights) in [(&three, &learned), (&two, &before)] {
        let mut cut = 1;
        loop {
            let run = tempfile::tempdir().unwrap();
            copy_run(base.path(), run.path());
            let disk = CutDisk { left: cut.into() };
            let written = checkpoint::write_on(&disk, run.path(), progress, weights, 1);
            let (found, _, _) = checkpoint::read_latest(run.path(), &template)
                .unwrap_or_else(|error| panic!("cut at step {cut} of iteration {}: {error}", progress.iteration));
            assert!(found.iteration == 2 || found.iteration == progress.iteration, "cut {cut}: {}", found.iteration);
            let (resumed, _) = Trainer::resume(&config, run.path(), 1).unwrap();
            assert_eq!(drive(resumed, &config, 1, &never).sha256, expected, "cut at step {cut}");
            if disk.left.into_inner() > 0 {
                assert!(written.is_ok());
                break;
            }
            cut += 1;
        }
        assert!(cut >= 14, "every file is written and synced in steps of its own: {cut} steps");
    }
}

#[test]
fn a_flipped_byte_in_any_file_of_a_checkpoint_costs_no_more_than_the_way_from_the_one_before() {
    let config = long();
    let expected = undisturbed(&config);
    for file in ["weights.safetensors", "optimiser.safetensors", "state.json", "manifest.json"] {
        let mut cluster = Cluster::start(&config);
        cluster.start_actor();
        cluster.wait_for_iteration(8);
        cluster.learner.kill();
        let newest = checkpoint::list(&cluster.run()).pop().unwrap();
        let mut bytes = std::fs::read(newest.join(file)).unwrap();
        let place = bytes.len() / 3;
        bytes[place] ^= 4;
        std::fs::write(newest.join(file), bytes).unwrap();
        cluster.resume_learner();
        let log = cluster.learner.log();
        // A flip in the manifest is seen as one in the file that it speaks of.
        let named = log.contains(file) || file == "manifest.json";
        assert!(log.contains("skipped a checkpoint") && named, "{log}");
        assert_eq!(cluster.finish(), expected, "{file}");
    }
}

#[test]
fn a_checkpoint_of_another_format_is_refused_with_the_remedy() {
    let config = small(ExecutorKind::Local, 5, 2);
    let folder = tempfile::tempdir().unwrap();
    train(&config, folder.path(), 1, 1);
    let newest = checkpoint::list(folder.path()).pop().unwrap();
    for file in ["manifest.json", "state.json"] {
        let text = std::fs::read_to_string(newest.join(file)).unwrap();
        std::fs::write(
            newest.join(file),
            text.replace(&format!("\"format\": {}", checkpoint::FORMAT), "\"format\": 0"),
        )
        .unwrap();
    }
    let error = Trainer::resume(&config, folder.path(), 1).unwrap_err().to_string();
    assert!(
        error.contains("format 0, written by another release of magex")
            && error.contains("resume with the release that"),
        "{error}"
    );
    let template = Trainer::create(&config, RunId("r".into()), tempfile::tempdir().unwrap().path(), 1).unwrap();
    let error = checkpoint::read_latest(folder.path(), template.learned()).unwrap_err();
    assert!(matches!(error, CheckpointError::Format { format: 0, .. }), "{error}");
}

const BUDGET: Duration = Duration::from_secs(10);

fn stop(process: &mut Process, code: i32) {
    process.signal("TERM");
    let (status, _) = process.wait_within(BUDGET);
    assert_eq!(status.code(), Some(code), "{}", process.log());
}

#[test]
fn every_process_stops_within_ten_seconds_with_peers_that_do_not_answer() {
    let config = long();
    let mut cluster = Cluster::start(&config);
    cluster.start_actor();
    cluster.start_actor();
    cluster.wait_for_iteration(4);
    // Peers that are stopped, with streams open and a lease in hand; a socket that never says anything.
    cluster.actors[0].signal("STOP");
    cluster.commander.as_ref().unwrap().signal("STOP");
    let _idle = std::net::TcpStream::connect(cluster.learner_address()).unwrap();
    stop(&mut cluster.learner, 75);
    // An actor whose learner is gone and whose commander is stopped.
    stop(&mut cluster.actors[1], 0);
    cluster.commander.as_ref().unwrap().signal("CONT");
    cluster.actors[0].signal("CONT");
    cluster.resume_learner();
    cluster.start_actor();
    cluster.wait_for_iteration(10);
    // A commander and an actor in the middle of a rollout whose learner is stopped.
    cluster.learner.signal("STOP");
    let _idle = std::net::TcpStream::connect(cluster.commander_address()).unwrap();
    stop(cluster.commander.as_mut().unwrap(), 0);
    stop(&mut cluster.actors[0], 0);
    cluster.learner.signal("CONT");
    cluster.start_commander();
    assert_eq!(cluster.finish(), undisturbed(&config));
}
