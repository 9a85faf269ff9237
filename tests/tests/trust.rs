//! A real learner, a real commander, honest actors, and one that hangs, hears nothing of the commander, or computes what is not so:
//! the run goes on, its weights have the bits of an undisturbed one, and the log names the actor.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex_actor::goal_client::GrpcGoals;
use magex_actor::run::{ActorConfig, ActorError, ActorReport};
use magex_actor::worker::{MakeWorker, PolicyWorker, WorkError, Worker};
use magex_core::config::{Algorithm, ExecutorKind, RunConfig};
use magex_core::ids::{Shard, ShardKind};
use magex_core::metrics_table::SUCCESS_RATE;
use magex_core::trajectory::{ShardResult, Trajectory};
use magex_proto::weights::Weights;
use magex_tests::sandbox::{Cluster, Setup, wait_until};
use magex_tests::{off_policy, small, train};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;
use tokio::runtime::Runtime;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

fn undisturbed(config: &RunConfig) -> String {
    train(config, tempfile::tempdir().unwrap().path(), 1, 1).sha256
}

/// Changes a result; told how many results the actor has made before.
type Spoil = Arc<dyn Fn(&mut ShardResult, u32) + Send + Sync>;

/// Does the work of production, and then something else.
struct Spoiled {
    worker: Box<dyn Worker>,
    spoil: Spoil,
    made: Arc<AtomicU32>,
    delay: Duration,
}

impl Worker for Spoiled {
    fn work(&mut self, shard: &Shard, weights: &Weights, goals: &mut GrpcGoals) -> Result<ShardResult, WorkError> {
        std::thread::sleep(self.delay);
        let mut result = self.worker.work(shard, weights, goals)?;
        (self.spoil)(&mut result, self.made.fetch_add(1, Ordering::SeqCst));
        Ok(result)
    }
}

/// An actor in this process.
struct Played {
    runtime: Runtime,
    running: JoinHandle<Result<ActorReport, ActorError>>,
    made: Arc<AtomicU32>,
}

impl Played {
    fn start(cluster: &Cluster, commander: &str, name: &str, delay: Duration, spoil: Spoil) -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
        let config = ActorConfig {
            learner_url: format!("http://{}", cluster.learner_address()),
            commander_url: format!("http://{commander}"),
            actor_id: name.into(),
            threads: 1,
            expected_task: None,
            client: Default::default(),
            stay: false,
            accepted: CancellationToken::new(),
        };
        let made = Arc::new(AtomicU32::new(0));
        let counter = made.clone();
        let maker: MakeWorker = Arc::new(move |welcome| {
            let worker = Box::new(PolicyWorker::new(welcome)?);
            Ok(Box::new(Spoiled { worker, spoil: spoil.clone(), made: counter.clone(), delay }))
        });
        let running = runtime.spawn(magex_actor::run::run(config, maker, Arc::default(), CancellationToken::new()));
        Self { runtime, running, made }
    }

    fn end(self) -> Result<ActorReport, ActorError> {
        let patience = Duration::from_secs(60);
        let ended = self.runtime.block_on(async { tokio::time::timeout(patience, self.running).await });
        self.runtime.shutdown_background();
        ended.unwrap().unwrap()
    }
}

fn trajectory(change: impl Fn(&mut Trajectory) + Send + Sync + 'static) -> Spoil {
    Arc::new(move |result, _| {
        if let ShardResult::Train(trajectory) = result {
            change(trajectory);
        }
    })
}

/// A learner that has this share of the shards computed a second time.
fn recomputing(share: &str) -> Setup {
    Setup { environment: vec![("MAGEX_RECOMPUTE".to_owned(), PathBuf::from(share))], ..Setup::default() }
}

