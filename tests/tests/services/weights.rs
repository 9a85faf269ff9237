//! Weights reach every subscriber, and none waits for the slowest.

use crate::sandbox::*;
use bytes::Bytes;
use magex_core::ids::{RunId, WeightsVersion};
use magex_learner::collector::Collector as _;
use magex_learner::run_events::CollectError;
use magex_proto::v1;
use magex_proto::weights::{Weights, WeightsAssembler};
use std::sync::Arc;

#[tokio::test(flavor = "multi_thread")]
async fn a_slow_reader_skips_to_the_latest() {
    let mut learner = Learner::start().await;
    let bytes = Bytes::from(vec![1u8; 3 << 20]);
    let big = |version| Arc::new(Weights::new(RunId("run".into()), WeightsVersion(version), bytes.clone()));
    learner.collector.publish(&big(0)).unwrap();
    let mut stream = learner_client(&learner.url)
        .await
        .watch_weights(v1::WatchWeightsRequest::default())
        .await
        .unwrap()
        .into_inner();
    let mut assembler = WeightsAssembler::default();
    let mut seen = Vec::new();
    for version in 1..=50 {
        learner.collector.publish(&big(version)).unwrap();
        tokio::time::sleep(std::time::Duration::from_millis(2)).await;
    }
    while seen.last() != Some(&50) {
        let message = within(stream.message()).await.unwrap().unwrap();
        assert!(message.part.as_ref().unwrap().index > 0 || !message.run_config_toml.is_empty());
        if let Some((weights, _)) = assembler.push(message).unwrap() {
            assert_eq!(weights.bytes, bytes);
            seen.push(weights.version.0);
        }
    }
    assert!(seen.is_sorted() && seen.len() < 25, "{seen:?}");
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_subscriber_may_insist_on_its_run() {
    let learner = Learner::start().await;
    let request = v1::WatchWeightsRequest { run_id: "other".into(), ..Default::default() };
    let status = learner_client(&learner.url).await.watch_weights(request).await.unwrap_err();
    assert_eq!(status.code(), tonic::Code::FailedPrecondition);
    assert!(status.message().contains("'other'") && status.message().contains("'run'"), "{}", status.message());
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_shard_of_the_version_before_the_latest_is_done_by_a_newcomer() {
    let mut learner = Learner::start().await;
    for version in 0..=1 {
        learner.collector.publish(&weights(version)).unwrap();
    }
    learner.collector.open(plan(0, 3)).unwrap();
    let actor = Actor::start(&learner.url, "late", FakeWorker::default());
    assert_eq!(learner.finish().await.unwrap(), expected(&plan(0, 3)));
    learner.collector.publish(&weights(2)).unwrap();
    assert!(matches!(learner.collector.open(plan(0, 3)), Err(CollectError::Version(WeightsVersion(0)))));
    actor.stop().await;
    learner.stop().await;
}
