//! Each part of the cluster is slowed down in turn, and the reported bottleneck follows.
#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use magex_actor::goal_client::GrpcGoals;
use magex_actor::run::ActorConfig;
use magex_actor::worker::{MakeWorker, PolicyWorker, WorkError, Worker};
use magex_commander::run_scheduler::load_scheduler;
use magex_commander::service::ServiceConfig;
use magex_core::config::{ExecutorKind, RunConfig};
use magex_core::ids::{RunId, Shard};
use magex_core::trajectory::ShardResult;
use magex_learner::run_identity::RunIdentity;
use magex_learner::serve::service::learner_service;
use magex_learner::serve::validate::Limits;
use magex_learner::trainer::Trainer;
use magex_proto::weights::Weights;
use magex_runtime::server;
use magex_tests::{small, train};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio_util::sync::CancellationToken;

/// Passes on bytes no faster than this.
async fn throttled(mut from: OwnedReadHalf, mut to: OwnedWriteHalf, bytes_per_second: f64) {
    let mut buffer = [0u8; 1024];
    while let Ok(count @ 1..) = from.read(&mut buffer).await {
        tokio::time::sleep(Duration::from_secs_f64(count as f64 / bytes_per_second)).await;
        if to.write_all(&buffer[..count]).await.is_err() {
            return;
        }
    }
}

/// A narrow road to this address.
async fn relay(to: SocketAddr, bytes_per_second: f64) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    tokio::spawn(async move {
        while let Ok((near, _)) = listener.accept().await {
            let far = TcpStream::connect(to).await.unwrap();
            let ((near_in, near_out), (far_in, far_out)) = (near.into_split(), far.into_split());
            tokio::spawn(throttled(near_in, far_out, bytes_per_second));
            tokio::spawn(throttled(far_in, near_out, bytes_per_second));
        }
    });
    address
}

/// Does the work of production, late.
struct Late {
    worker: Box<dyn Worker>,
    delay: Duration,
}

impl Worker for Late {
    fn work(&mut self, shard: &Shard, weights: &Weights, goals: &mut GrpcGoals) -> Result<ShardResult, WorkError> {
        std::thread::sleep(self.delay);
        self.worker.work(shard, weights, goals)
    }
}

fn late(delay: Duration) -> MakeWorker {
    Arc::new(move |welcome| Ok(Box::new(Late { worker: Box::new(PolicyWorker::new(welcome)?), delay })))
}

/// Trains with one actor on one thread; the bottleneck of each iteration but the first, which waits for the actor, and the
/// hash of the weights.
fn bottlenecks(config: &RunConfig, delay: Duration, bytes_per_second: Option<f64>) -> (Vec<String>, String) {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let mut trainer = Trainer::create(config, RunId("test".into()), folder.path(), 1).unwrap();
    let identity = RunIdentity {
        run_id: RunId("test".into()),
        name: "test".into(),
        task_fingerprint: config.task.fingerprint(),
        run_config_toml: config.to_toml().unwrap(),
        seed: config.run.seed,
        lease: Duration::from_secs(60),
    };
    let (handle, mut collector) = learner_service(identity, Limits::for_task(&config.task, 64));
    let stop = CancellationToken::new();
    runtime.block_on(async {
        let (incoming, learner) = server::bind("127.0.0.1:0").await.unwrap();
        let (served, token) = (handle.clone(), stop.clone());
        tokio::spawn(async move { served.serve(incoming, token).await });
        let (incoming, commander) = server::bind("127.0.0.1:0").await.unwrap();
        let learner_url = Some(format!("http://{learner}"));
        let config = ServiceConfig { learner_url, ..ServiceConfig::default() };
        tokio::spawn(magex_commander::service::run(config, load_scheduler, incoming, stop.clone()));
        let learner = match bytes_per_second {
            Some(rate) => relay(learner, rate).await,
            None => learner,
        };
        let actor = ActorConfig {
            learner_url: format!("http://{learner}"),
            commander_url: format!("http://{commander}"),
            actor_id: "actor".into(),
            threads: 1,
            expected_task: None,
            client: Default::default(),
            stay: false,
            accepted: tokio_util::sync::CancellationToken::new(),
        };
        tokio::spawn(magex_actor::run::run(actor, late(delay), Arc::default(), stop.clone()));
    });
    trainer.run(&mut collector).unwrap();
    stop.cancel();
    let lines = std::fs::read_to_string(folder.path().join("metrics.jsonl")).unwrap();
    let lines: Vec<serde_json::Value> = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    for line in &lines {
        let seconds = |name: &str| line["timing"]["bottleneck"][name].as_f64().unwrap();
        let collect = line["timing"]["collect_s"].as_f64().unwrap();
        assert!((seconds("actor_s") + seconds("network_s") - collect).abs() < 1e-6, "{line}");
    }
    let trained = lines.iter().skip(1).filter(|line| !line["executor"].is_null());
    let stages = trained.map(|line| line["timing"]["bottleneck"]["stage"].as_str().unwrap().to_owned()).collect();
    let weights = trainer.learned().weights().unwrap();
    runtime.shutdown_background();
    (stages, magex_core::sha256::hex(&weights))
}

/// Most of the iterations say so: what else runs on the machine may blur one.
fn check(config: &RunConfig, delay: Duration, bytes_per_second: Option<f64>, expected: &str) -> String {
    let (by, sha256) = bottlenecks(config, delay, bytes_per_second);
    let said = by.iter().filter(|by| *by == expected).count();
    assert!(2 * said > by.len(), "{expected} was expected: {by:?}");
    sha256
}

#[test]
fn the_bottleneck_is_the_slow_stage_and_changes_no_number() {
    let quick = small(ExecutorKind::Local, 5, 4);
    let mut thorough = quick.clone();
    thorough.mappo.epochs = 150;
    let slow_worker = check(&quick, Duration::from_millis(500), None, "actor");
    let slow_network = check(&quick, Duration::ZERO, Some(16_000.0), "network");
    check(&thorough, Duration::ZERO, None, "learner");
    let undisturbed = train(&quick, tempfile::tempdir().unwrap().path(), 1, 1).sha256;
    assert_eq!([slow_worker, slow_network], [undisturbed.clone(), undisturbed]);
}