/// Runs with an actor that spoils its results, alone until it is evicted, and then with an honest one.
fn survives(config: &RunConfig, what: &str, spoil: Spoil, said: &str, recompute: &str) {
    let mut cluster = Cluster::start_with(config, recomputing(recompute));
    let bad = Played::start(&cluster, cluster.commander_address(), "spoiler", Duration::ZERO, spoil);
    let error = bad.end().unwrap_err().to_string();
    assert!(error.contains("evicted this actor") && error.contains(said), "{what}: {error}");
    cluster.start_actor();
    assert_eq!(cluster.finish(), undisturbed(config), "{what}");
    let log = cluster.learner.log();
    assert!(log.contains("spoiler"), "{what} names its sender: {log}");
}

#[test]
fn what_the_task_cannot_give_is_refused_at_the_door() {
    let config = small(ExecutorKind::Local, 5, 3);
    let cases: [(&str, Spoil, &str); 8] = [
        ("positions of 1e30", trajectory(|t| t.positions.fill(1e30)), "trajectory.positions[0]"),
        ("landmarks of 1e30", trajectory(|t| t.statics.0[0].values.fill(1e30)), "trajectory.statics.landmarks[0]"),
        ("positions of 1e18", trajectory(|t| t.positions[3] = 1e18), "trajectory.positions[3]"),
        ("velocities of 3e38", trajectory(|t| t.velocities[9] = 3e38), "trajectory.velocities[9]"),
        ("rewards of 1e20", trajectory(|t| t.rewards.fill(1e20)), "trajectory.rewards[0]"),
        ("costs of 3e38", trajectory(|t| t.costs.fill(3e38)), "trajectory.costs[0]"),
        ("an exact cost of 0", trajectory(|t| t.exact_costs.fill(0.0)), "trajectory.exact_costs[0]"),
        ("a mean that is none", trajectory(|t| t.metrics[0].0[SUCCESS_RATE] = 7.0), "success_rate"),
    ];
    for (what, spoil, said) in cases {
        survives(&config, what, spoil, said, "0");
    }
}

#[test]
fn log_probabilities_that_the_weights_do_not_give_are_kept_in_quarantine() {
    for (kind, recurrent) in [(ExecutorKind::Local, false), (ExecutorKind::Flat, true)] {
        let mut config = small(kind, 5, 3);
        config.executor.recurrent = recurrent;
        let invented = trajectory(|t| t.log_probs.iter_mut().for_each(|x| *x = -1.0 - *x * 0.01));
        survives(&config, "log-probabilities", invented, "log_probs: differs by", "0");
        // One unit in the last place.
        let bit = trajectory(|t| t.log_probs.iter_mut().for_each(|x| *x = f32::from_bits(x.to_bits() ^ 1)));
        survives(&config, "the last bit", bit, "log_probs: differs by", "0");
    }
    let config = small(ExecutorKind::Local, 5, 3);
    let other = trajectory(|t| t.actions.iter_mut().for_each(|action| *action = 4 - *action));
    survives(&config, "other actions", other, "log_probs: differs by", "0");
    let goals = trajectory(|t| t.goal_log_probs.fill(-3e38));
    let mut cluster = Cluster::start_with(&config, recomputing("0"));
    let bad = Played::start(&cluster, cluster.commander_address(), "spoiler", Duration::ZERO, goals);
    assert!(bad.end().unwrap_err().to_string().contains("goal_log_probs"));
    let mut kept = std::fs::read_dir(cluster.run().join("quarantine")).unwrap().map(|entry| entry.unwrap().path());
    let about = kept.find(|path| path.extension().is_some_and(|ending| ending == "json")).expect("a file");
    let about: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(about).unwrap()).unwrap();
    assert_eq!(about["actor"], "spoiler");
    assert!(about["reason"].as_str().unwrap().starts_with("goal_log_probs: differs"), "{about}");
    cluster.start_actor();
    assert_eq!(cluster.finish(), undisturbed(&config));
}

