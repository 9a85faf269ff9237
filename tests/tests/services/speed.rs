//! What the services themselves cost. Run with
//! `cargo test --release -p magex-tests --test services -- --ignored --nocapture`.

use crate::sandbox::*;
use magex_core::ids::{RunId, Shard};
use magex_core::rng::{Key, Purpose};
use magex_core::task::{Spawn, TaskConfig};
use magex_learner::collector::Collector as _;
use magex_learner::serve::validate::{Limits, validate};
use magex_proto::convert::encode_result;
use magex_proto::v1;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use std::time::Instant;

#[tokio::test(flavor = "multi_thread")]
#[ignore = "measures"]
async fn lease_and_ack_of_small_shards() {
    let mut learner = Learner::start().await;
    let actor = Actor::start(&learner.url, "a", FakeWorker::default());
    learner.iterate(0, 100).await.unwrap();
    let shards = 2000;
    let start = Instant::now();
    learner.iterate(1, shards).await.unwrap();
    println!("{:.3} ms per shard, one thread", start.elapsed().as_secs_f64() * 1e3 / f64::from(shards));
    let start = Instant::now();
    let rounds = 500;
    for iteration in 2..2 + rounds {
        learner.iterate(iteration, 1).await.unwrap();
    }
    println!("{:.3} ms per iteration of one shard", start.elapsed().as_secs_f64() * 1e3 / f64::from(rounds));
    actor.stop().await;
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "measures"]
async fn trajectories_of_several_megabytes() {
    let task = TaskConfig::simple_spread(50, Spawn::Uniform);
    let options = LearnerOptions { task: task.clone(), max_episodes: 32, ..LearnerOptions::default() };
    let mut learner = Learner::start_with(options).await;
    let shards: Vec<Shard> = plan(0, 40).into_iter().map(|shard| Shard { episodes: 32, ..shard }).collect();
    let start = Instant::now();
    for shard in &shards {
        std::hint::black_box(result_of(&task, shard, &[0]));
    }
    let work = start.elapsed();
    let (run, result) = (RunId("run".into()), result_of(&task, &shards[0], &[0]));
    let start = Instant::now();
    let encoded = encode_result(&run, "", &result);
    let encoding = start.elapsed();
    let bytes = encoded.len();
    let start = Instant::now();
    validate(&Limits::for_task(&task, 32), &run, encoded).unwrap();
    println!(
        "encoding {:.2} ms, admitting {:.2} ms",
        encoding.as_secs_f64() * 1e3,
        start.elapsed().as_secs_f64() * 1e3
    );
    let actor = Actor::start(&learner.url, "a", FakeWorker { task, ..FakeWorker::default() });
    until(|| learner.handle.status().actors.len() == 1).await;
    learner.collector.publish(&weights(0)).unwrap();
    let start = Instant::now();
    learner.collector.open(shards).unwrap();
    learner.finish().await.unwrap();
    let total = start.elapsed();
    let (mib, count) = (bytes as f64 / f64::from(1 << 20), 40.0);
    println!(
        "{mib:.2} MiB per shard: {:.2} ms each, of which {:.2} ms to make it up; {:.0} MiB/s",
        total.as_secs_f64() * 1e3 / count,
        work.as_secs_f64() * 1e3 / count,
        mib * count / total.as_secs_f64()
    );
    actor.stop().await;
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "measures"]
async fn assignments_of_fifty_agents() {
    let commander = Commander::start("127.0.0.1:0", None).await;
    let channel = magex_runtime::client::endpoint(&commander.url).unwrap().connect().await.unwrap();
    let mut client = CommanderServiceClient::new(channel);
    let mut stream = Key::new(1, Purpose::Bench, &[]).stream();
    let mut points = || {
        let coordinates = (0..100).map(|_| 10.0 * stream.uniform32()).collect();
        Some(v1::Positions { dims: 2, coordinates, array: None })
    };
    let mut times = Vec::new();
    for _ in 0..2000 {
        let scheduler = v1::AssignmentMethod::Exact.into();
        let request = v1::AssignRequest { agents: points(), goals: points(), scheduler, ..Default::default() };
        let start = Instant::now();
        client.assign(request).await.unwrap();
        times.push(start.elapsed().as_secs_f64() * 1e3);
    }
    times.sort_by(f64::total_cmp);
    println!("assign, exact, N = 50: p50 {:.3} ms, p99 {:.3} ms", times[1000], times[1980]);
    commander.stop().await;
}
