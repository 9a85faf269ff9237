//! Actors join, leave, die and fall silent; the batch is always the same.

use crate::sandbox::*;
use magex_actor::run::ActorError;
use magex_actor::worker::WorkError;
use magex_core::ids::Shard;
use magex_learner::collector::Collector as _;
use magex_learner::run_events::CollectError;
use std::time::Duration;
use tokio_util::sync::CancellationToken;

#[tokio::test(flavor = "multi_thread")]
async fn two_actors_share_the_work_and_the_batch_is_in_order() {
    let mut learner = Learner::start().await;
    let slow = FakeWorker { delay: Duration::from_millis(10), ..FakeWorker::default() };
    let actors = [Actor::start(&learner.url, "a", slow.clone()), Actor::start(&learner.url, "b", slow)];
    until(|| learner.handle.status().actors.len() == 2).await;
    for iteration in 0..3 {
        assert_eq!(learner.iterate(iteration, 16).await.unwrap(), expected(&plan(iteration, 16)));
    }
    // A second computation may end after the iteration.
    until(|| learner.ledger().outstanding == 0).await;
    let ledger = learner.ledger();
    // Beside them, the first results of each were computed a second time by the other.
    assert_eq!((ledger.leased - ledger.duplicate, ledger.trained, ledger.outstanding), (48, 48, 0));
    until(|| learner.handle.status().actors.iter().all(|actor| actor.shards_done > 0)).await;
    for actor in actors {
        assert!(actor.stop().await.accepted > 0);
    }
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_shards_of_an_actor_that_leaves_are_done_by_another() {
    let mut learner = Learner::start().await;
    let gate = CancellationToken::new();
    let stuck = Actor::start(&learner.url, "stuck", FakeWorker { gate: Some(gate.clone()), ..FakeWorker::default() });
    learner.collector.publish(&weights(0)).unwrap();
    learner.collector.open(plan(0, 4)).unwrap();
    until(|| learner.ledger().outstanding == 1).await;
    stuck.running.abort();
    let good = Actor::start(&learner.url, "good", FakeWorker::default());
    assert_eq!(learner.finish().await.unwrap(), expected(&plan(0, 4)));
    let ledger = learner.ledger();
    assert_eq!((ledger.leased, ledger.trained, ledger.expired, ledger.outstanding), (5, 4, 1, 0));
    gate.cancel();
    good.stop().await;
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_mute_actor_is_evicted_and_told_so() {
    let lease = Duration::from_secs(1);
    let mut learner = Learner::start_with(LearnerOptions { lease, ..LearnerOptions::default() }).await;
    learner.collector.publish(&weights(0)).unwrap();
    learner.collector.open(plan(0, 2)).unwrap();
    let mut mute = Puppet::ready(&learner.url, 1, 1).await;
    mute.lease().await;
    let good = Actor::start(&learner.url, "good", FakeWorker::default());
    assert_eq!(learner.finish().await.unwrap(), expected(&plan(0, 2)));
    let end = mute.next().await.unwrap_err();
    assert_eq!(end.code(), tonic::Code::DeadlineExceeded, "{end}");
    assert_eq!(learner.ledger().expired, 1);
    // The good one kept its place by its heartbeats alone.
    tokio::time::sleep(2 * lease).await;
    assert_eq!(learner.handle.status().actors.len(), 1);
    good.stop().await;
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_process_that_connects_again_gives_its_old_leases_back_at_once() {
    let mut learner = Learner::start().await;
    learner.collector.publish(&weights(0)).unwrap();
    learner.collector.open(plan(0, 1)).unwrap();
    let mut first = Puppet::ready(&learner.url, 5, 1).await;
    let (old, shard) = first.lease().await;
    let mut second = Puppet::ready(&learner.url, 5, 1).await;
    assert_eq!(second.lease().await.1, shard);
    assert!(first.next().await.is_err());
    // What it had finished before is still good.
    let ack = second.deliver(old, &expected(&[shard])[0]).await;
    assert_eq!(ack.verdict(), magex_proto::v1::Verdict::Accepted);
    learner.finish().await.unwrap();
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn actors_survive_a_restart_of_the_learner_and_send_what_they_have() {
    let mut learner = Learner::start().await;
    let listen = learner.address.to_string();
    let gate = CancellationToken::new();
    let actor = Actor::start(&learner.url, "a", FakeWorker { gate: Some(gate.clone()), ..FakeWorker::default() });
    learner.collector.publish(&weights(0)).unwrap();
    learner.collector.open(plan(0, 3)).unwrap();
    until(|| learner.ledger().outstanding == 1).await;
    learner.stop().await;

    let mut learner = Learner::start_with(LearnerOptions { listen, ..LearnerOptions::default() }).await;
    gate.cancel();
    assert_eq!(learner.iterate(0, 3).await.unwrap(), expected(&plan(0, 3)));
    assert_eq!(learner.iterate(1, 3).await.unwrap(), expected(&plan(1, 3)));
    assert_eq!(actor.stop().await.sessions, 2);
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_shard_that_cannot_be_done_ends_the_run_with_its_reason() {
    let mut learner = Learner::start().await;
    let fail: fn(&Shard) -> Result<(), WorkError> =
        |shard| if shard.index == 1 { Err(WorkError::fatal("no such landmark")) } else { Ok(()) };
    let actor = Actor::start(&learner.url, "a", FakeWorker { fail: Some(fail), ..FakeWorker::default() });
    let error = learner.iterate(0, 3).await.unwrap_err();
    assert!(matches!(error, CollectError::Shard { .. }));
    let text = error.to_string();
    assert!(text.contains("train shard 1 of iteration 0") && text.contains("no such landmark"), "{text}");
    actor.stop().await;
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_worker_that_panics_harms_one_shard_only() {
    let mut learner = Learner::start().await;
    let fail: fn(&Shard) -> Result<(), WorkError> =
        |shard| if shard.index == 1 { panic!("out of luck") } else { Ok(()) };
    let actor = Actor::start(&learner.url, "a", FakeWorker { fail: Some(fail), ..FakeWorker::default() });
    let text = learner.iterate(0, 3).await.unwrap_err().to_string();
    assert!(text.contains("panicked: out of luck"), "{text}");
    let again = plan(1, 1);
    assert_eq!(learner.iterate(1, 1).await.unwrap(), expected(&again));
    actor.stop().await;
    learner.stop().await;
}

fn always(_: &Shard) -> Result<(), WorkError> {
    Err(WorkError::fatal("no instruction of this kind"))
}

#[tokio::test(flavor = "multi_thread")]
async fn an_actor_that_can_do_nothing_is_evicted_and_the_others_go_on() {
    let mut learner = Learner::start().await;
    let gate = CancellationToken::new();
    let busy = FakeWorker { gate: Some(gate.clone()), ..FakeWorker::default() };
    let good = Actor::start(&learner.url, "good", busy);
    let broken = Actor::start(&learner.url, "broken", FakeWorker { fail: Some(always), ..FakeWorker::default() });
    until(|| learner.handle.status().actors.len() == 2).await;
    learner.collector.publish(&weights(0)).unwrap();
    learner.collector.open(plan(0, 2)).unwrap();
    // The good one has its hands full with one of the two.
    let error = broken.end().await.unwrap_err();
    assert!(matches!(&error, ActorError::Evicted(_, reason) if reason.contains("no instruction")), "{error}");
    gate.cancel();
    assert_eq!(learner.finish().await.unwrap(), expected(&plan(0, 2)));
    assert_eq!(learner.ledger().failed, 3);
    assert_eq!(learner.iterate(1, 3).await.unwrap(), expected(&plan(1, 3)));
    good.stop().await;
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_run_that_none_of_its_actors_can_do_ends_with_the_reason() {
    let mut learner = Learner::start().await;
    let broken = FakeWorker { fail: Some(always), ..FakeWorker::default() };
    let actors = ["a", "b"].map(|name| Actor::start(&learner.url, name, broken.clone()));
    until(|| learner.handle.status().actors.len() == 2).await;
    let text = learner.iterate(0, 3).await.unwrap_err().to_string();
    assert!(text.contains("no instruction of this kind"), "{text}");
    let present = learner.handle.status().actors.len();
    assert!(present >= 1, "the last actor is not evicted");
    for actor in actors {
        actor.shutdown.cancel();
        let _ = actor.end().await;
    }
    learner.stop().await;
}