/// What a learner with a replay buffer recomputes: the best actions by its values, and the draws of each episode's stream.
#[test]
fn actions_that_the_values_do_not_give_are_refused_without_log_probabilities_too() {
    let config = off_policy(Algorithm::Qmix, small(ExecutorKind::Local, 4, 3));
    let all = trajectory(|t| t.actions.iter_mut().for_each(|action| *action = 4 - *action));
    survives(&config, "other actions", all, "actions: differs by", "0");
    let one = trajectory(|t| *t.actions.last_mut().unwrap() = (t.actions.last().unwrap() + 1) % 5);
    survives(&config, "one other action", one, "actions: differs by", "0");
}

/// One unit in the last place of one reward, from some result on.
fn ulp_after(results: u32) -> Spoil {
    Arc::new(move |result, made| match result {
        ShardResult::Train(trajectory) if made >= results => {
            let reward = &mut trajectory.rewards[0];
            *reward = f32::from_bits(reward.to_bits() + 1);
        }
        _ => {}
    })
}

#[test]
fn a_newcomer_is_checked_even_if_it_is_alone() {
    let config = small(ExecutorKind::Local, 5, 4);
    survives(&config, "one unit in the last place", ulp_after(0), "another computation of it", "0.01");
}

#[test]
fn an_actor_that_begins_to_compute_wrongly_is_found_and_the_run_goes_back() {
    let mut config = small(ExecutorKind::Local, 5, 60);
    config.run.checkpoint_every = 1;
    // Often enough for a short test.
    let mut cluster = Cluster::start_with(&config, recomputing("0.1"));
    cluster.start_actor();
    let delay = Duration::from_millis(5);
    let bad = Played::start(&cluster, cluster.commander_address(), "spoiler", delay, ulp_after(20));
    let made = bad.made.clone();
    let error = bad.end().expect_err("it is found").to_string();
    assert!(error.contains("another computation of it"), "{error}");
    assert!(made.load(Ordering::SeqCst) > 20, "it was honest at first");
    assert_eq!(cluster.finish(), undisturbed(&config));
    let log = cluster.learner.log();
    assert!(log.contains("an actor computes wrong results") && log.contains("spoiler"), "{log}");
    let lines = std::fs::read_to_string(cluster.run().join("metrics.jsonl")).unwrap();
    let numbers: Vec<u64> = lines
        .lines()
        .map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap()["iteration"].as_u64().unwrap())
        .collect();
    assert_eq!(numbers, (0..=60).collect::<Vec<u64>>(), "one line per iteration, although the run went back");
}

#[test]
fn an_evaluation_that_would_end_the_run_is_computed_twice() {
    let mut config = small(ExecutorKind::Local, 5, 6);
    config.run.target_success = 0.995;
    // Beyond its first results nothing but the end of the run makes the learner look.
    let mut cluster = Cluster::start_with(&config, recomputing("0.000001"));
    let success: Spoil = Arc::new(|result, made| {
        if let ShardResult::Eval(outcome) = result
            && made > 6
        {
            outcome.metrics.iter_mut().for_each(|episode| episode[SUCCESS_RATE] = 1.0);
        }
    });
    let bad = Played::start(&cluster, cluster.commander_address(), "spoiler", Duration::ZERO, success);
    let error = bad.end().expect_err("it is found").to_string();
    assert!(error.contains("eval shard"), "{error}");
    cluster.start_actor();
    assert_eq!(cluster.finish(), undisturbed(&config));
    let summary = std::fs::read_to_string(cluster.run().join("summary.json")).unwrap();
    assert!(summary.contains("\"target_reached\":false"), "{summary}");
}

