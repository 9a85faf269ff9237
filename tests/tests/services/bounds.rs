//! The learner's limits, and clients that never read.

use crate::sandbox::*;
use bytes::Bytes;
use magex_actor::run::ActorError;
use magex_actor::worker::{MakeWorker, WorkError, Worker};
use magex_core::ids::{RunId, Shard, WeightsVersion};
use magex_core::trajectory::ShardResult;
use magex_learner::collector::Collector as _;
use magex_learner::report::observer::RunObserver as _;
use magex_learner::run_events::RunEvent;
use magex_proto::v1;
use magex_proto::v1::rollout_response::Message as Response;
use magex_proto::weights::Weights;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};
use tonic::Code;
use tonic_types::StatusExt as _;

#[tokio::test(flavor = "multi_thread")]
async fn fifty_actors_at_two_places_are_all_answered_at_once() {
    let learner = Learner::start_with(LearnerOptions { max_actors: 2, ..LearnerOptions::default() }).await;
    let start = Instant::now();
    let mut asking = tokio::task::JoinSet::new();
    for process_id in 1..=50 {
        let url = learner.url.clone();
        asking.spawn(async move {
            let hello = v1::Hello { process_id, ..Puppet::hello() };
            let mut puppet = Puppet::connect(&url, hello).await.unwrap();
            let answer = puppet.next().await;
            // Accepted actors stay until all have been answered.
            (puppet, answer)
        });
    }
    let answers = asking.join_all().await;
    // A guard against waiting for a timer, not a measurement.
    assert!(start.elapsed() < Duration::from_secs(5), "{:?}", start.elapsed());
    let welcome = answers.iter().filter(|(_, answer)| matches!(answer, Ok(Response::Welcome(_)))).count();
    assert_eq!(welcome, 2);
    for status in answers.iter().filter_map(|(_, answer)| answer.as_ref().err()) {
        assert_eq!(status.code(), Code::ResourceExhausted);
        assert!(status.get_details_retry_info().is_some_and(|info| info.retry_delay.is_some()), "{status}");
    }
    drop(answers);
    until(|| learner.handle.status().actors.is_empty()).await;
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_place_of_an_actor_that_fell_silent_is_free_for_another() {
    let lease = Duration::from_millis(500);
    let learner = Learner::start_with(LearnerOptions { max_actors: 1, lease, ..LearnerOptions::default() }).await;
    // Connected and alive, as far as the connection knows.
    let mut silent = Puppet::ready(&learner.url, 1, 1).await;
    let start = Instant::now();
    until(|| learner.handle.status().actors.is_empty()).await;
    assert!(start.elapsed() <= lease + Duration::from_secs(1), "{:?}", start.elapsed());
    assert_eq!(silent.next().await.unwrap_err().code(), Code::DeadlineExceeded);
    let _next = Puppet::ready(&learner.url, 2, 1).await;
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_watcher_that_reads_nothing_loses_its_place_and_its_stream() {
    let lease = Duration::from_millis(500);
    let options = LearnerOptions { max_watchers: 2, lease, ..LearnerOptions::default() };
    let mut learner = Learner::start_with(options).await;
    let publish = |learner: &mut Learner, version| {
        let bytes = Bytes::from(vec![1u8; 3 << 20]);
        let weights = Weights::new(RunId("run".into()), WeightsVersion(version), bytes);
        learner.collector.publish(&Arc::new(weights)).unwrap();
    };
    publish(&mut learner, 0);
    // A connection of its own with small windows: what is not read does not fit into them.
    let endpoint = tonic::transport::Endpoint::from_shared(learner.url.clone()).unwrap();
    let endpoint = endpoint.initial_stream_window_size(64 << 10).initial_connection_window_size(64 << 10);
    let mut stalled = v1::learner_service_client::LearnerServiceClient::new(endpoint.connect().await.unwrap())
        .max_decoding_message_size(8 << 20);
    let mut deaf = stalled.watch_weights(v1::WatchWeightsRequest::default()).await.unwrap().into_inner();
    let mut client = learner_client(&learner.url).await;
    let mut events = client.watch_run(v1::WatchRunRequest {}).await.unwrap().into_inner();
    // Both places are taken: the next call is rejected with a retry delay.
    let full = client.watch_weights(v1::WatchWeightsRequest::default()).await.unwrap_err();
    assert_eq!(full.code(), Code::ResourceExhausted);
    assert!(full.get_details_retry_info().is_some());
    assert_eq!(client.watch_run(v1::WatchRunRequest {}).await.unwrap_err().code(), Code::ResourceExhausted);
    for version in 1..4 {
        publish(&mut learner, version);
    }
    // The deaf one's place becomes free, and it finds the end of its stream when it reads at last.
    let mut again = client.clone();
    within(async {
        while again.watch_weights(v1::WatchWeightsRequest::default()).await.is_err() {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    })
    .await;
    let mut messages = 0;
    while within(deaf.message()).await.unwrap().is_some() {
        messages += 1;
    }
    assert!(messages < 16, "it was not sent everything: {messages} parts");
    // The one that listens was never disturbed.
    learner.handle.observer().event(&RunEvent::Log("still here".into()));
    assert!(within(events.message()).await.unwrap().is_some());
    learner.stop().await;
}

/// Knows the answers, and gets one in ten wrong.
struct Flaky(Arc<AtomicU32>);

impl Worker for Flaky {
    fn work(
        &mut self,
        shard: &Shard,
        weights: &Weights,
        _: &mut magex_actor::goal_client::GrpcGoals,
    ) -> Result<ShardResult, WorkError> {
        let ShardResult::Train(mut trajectory) = result_of(&task(), shard, &weights.bytes) else { panic!("training") };
        if self.0.fetch_add(1, Ordering::SeqCst) % 10 == 9 {
            trajectory.rewards[3] = f32::NAN;
        }
        Ok(ShardResult::Train(trajectory))
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_actor_whose_results_are_garbage_now_and_then_is_evicted_and_nothing_of_it_is_trained_on() {
    let mut learner = Learner::start().await;
    let worked = Arc::new(AtomicU32::new(0));
    let counter = worked.clone();
    let maker: MakeWorker = Arc::new(move |_| Ok(Box::new(Flaky(counter.clone()))));
    let bad = Actor::start_maker(config(&learner.url, "bad"), maker);
    let mut iteration = 0;
    // Alone at first, so that it is asked for sure.
    while !bad.has_ended() {
        learner.collector.publish(&weights(iteration)).unwrap();
        learner.collector.open(plan(iteration, 8)).unwrap();
        until(|| learner.handle.status().shards_done == 8 || bad.has_ended()).await;
        if bad.has_ended() {
            break;
        }
        assert_eq!(learner.finish().await.unwrap(), expected(&plan(iteration, 8)));
        iteration += 1;
    }
    let error = bad.end().await.unwrap_err();
    assert!(matches!(&error, ActorError::Evicted(_, reason) if reason.contains("NaN is not finite")), "{error}");
    assert_eq!(learner.ledger().rejected, 3);
    // Another actor does the rest.
    let good = Actor::start(&learner.url, "good", FakeWorker::default());
    assert_eq!(learner.finish().await.unwrap(), expected(&plan(iteration, 8)));
    good.stop().await;
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_evicted_process_is_not_accepted_again() {
    let mut learner = Learner::start().await;
    learner.collector.publish(&weights(0)).unwrap();
    learner.collector.open(plan(0, 1)).unwrap();
    let mut puppet = Puppet::ready(&learner.url, 9, 3).await;
    for _ in 0..3 {
        let (lease, shard) = puppet.lease().await;
        let ShardResult::Train(mut bad) = expected(&[shard]).remove(0) else { panic!("training") };
        bad.rewards[0] = f32::NAN;
        puppet.deliver(lease, &ShardResult::Train(bad)).await;
    }
    assert_eq!(puppet.next().await.unwrap_err().code(), Code::InvalidArgument);
    let again = Puppet::connect(&learner.url, v1::Hello { process_id: 9, ..Puppet::hello() }).await;
    let status = again.unwrap().next().await.unwrap_err();
    assert_eq!(status.code(), Code::FailedPrecondition);
    assert!(status.message().contains("restart it"), "{status}");
    let _another = Puppet::ready(&learner.url, 10, 1).await;
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_connection_that_damages_three_results_is_made_anew_not_its_actor() {
    let mut learner = Learner::start().await;
    learner.collector.publish(&weights(0)).unwrap();
    learner.collector.open(plan(0, 1)).unwrap();
    let mut puppet = Puppet::ready(&learner.url, 9, 3).await;
    for _ in 0..3 {
        let (lease_id, shard) = puppet.lease().await;
        let bytes = magex_proto::convert::encode_result(&RunId("run".into()), "", &expected(&[shard])[0]);
        let mut part = magex_proto::parts::split(bytes).next().unwrap();
        part.crc32c ^= 1;
        let part = v1::ResultPart { lease_id, part: Some(part), timing: None };
        puppet.send(v1::rollout_request::Message::Part(part)).await;
        assert!(puppet.ack().await.reason.starts_with("part.crc32c: "));
    }
    assert_eq!(puppet.next().await.unwrap_err().code(), Code::DataLoss);
    let _same = Puppet::ready(&learner.url, 9, 1).await;
    learner.stop().await;
}
