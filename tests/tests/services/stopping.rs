//! Shutdown: within its budget, whatever clients do, and with a notice to every client.

use crate::sandbox::*;
use magex_core::ids::RunId;
use magex_learner::collector::Collector as _;
use magex_learner::report::observer::{RunObserver as _, RunStart};
use magex_learner::run_events::{CollectError, RunEvent, StopReason};
use magex_proto::v1;
use magex_proto::v1::watch_run_response::Event;
use std::path::Path;
use std::time::{Duration, Instant};
use tokio_util::sync::CancellationToken;

#[tokio::test(flavor = "multi_thread")]
async fn open_streams_and_idle_sockets_do_not_hold_up_the_end() {
    let mut learner = Learner::start().await;
    learner.collector.publish(&weights(0)).unwrap();
    learner.collector.open(plan(0, 1)).unwrap();
    let mut client = learner_client(&learner.url).await;
    let _weights = client.watch_weights(v1::WatchWeightsRequest::default()).await.unwrap();
    let _events = client.watch_run(v1::WatchRunRequest {}).await.unwrap();
    let mut puppet = Puppet::ready(&learner.url, 1, 1).await;
    puppet.lease().await;
    let _idle = tokio::net::TcpStream::connect(learner.address).await.unwrap();

    let start = Instant::now();
    let Learner { shutdown, serving, mut collector, .. } = learner;
    let trainer = tokio::task::spawn_blocking(move || collector.wait());
    shutdown.cancel();
    assert!(matches!(within(trainer).await.unwrap(), Err(CollectError::Stopped(StopReason::Shutdown))));
    let farewell = puppet.next().await.unwrap();
    assert!(matches!(farewell, v1::rollout_response::Message::Drain(v1::Drain { finished: false, .. })));
    within(serving).await.unwrap();
    assert!(start.elapsed() < Duration::from_secs(10), "{:?}", start.elapsed());
}

#[tokio::test(flavor = "multi_thread")]
async fn actors_leave_when_the_run_is_complete_and_watchers_see_it_all() {
    let mut learner = Learner::start().await;
    let actor = Actor::start(&learner.url, "a", FakeWorker::default());
    learner.iterate(0, 2).await.unwrap();
    let report = v1::IterationEvent {
        iteration: 0,
        joint_env_steps: 0,
        success: Some(0.5),
        reward: None,
        metrics_json: "{\"x\":1}".into(),
        iterations_completed: 1,
        joint_env_steps_trained: 12,
    };
    learner.handle.observer().event(&RunEvent::Iteration(report));
    let status = learner.handle.status();
    assert_eq!((status.iteration, status.joint_env_steps, status.success), (1, 12, Some(0.5)));
    assert!(!status.metrics_json.is_empty());
    let mut client = learner_client(&learner.url).await;
    let mut events = client.watch_run(v1::WatchRunRequest {}).await.unwrap().into_inner();
    let first = within(events.message()).await.unwrap().unwrap();
    assert!(matches!(first.event, Some(Event::Iteration(event)) if event.metrics_json == "{\"x\":1}"));
    learner.handle.observer().event(&RunEvent::Finished(v1::FinishedEvent { summary_json: "{}".into() }));
    assert_eq!(learner.handle.status().state(), v1::RunState::Finished);
    learner.shutdown.cancel();
    assert!(matches!(within(events.message()).await.unwrap().unwrap().event, Some(Event::Finished(_))));
    assert!(within(events.message()).await.unwrap().is_none());
    assert_eq!(actor.end().await.unwrap().accepted, 2);
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_drain_lets_the_iteration_finish() {
    let mut learner = Learner::start().await;
    learner.collector.publish(&weights(0)).unwrap();
    learner.collector.open(plan(0, 2)).unwrap();
    assert_eq!(learner.handle.status().state(), v1::RunState::WaitingForActors);
    let mut client = learner_client(&learner.url).await;
    let refused = client.checkpoint(v1::CheckpointRequest {}).await.unwrap_err();
    assert!(refused.code() == tonic::Code::FailedPrecondition && refused.message().contains("no actor"), "{refused}");
    let gate = CancellationToken::new();
    let actor = Actor::start(&learner.url, "a", FakeWorker { gate: Some(gate.clone()), ..FakeWorker::default() });
    until(|| learner.handle.status().state() == v1::RunState::Collecting).await;
    client.checkpoint(v1::CheckpointRequest {}).await.unwrap();
    client.drain(v1::DrainRequest { reason: "new kernel".into() }).await.unwrap();
    gate.cancel();
    assert_eq!(learner.finish().await.unwrap(), expected(&plan(0, 2)));
    assert_eq!(learner.collector.stop_requested(), Some(StopReason::Drain("new kernel".into())));
    assert!(learner.collector.checkpoint_requested() && !learner.collector.checkpoint_requested());
    let status = client.get_run(v1::GetRunRequest {}).await.unwrap().into_inner().run.unwrap();
    assert_eq!(status.state(), v1::RunState::Draining);
    actor.stop().await;
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_drain_without_actors_ends_the_iteration() {
    // No actor is connected, or the only one leaves before the iteration is done.
    for leaves in [false, true] {
        let mut learner = Learner::start().await;
        learner.collector.publish(&weights(0)).unwrap();
        learner.collector.open(plan(0, 2)).unwrap();
        let puppet = if leaves { Some(Puppet::ready(&learner.url, 1, 1).await) } else { None };
        let mut client = learner_client(&learner.url).await;
        client.drain(v1::DrainRequest { reason: "new kernel".into() }).await.unwrap();
        within(learner.handle.stop_signal()).await;
        let leaving = tokio::spawn(async move {
            tokio::time::sleep(Duration::from_millis(50)).await;
            drop(puppet);
        });
        let ended = learner.finish().await;
        assert!(matches!(ended, Err(CollectError::Stopped(StopReason::Drain(_)))), "{ended:?}");
        leaving.await.unwrap();
        learner.stop().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_resumed_run_reports_its_last_iteration_at_once() {
    let learner = Learner::start().await;
    let before = v1::IterationEvent {
        iteration: 6,
        joint_env_steps: 60,
        success: Some(0.5),
        reward: Some(-1.0),
        metrics_json: "{}".into(),
        iterations_completed: 7,
        joint_env_steps_trained: 70,
    };
    let (run_id, folder) = (RunId("run".into()), Path::new("nowhere"));
    learner.handle.observer().begin(RunStart { run_id: &run_id, folder, before: Some(&before) });
    let status = learner.handle.status();
    assert_eq!((status.iteration, status.joint_env_steps, status.success), (7, 70, Some(0.5)));
    assert_eq!((status.reward, status.metrics_json.as_str()), (Some(-1.0), "{}"));
    learner.stop().await;
}
