//! The nemesis: faults of every kind, drawn from a seed, against a training and eight clients of missions at once.
//!
//! ```sh
//! MAGEX_NEMESIS_MINUTES=60 MAGEX_NEMESIS_SEED=1 cargo test --release -p magex-tests --test nemesis -- --nocapture
//! ```
//!
//! Without variables it takes 3 minutes and seed 1. The seed decides the order of the faults, the machine their timing. In the first
//! half processes are killed, too; in the second half they live, and their memory is watched. It fails unless
//! - the weights are those of an undisturbed run of as many iterations, and metrics.jsonl has each line once;
//! - every ledger balances, whenever it is asked and at every end of a learner;
//! - the missions are what the acknowledged calls made them, and calls without an answer may have;
//! - no iteration takes longer than ten seconds unless a log gives a reason;
//! - no process panics; and in an hour or more, no memory grows by more than 1 MiB an hour.
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "a test that reports"
)]

mod faults;
mod history;
mod watch;

use faults::{Fault, Target};
use magex_core::config::{ExecutorKind, RunConfig};
use magex_core::rng::{Key, Purpose};
use magex_core::sha256;
use magex_learner::checkpoint;
use magex_learner::trainer::Trainer;
use magex_tests::sandbox::wait_until;
use magex_tests::{small, train};
use std::path::Path;
use std::time::{Duration, Instant};
use tokio_util::sync::CancellationToken;

const CLIENTS: u32 = 8;

fn number(variable: &str, otherwise: u64) -> u64 {
    std::env::var(variable).map_or(otherwise, |text| text.parse().unwrap_or_else(|_| panic!("{variable}: {text}")))
}

/// More iterations than there is time for.
fn config(iterations: u64) -> RunConfig {
    small(ExecutorKind::Local, 5, iterations)
}

#[test]
fn the_nemesis_finds_nothing() {
    let (minutes, seed) = (number("MAGEX_NEMESIS_MINUTES", 3), number("MAGEX_NEMESIS_SEED", 1));
    let time = Duration::from_secs(60 * minutes);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    let mut target = Target::start(&config(10_000_000), minutes);
    let url = format!("http://{}", target.cluster.commander_address());
    let (stop, start) = (CancellationToken::new(), Instant::now());
    let clients: Vec<_> = (0..CLIENTS)
        .map(|number| {
            let client = runtime.block_on(history::Client::start(&url, seed, number));
            runtime.spawn(client.run(stop.clone()))
        })
        .collect();
    let mut stream = Key::new(seed, Purpose::Spawn, &[]).stream();
    let faults = Fault::ALL;
    let mut told = std::collections::BTreeMap::<&str, u32>::new();
    while start.elapsed() < time {
        let calm = start.elapsed() > time / 2;
        let all: Vec<&Fault> = faults.iter().filter(|fault| target.can(fault) && !(calm && fault.kills())).collect();
        let fault = all[stream.below(all.len() as u32) as usize];
        *told.entry(fault.name()).or_default() += 1;
        println!("{:>6.1} s: {}", start.elapsed().as_secs_f64(), fault.name());
        if calm {
            target.watch_memory();
        }
        target.afflict(fault, &mut stream, &runtime);
        target.live(Duration::from_millis(1000 + u64::from(stream.below(3000))));
        // A client that found a violation has ended.
        assert!(!clients.iter().any(|client| client.is_finished()), "seed {seed}: a client's history is violated");
    }
    // In peace it goes on at once.
    let reached = target.cluster.status().map_or(0, |status| status.iteration);
    wait_until("five more iterations", || {
        target.live(Duration::from_millis(200));
        target.cluster.status().is_some_and(|status| status.iteration >= reached + 5)
    });
    stop.cancel();
    let clients = clients.into_iter().map(|client| runtime.block_on(client).unwrap()).collect();
    let (acknowledged, unanswered) = runtime.block_on(history::check(clients, &url));
    let summary = target.finish();
    println!("seed {seed}, {minutes} min: {told:?}");
    println!("missions: {acknowledged} acknowledged, {unanswered} without an answer, 0 violations");
    println!("{summary}");
    let run = target.cluster.run();
    for (what, run) in [("training", run), ("supervised training", target.supervised())] {
        if run.exists() {
            println!("{what}: {} iterations, the weights of an undisturbed run", verify(&run));
        }
    }
    if minutes >= 60 {
        target.check_memory(1.0);
    }
}

/// The newest checkpoint of a run is that of an undisturbed one, and its lines are whole. Returns the iterations.
fn verify(run: &Path) -> u32 {
    let template =
        Trainer::create(&config(1), magex_core::ids::RunId("r".into()), tempfile::tempdir().unwrap().path(), 1);
    let (progress, learned, skipped) = checkpoint::read_latest(run, template.unwrap().learned()).unwrap();
    assert!(skipped.is_empty(), "{skipped:?}");
    if progress.iteration == 0 {
        return 0;
    }
    let undisturbed = train(&config(progress.iteration.into()), tempfile::tempdir().unwrap().path(), 1, 1).sha256;
    assert_eq!(sha256::hex(&learned.weights().unwrap()), undisturbed, "{}", run.display());
    let text = std::fs::read_to_string(run.join("metrics.jsonl")).unwrap();
    let number = |line: &str| serde_json::from_str::<serde_json::Value>(line).unwrap()["iteration"].as_u64().unwrap();
    let lines: Vec<u64> = text.lines().map(number).collect();
    assert_eq!(lines, (0..u64::from(progress.iteration)).collect::<Vec<_>>(), "{}", run.display());
    progress.iteration
}
