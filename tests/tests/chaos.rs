//! Minutes of chaos with real processes; not part of a plain `cargo test`: `cargo test -p magex-tests --test chaos`.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex_core::config::{ExecutorKind, RunConfig};
use magex_core::rng::{Key, Purpose};
use magex_learner::trainer::TrainOutcome;
use magex_tests::proxy::Faults;
use magex_tests::sandbox::{Cluster, Setup, wait_until};
use magex_tests::{small, train};
use std::time::{Duration, Instant};

fn undisturbed(config: &RunConfig) -> String {
    train(config, tempfile::tempdir().unwrap().path(), 1, 1).sha256
}

/// Enough that a fast machine is not at the end of the run before [`LEAST_ROUNDS`].
const ITERATIONS: u64 = 1000;
/// Rounds of events that a run must have seen.
const LEAST_ROUNDS: usize = 8;

/// What may happen in a round.
#[derive(Debug, Clone, Copy)]
enum Event {
    KillActor,
    KillLearner,
    KillCommander,
    StopLearnerAndResume,
    FreezeActor,
    FreezeLearner,
    FreezeCommander,
    Network(Faults),
    Reset,
}

#[test]
fn whatever_happens_in_whatever_order_the_bits_are_the_same() {
    let config = small(ExecutorKind::Local, 5, ITERATIONS);
    let expected = undisturbed(&config);
    let none = Faults::default();
    let events = [
        Event::KillActor,
        Event::KillLearner,
        Event::KillCommander,
        Event::StopLearnerAndResume,
        Event::FreezeActor,
        Event::FreezeLearner,
        Event::FreezeCommander,
        Event::Network(Faults { delay: Duration::from_millis(30), ..none }),
        Event::Network(Faults { corrupt_every: Some(80_000), ..none }),
        Event::Network(Faults { drop_every: Some(80_000), ..none }),
        Event::Network(Faults { bytes_per_second: Some(300_000), ..none }),
        Event::Network(Faults { mute: true, ..none }),
        Event::Reset,
    ];
    for seed in [1, 2] {
        let mut stream = Key::new(seed, Purpose::Request, &[]).stream();
        let mut cluster = Cluster::start_with(&config, Setup { lease: 1.0, wires: Some(seed), ..Setup::default() });
        (0..3).for_each(|_| cluster.start_actor());
        let mut told = Vec::new();
        for round in 0..12 {
            cluster.wait_for_iteration(2 + 2 * round);
            // One thing, or two at a time.
            let count = 1 + stream.bits32() % 2;
            let frozen: Vec<Event> = (0..count).map(|_| events[stream.bits32() as usize % events.len()]).collect();
            told.push(frozen.clone());
            for &event in &frozen {
                begin(&mut cluster, event, stream.bits32() as usize);
            }
            std::thread::sleep(Duration::from_millis(u64::from(stream.bits32() % 3000)));
            for &event in &frozen {
                end(&mut cluster, event);
            }
            // Actors outlive everything but a kill; they end, with success, when the run is at its end.
            let gone: Vec<usize> = (0..3).filter(|&actor| !cluster.actors[actor].running()).collect();
            if gone.is_empty() {
                continue;
            }
            for actor in gone {
                let status = cluster.actors[actor].wait();
                assert!(status.success(), "seed {seed}: {status} after {told:?}:\n{}", cluster.actors[actor].log());
            }
            // The run was faster than the events; were it not at its end, it would not finish without actors.
            break;
        }
        println!("seed {seed}: {} rounds, then iteration {} of {ITERATIONS}", told.len(), cluster.iterations());
        assert_eq!(cluster.finish(), expected, "seed {seed}: {told:?}");
        assert!(
            told.len() >= LEAST_ROUNDS,
            "seed {seed}: the run was over after {} rounds; raise ITERATIONS",
            told.len()
        );
    }
}

fn begin(cluster: &mut Cluster, event: Event, which: usize) {
    match event {
        Event::KillActor => {
            let which = which % cluster.actors.len();
            cluster.actors.remove(which).kill();
            cluster.start_actor();
        }
        Event::KillLearner => {
            // A fast run may be at its end already; then there is nothing to resume.
            if cluster.learner.running() {
                cluster.learner.kill();
                cluster.resume_learner();
            }
        }
        Event::KillCommander => {
            cluster.commander.take().unwrap().kill();
            cluster.start_commander();
        }
        Event::StopLearnerAndResume => {
            // It may be frozen by the other event of the round.
            cluster.learner.signal("CONT");
            cluster.learner.signal("TERM");
            let status = cluster.learner.wait();
            if !status.success() {
                assert_eq!(status.code(), Some(75), "{}", cluster.learner.log());
                cluster.resume_learner();
            }
        }
        Event::FreezeActor => cluster.actors[0].signal("STOP"),
        Event::FreezeLearner => cluster.learner.signal("STOP"),
        Event::FreezeCommander => cluster.commander.as_ref().unwrap().signal("STOP"),
        Event::Network(faults) => cluster.wires().all().iter().for_each(|wire| wire.set(faults)),
        Event::Reset => cluster.wires().all().iter().for_each(|wire| wire.reset()),
    }
}

