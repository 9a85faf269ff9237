//! Real processes, real signals: whatever dies, the weights are the same bits as those of an undisturbed run in one process.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex_core::config::{ExecutorKind, RunConfig};
use magex_core::task::{Spawn, TaskName};
use magex_tests::sandbox::{Cluster, wait_until};
use magex_tests::{small, small_task, train};

fn undisturbed(config: &RunConfig) -> String {
    train(config, tempfile::tempdir().unwrap().path(), 1, 1).sha256
}

/// Long enough to be disturbed in the middle.
fn long() -> RunConfig {
    small(ExecutorKind::Local, 5, 40)
}

fn wait_for(cluster: &Cluster, iterations: usize) {
    wait_until(&format!("{iterations} iterations"), || cluster.iterations() >= iterations);
}

#[test]
fn one_actor_two_actors_and_one_process_learn_the_same_bits() {
    for kind in [ExecutorKind::Magex, ExecutorKind::Local, ExecutorKind::Flat, ExecutorKind::Mat, ExecutorKind::Dicg] {
        let config = small(kind, 6, 4);
        let expected = undisturbed(&config);
        for actors in [1, 2] {
            let mut cluster = Cluster::start(&config);
            (0..actors).for_each(|_| cluster.start_actor());
            assert_eq!(cluster.finish(), expected, "{kind} with {actors} actors");
            for actor in &mut cluster.actors {
                assert!(actor.wait().success(), "an actor ends well when the run is done:\n{}", actor.log());
            }
        }
    }
}

#[test]
fn every_task_learns_the_same_bits_with_one_actor_two_actors_and_in_one_process() {
    for name in [TaskName::PushBall, TaskName::Drones] {
        let config = small_task(name, ExecutorKind::Magex, 4, 3);
        let expected = undisturbed(&config);
        for actors in [1, 2] {
            let mut cluster = Cluster::start(&config);
            (0..actors).for_each(|_| cluster.start_actor());
            assert_eq!(cluster.finish(), expected, "{name} with {actors} actors");
        }
    }
}

#[test]
fn every_service_has_the_memory_settings_that_it_needs() {
    let mut cluster = Cluster::start(&small(ExecutorKind::Magex, 5, 40));
    cluster.start_actor();
    wait_for(&cluster, 1);
    for process in [&cluster.learner, cluster.commander.as_ref().unwrap(), &cluster.actors[0]] {
        // With huge pages it would be larger by half, an hour later.
        assert_eq!(process.told("THP_enabled"), "0", "{}", process.log());
        let memory = ["MALLOC_ARENA_MAX", "MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_"];
        for name in memory.into_iter().chain(["CANDLE_NUM_THREADS", "RAYON_NUM_THREADS"]) {
            assert!(process.has_variable(name), "{name}: {}", process.log());
        }
    }
}

#[test]
fn an_actor_that_is_killed_and_replaced_changes_nothing() {
    let config = long();
    let mut cluster = Cluster::start(&config);
    cluster.start_actor();
    cluster.start_actor();
    for round in 1..=3 {
        wait_for(&cluster, 8 * round);
        cluster.actors.remove(0).kill();
        cluster.start_actor();
    }
    assert_eq!(cluster.finish(), undisturbed(&config));
}

#[test]
fn an_actor_that_freezes_loses_its_lease_and_changes_nothing() {
    let config = long();
    let mut cluster = Cluster::start(&config);
    cluster.start_actor();
    cluster.start_actor();
    wait_for(&cluster, 5);
    cluster.actors[0].signal("STOP");
    let reached = cluster.iterations();
    // The other actor carries on once the lease of the frozen one is over.
    wait_until("training to go on without it", || cluster.iterations() >= reached + 5 || !cluster.learner.running());
    cluster.actors[0].signal("CONT");
    assert_eq!(cluster.finish(), undisturbed(&config));
}

#[test]
fn a_learner_that_is_killed_resumes_while_the_actors_live_on() {
    let config = long();
    let mut cluster = Cluster::start(&config);
    cluster.start_actor();
    cluster.start_actor();
    for round in 1..=2 {
        wait_for(&cluster, 10 * round);
        cluster.learner.kill();
        assert!(cluster.actors.iter_mut().all(|actor| actor.running()), "actors outlive their learner");
        cluster.resume_learner();
    }
    assert_eq!(cluster.finish(), undisturbed(&config));
    assert!(cluster.actors.iter_mut().all(|actor| actor.wait().success()));
}

#[test]
fn a_learner_that_is_told_to_stop_leaves_a_run_that_resumes() {
    let config = long();
    let mut cluster = Cluster::start(&config);
    cluster.start_actor();
    wait_for(&cluster, 5);
    cluster.learner.signal("TERM");
    let status = cluster.learner.wait();
    assert_eq!(status.code(), Some(75), "stopped early:\n{}", cluster.learner.log());
    cluster.resume_learner();
    assert_eq!(cluster.finish(), undisturbed(&config));
}

#[test]
fn a_commander_that_dies_for_a_while_is_waited_for() {
    let config = long();
    let mut cluster = Cluster::start(&config);
    // The actors come first, then the commander goes away and comes back: they wait, they do not fail.
    cluster.start_actor();
    cluster.start_actor();
    for round in 1..=2 {
        wait_for(&cluster, 8 * round);
        cluster.commander.take().unwrap().kill();
        std::thread::sleep(std::time::Duration::from_millis(300));
        cluster.start_commander();
    }
    assert_eq!(cluster.finish(), undisturbed(&config));
}

#[test]
fn an_actor_for_another_task_is_refused_with_both_sides_named() {
    let mut cluster = Cluster::start(&small(ExecutorKind::Local, 5, 3));
    let mut other = small(ExecutorKind::Local, 5, 3);
    other.task.spawn = Spawn::Lines(None);
    let file = cluster.run().with_file_name("other.toml");
    std::fs::write(&file, other.to_toml().unwrap()).unwrap();
    cluster.start_actor_with(&["--config", file.to_str().unwrap()]);
    let actor = &mut cluster.actors[0];
    assert!(!actor.wait().success());
    let log = actor.log();
    assert!(log.contains(&other.task.fingerprint()), "{log}");
    assert!(log.contains(&small(ExecutorKind::Local, 5, 3).task.fingerprint()), "{log}");
    // The other processes are not disturbed.
    cluster.start_actor();
    cluster.finish();
}