#[test]
fn an_actor_that_hangs_stops_nothing_is_named_and_ends_itself() {
    let config = small(ExecutorKind::Local, 5, 40);
    let mut cluster = Cluster::start_with(&config, Setup { lease: 1.0, ..Setup::default() });
    let hang: Spoil = Arc::new(|result, made| {
        if made >= 8 && result.shard().kind == ShardKind::Train {
            std::thread::sleep(Duration::from_secs(3600));
        }
    });
    let hung = Played::start(&cluster, cluster.commander_address(), "hung", Duration::ZERO, hang);
    wait_until("the first results", || hung.made.load(Ordering::SeqCst) >= 9 || cluster.iterations() > 2);
    cluster.start_actor();
    cluster.start_actor();
    assert_eq!(cluster.finish(), undisturbed(&config));
    let error = hung.end().err().map(|error| error.to_string());
    // The run may be over before the actor has waited for eight leases.
    assert!(error.as_ref().is_none_or(|error| error.contains("it hangs")), "{error:?}");
}

#[test]
fn an_actor_without_a_commander_does_not_slow_the_others_down() {
    // A run that waited for its leases of 15 s would take ten minutes.
    let config = small(ExecutorKind::Local, 5, 40);
    let mut cluster = Cluster::start_with(&config, Setup { lease: 15.0, ..Setup::default() });
    let lost = Played::start(&cluster, "127.0.0.1:1", "lost", Duration::ZERO, Arc::new(|_, _| {}));
    wait_until("it to hold a shard", || cluster.status().is_some_and(|status| status.ledger.unwrap().outstanding > 0));
    cluster.start_actor();
    cluster.start_actor();
    assert_eq!(cluster.finish(), undisturbed(&config));
    lost.running.abort();
    lost.runtime.shutdown_background();
}

/// Iterations per second of a run whose rollouts are the bottleneck: 12 shards per iteration, each of which takes 100 ms longer than
/// it would. `actors` are started before the clock runs; `spoil` belongs to the first of them, as does its commander.
fn pace(actors: usize, spoil: &Spoil, commander: Option<&str>, lease: f64, seconds: u64) -> f64 {
    let mut config = small(ExecutorKind::Local, 5, 100_000);
    (config.collect.episodes_per_iteration, config.collect.shards_per_iteration) = (12, 12);
    (config.run.max_steps, config.run.eval_every) = (1_000_000_000, 100_000);
    let cluster = Cluster::start_with(&config, Setup { lease, ..Setup::default() });
    let played: Vec<Played> = (0..actors)
        .map(|number| {
            let first = number == 0;
            let commander = commander.filter(|_| first).unwrap_or(cluster.commander_address());
            let spoil = if first { spoil.clone() } else { Arc::new(|_: &mut ShardResult, _| {}) };
            Played::start(&cluster, commander, &format!("actor-{number}"), Duration::from_millis(100), spoil)
        })
        .collect();
    wait_until("the first iterations", || cluster.iterations() >= 6);
    let (before, clock) = (cluster.iterations(), std::time::Instant::now());
    std::thread::sleep(Duration::from_secs(seconds));
    let pace = (cluster.iterations() - before) as f64 / clock.elapsed().as_secs_f64();
    drop(cluster);
    played.into_iter().for_each(|actor| actor.runtime.shutdown_background());
    pace
}

/// `cargo test --release -p magex-tests --test trust -- --ignored --nocapture`
#[test]
#[ignore = "a measurement of five minutes"]
fn what_a_bad_actor_costs_the_others() {
    let honest: Spoil = Arc::new(|_, _| {});
    let hang: Spoil = Arc::new(|_, made| {
        if made >= 20 {
            std::thread::sleep(Duration::from_secs(3600));
        }
    });
    for round in 1..=3 {
        let three = pace(3, &honest, None, 15.0, 20);
        let hung = pace(3, &hang, None, 15.0, 20);
        let two = pace(2, &honest, None, 15.0, 20);
        let lost = pace(3, &honest, Some("127.0.0.1:1"), 15.0, 60);
        println!(
            "round {round}: three healthy {three:.2} iterations/s; one of three hangs {hung:.2} ({:.2} of three); two healthy \
             {two:.2}; a third without a commander {lost:.2} ({:.2} of two)",
            hung / three,
            lost / two
        );
    }
}