fn end(cluster: &mut Cluster, event: Event) {
    match event {
        Event::FreezeActor => cluster.actors.iter().for_each(|actor| actor.signal("CONT")),
        Event::FreezeLearner => cluster.learner.signal("CONT"),
        Event::FreezeCommander => cluster.commander.as_ref().unwrap().signal("CONT"),
        Event::Network(_) => cluster.wires().all().iter().for_each(|wire| wire.set(Faults::default())),
        _ => {}
    }
}

#[test]
fn stranded_connections_are_given_up_by_both_sides_and_made_anew() {
    let config = small(ExecutorKind::Local, 5, 60);
    let mut cluster = Cluster::start_with(&config, Setup { wires: Some(3), ..Setup::default() });
    cluster.start_actor();
    cluster.start_actor();
    cluster.wait_for_iteration(4);
    // No end is notified. The pings of both ends detect it; the streams of weights carry nothing else.
    let before: usize = cluster.wires().all().iter().map(|wire| wire.accepted()).sum();
    cluster.wires().all().iter().for_each(|wire| wire.strand());
    assert_eq!(cluster.finish(), undisturbed(&config));
    let after: usize = cluster.wires().all().iter().map(|wire| wire.accepted()).sum();
    assert!(after >= before + 5, "two connections of each actor and that of the commander: {before}, then {after}");
}

#[test]
fn it_learns_through_one_actor_crash_every_two_seconds_or_sooner() {
    let mut config = small(ExecutorKind::Magex, 6, 2000);
    config.task.horizon = 40;
    (config.run.target_success, config.run.eval_every, config.run.eval_episodes) = (0.95, 5, 32);
    // Slow enough to be disturbed on the way.
    config.mappo.actor_learning_rate = 1e-5;
    let config = config.validated().unwrap();
    let calm = tempfile::tempdir().unwrap();
    let calm = train(&config, calm.path(), 1, 1);
    let TrainOutcome::Finished(summary) = &calm.outcome else { panic!("not finished") };
    // A fast machine is at the end before the third crash in time: then as many iterations count.
    let often = (summary.iterations / 6).max(1);
    let mut cluster = Cluster::start_with(&config, Setup { lease: 1.0, ..Setup::default() });
    cluster.start_actor();
    cluster.start_actor();
    let (start, mut crashes) = (Instant::now(), 0);
    let (mut due, mut next) = (Duration::from_secs(2), often);
    wait_until("the target", || {
        std::thread::sleep(Duration::from_millis(20));
        let iteration = cluster.status().map_or(0, |status| status.iteration);
        if (start.elapsed() >= due || iteration >= next) && cluster.learner.running() {
            cluster.actors.remove(0).kill();
            cluster.start_actor();
            crashes += 1;
            (due, next) = (start.elapsed() + Duration::from_secs(2), iteration + often);
        }
        !cluster.learner.running()
    });
    println!("{crashes} crashes in {} iterations", summary.iterations);
    assert_eq!(cluster.finish(), calm.sha256);
    let text = std::fs::read_to_string(cluster.run().join("summary.json")).unwrap();
    let summary: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!(summary["target_reached"], true, "{text}");
    assert!(crashes >= 3, "it was over after {crashes} crashes");
}

#[test]
fn a_stop_in_a_long_update_is_obeyed_within_ten_seconds_and_costs_no_bit() {
    // How long an update is, is up to the machine: twice as long until a stop cuts one off.
    for larger in [1_u32, 2, 4, 8, 16] {
        let mut config = small(ExecutorKind::Magex, 6, 2 * u64::from(larger));
        config.collect.episodes_per_iteration *= larger;
        config.mappo.epochs = 400;
        let mut cluster = Cluster::start(&config);
        cluster.start_actor();
        wait_until("an update", || {
            cluster.status().is_some_and(|status| status.state() == magex_proto::v1::RunState::Training)
        });
        cluster.actors[0].signal("STOP");
        cluster.learner.signal("TERM");
        let (status, _) = cluster.learner.wait_within(Duration::from_secs(10));
        let log = cluster.learner.log();
        assert_eq!(status.code(), Some(75), "{log}");
        if log.contains("the iteration did not end in time") {
            println!("cut off: an update {larger} times as long as the first");
            cluster.actors[0].signal("CONT");
            cluster.resume_learner();
            assert_eq!(cluster.finish(), undisturbed(&config));
            return;
        }
    }
    panic!("no update was long enough to be cut off");
}
