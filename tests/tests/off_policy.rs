//! QMIX and MASER: trained by the same service, with the same promises as MAPPO.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex_core::config::{Algorithm, ExecutorKind, RunConfig};
use magex_core::ids::RunId;
use magex_core::task::{RewardTarget, Spawn, TaskConfig, TaskName};
use magex_learner::trainer::{TrainOutcome, Trainer};
use magex_tests::sandbox::{Cluster, wait_until};
use magex_tests::{drive, off_policy, small, train, updates};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

fn config(algorithm: Algorithm, iterations: u64) -> RunConfig {
    off_policy(algorithm, small(ExecutorKind::Local, 4, iterations))
}

fn hash(config: &RunConfig, actors: usize, threads: usize) -> String {
    train(config, tempfile::tempdir().unwrap().path(), actors, threads).sha256
}

const BOTH: [Algorithm; 2] = [Algorithm::Qmix, Algorithm::Maser];

#[test]
fn neither_actors_nor_training_threads_reach_a_number() {
    for algorithm in BOTH {
        let config = config(algorithm, 4);
        let ran = train(&config, tempfile::tempdir().unwrap().path(), 1, 1);
        assert_eq!(ran.sha256, hash(&config, 3, 2), "{algorithm}");
        let lines = updates(&ran.events);
        let value = |line: usize, name: &str| lines[line]["executor"][name].as_f64().unwrap();
        assert_eq!(
            (value(0, "buffer_episodes"), value(2, "buffer_episodes"), value(3, "buffer_episodes")),
            (8.0, 20.0, 20.0)
        );
        assert_eq!((value(0, "epsilon"), value(0, "gradient_steps")), (1.0, 4.0));
        assert!((value(1, "epsilon") - (1.0 - 0.95 * 160.0 / 400.0)).abs() < 1e-6);
        assert_eq!(value(3, "epsilon"), 0.05);
        assert!(value(3, "td_loss") > 0.0 && value(3, "mixer_grad_norm") > 0.0);
        assert_eq!(lines[3]["executor"]["intrinsic_reward"].is_null(), algorithm == Algorithm::Qmix);
    }
}

fn stopped_at_once() -> Arc<AtomicBool> {
    Arc::new(AtomicBool::new(true))
}

fn never() -> Arc<AtomicBool> {
    Arc::new(AtomicBool::new(false))
}

/// Files of the replay buffer, by name.
fn episodes(run: &Path) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> =
        fs::read_dir(run.join("replay")).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files
}

fn iterations_of(files: &[PathBuf]) -> Vec<u32> {
    files.iter().map(|path| path.file_name().unwrap().to_str().unwrap()[..6].parse().unwrap()).collect()
}

#[test]
fn a_stopped_and_resumed_run_ends_with_the_same_bits() {
    for algorithm in BOTH {
        let config = config(algorithm, 6);
        let whole = hash(&config, 2, 1);
        let folder = tempfile::tempdir().unwrap();
        let first = Trainer::create(&config, RunId("r".into()), folder.path(), 1).unwrap();
        assert!(matches!(drive(first, &config, 1, &stopped_at_once()).outcome, TrainOutcome::Stopped(_)));
        // An iteration in each attempt, over the point at which the first episodes go.
        for _ in 0..4 {
            let (next, skipped) = Trainer::resume(&config, folder.path(), 2).unwrap();
            assert!(skipped.is_empty());
            drive(next, &config, 2, &stopped_at_once());
        }
        let (last, _) = Trainer::resume(&config, folder.path(), 1).unwrap();
        assert_eq!(drive(last, &config, 3, &never()).sha256, whole, "{algorithm}");
        // Three checkpoints are kept, of 4, 5 and 6; the oldest buffer reaches back three iterations.
        assert_eq!(iterations_of(&episodes(folder.path())), [1, 2, 3, 4, 5]);
    }
}

#[test]
fn damaged_episodes_are_named_and_an_older_checkpoint_leads_to_the_same_bits() {
    let config = config(Algorithm::Qmix, 6);
    let folder = tempfile::tempdir().unwrap();
    let whole = train(&config, folder.path(), 1, 1).sha256;
    fs::remove_file(folder.path().join("summary.json")).unwrap();
    let newest = episodes(folder.path()).pop().unwrap();
    let mut bytes = fs::read(&newest).unwrap();
    let last = bytes.len() - 1;
    bytes[last] ^= 0x40;
    fs::write(&newest, bytes).unwrap();
    let (again, skipped) = Trainer::resume(&config, folder.path(), 1).unwrap();
    let error = skipped[0].to_string();
    let name = newest.file_name().unwrap().to_str().unwrap();
    assert!(skipped.len() == 1 && error.contains(name) && error.contains("its checksum differs"), "{error}");
    // The damaged file is gone, and is written anew.
    assert!(!newest.exists());
    assert_eq!(drive(again, &config, 1, &never()).sha256, whole);
    assert!(newest.exists());
    // Episodes that every checkpoint needs: nothing to continue from.
    fs::remove_dir_all(folder.path().join("replay")).unwrap();
    let error = Trainer::resume(&config, folder.path(), 1).unwrap_err().to_string();
    assert!(error.contains("none of the 3 checkpoints is usable") && error.contains("replay"), "{error}");
}

#[test]
fn a_buffer_that_does_not_fit_into_memory_is_refused_with_its_size() {
    let mut config = config(Algorithm::Qmix, 2);
    config.qmix.buffer_episodes = 100_000_000;
    let folder = tempfile::tempdir().unwrap();
    let error = Trainer::create(&config, RunId("r".into()), folder.path(), 1).unwrap_err();
    assert!(error.is_usage());
    let text = error.to_string();
    assert!(text.contains("qmix.buffer_episodes: 100000000 episodes take") && text.contains("MiB"), "{text}");
    assert!(!folder.path().join("checkpoints").exists());
}

#[test]
fn drones_choose_every_component_by_its_value() {
    let mut config = off_policy(Algorithm::Maser, small(ExecutorKind::Local, 3, 3));
    let horizon = config.task.horizon;
    config.task = TaskConfig { horizon, ..TaskConfig::of(TaskName::Drones, 3, Spawn::Uniform) };
    config.task.reward_target = RewardTarget::Team;
    let config = config.validated().unwrap();
    assert_eq!(hash(&config, 1, 1), hash(&config, 2, 2));
}

#[test]
fn actors_and_learner_are_killed_and_it_learns_the_same_bits() {
    for algorithm in BOTH {
        let config = config(algorithm, 30);
        let expected = hash(&config, 1, 1);
        let mut cluster = Cluster::start(&config);
        (0..2).for_each(|_| cluster.start_actor());
        let reach = |cluster: &Cluster, count: usize| wait_until("iterations", || cluster.iterations() >= count);
        reach(&cluster, 6);
        cluster.actors.remove(0).kill();
        cluster.start_actor();
        reach(&cluster, 12);
        cluster.learner.kill();
        cluster.resume_learner();
        assert_eq!(cluster.finish(), expected, "{algorithm}");
    }
}
