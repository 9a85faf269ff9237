//! What the learner does with results that are late, double, damaged or nonsense.

use crate::sandbox::*;
use magex_core::ids::RunId;
use magex_core::trajectory::{ShardResult, Trajectory};
use magex_learner::collector::Collector as _;
use magex_proto::convert::encode_result;
use magex_proto::v1::rollout_request::Message as Request;
use magex_proto::v1::{ResultPart, Verdict};
use magex_proto::{parts, v1};
use tonic::Code;
use tonic_types::StatusExt as _;

/// A learner with one open plan and an actor that holds the first lease.
async fn leased(shards: u32) -> (Learner, Puppet, u64, ShardResult) {
    let mut learner = Learner::start().await;
    learner.collector.publish(&weights(0)).unwrap();
    learner.collector.open(plan(0, shards)).unwrap();
    let mut puppet = Puppet::ready(&learner.url, 1, 1).await;
    let (lease, shard) = puppet.lease().await;
    let result = expected(&[shard]).remove(0);
    (learner, puppet, lease, result)
}

fn damaged(result: &ShardResult, damage: impl FnOnce(&mut Trajectory)) -> ShardResult {
    let ShardResult::Train(mut trajectory) = result.clone() else { panic!("a trajectory") };
    damage(&mut trajectory);
    ShardResult::Train(trajectory)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_duplicate_is_dropped() {
    let (mut learner, mut puppet, lease, result) = leased(1).await;
    assert_eq!(puppet.deliver(lease, &result).await.verdict(), Verdict::Accepted);
    assert_eq!(puppet.deliver(lease, &result).await.verdict(), Verdict::Duplicate);
    assert_eq!(learner.finish().await.unwrap(), std::slice::from_ref(&result));
    // And after the plan was taken.
    assert_eq!(puppet.deliver(lease, &result).await.verdict(), Verdict::Duplicate);
    let ledger = learner.ledger();
    assert_eq!((ledger.trained, ledger.duplicate), (1, 2));
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn nan_is_rejected_with_the_field_named_and_the_third_time_ends_the_connection() {
    let (mut learner, mut puppet, mut lease, good) = leased(1).await;
    let bad = damaged(&good, |trajectory| trajectory.velocities[11] = f32::NAN);
    for attempt in 1..=3 {
        let ack = puppet.deliver(lease, &bad).await;
        assert_eq!(ack.verdict(), Verdict::Rejected);
        assert_eq!(ack.reason, "trajectory.velocities[11]: NaN is not finite");
        if attempt < 3 {
            puppet.send(Request::Ready(v1::Ready { credit: 1 })).await;
            lease = puppet.lease().await.0;
        }
    }
    let status = puppet.next().await.unwrap_err();
    assert_eq!(status.code(), Code::InvalidArgument);
    let details = status.get_details_bad_request().unwrap();
    assert_eq!(details.field_violations[0].field, "trajectory.velocities[11]");
    // The shard is still to be had.
    let actor = Actor::start(&learner.url, "good", FakeWorker::default());
    assert_eq!(learner.finish().await.unwrap(), [good]);
    assert_eq!(learner.ledger().rejected, 3);
    actor.stop().await;
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn what_does_not_belong_here_is_rejected() {
    let (learner, mut puppet, lease, good) = leased(2).await;
    let sha = weights(0).sha256.clone();
    puppet.send_bytes(lease, encode_result(&RunId("another".into()), &sha, &good)).await;
    assert!(puppet.ack().await.reason.contains("run_id: 'another' where 'run' is expected"));
    puppet.send(Request::Ready(v1::Ready { credit: 1 })).await;
    let (lease, _) = puppet.lease().await;
    puppet.send_bytes(lease, encode_result(&RunId("run".into()), "beef", &good)).await;
    let reason = puppet.ack().await.reason;
    assert!(reason.contains("actor used beef as version 0") && reason.contains(&sha), "{reason}");
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_damaged_part_is_noticed_and_the_rest_of_it_ignored() {
    let (mut learner, mut puppet, lease, good) = leased(1).await;
    let bytes = encode_result(&RunId("run".into()), &weights(0).sha256, &good);
    let mut part = parts::split(bytes.clone()).next().unwrap();
    part.crc32c ^= 1;
    puppet.send(Request::Part(ResultPart { lease_id: lease, part: Some(part), timing: None })).await;
    let ack = puppet.ack().await;
    assert!(ack.reason.starts_with("part.crc32c: "), "{}", ack.reason);
    let mut long = parts::split(bytes).next().unwrap();
    long.total_bytes = 1 << 40;
    puppet.send(Request::Part(ResultPart { lease_id: lease, part: Some(long), timing: None })).await;
    assert!(puppet.ack().await.reason.contains("more than the limit of"));
    puppet.send(Request::Ready(v1::Ready { credit: 1 })).await;
    let (lease, _) = puppet.lease().await;
    assert_eq!(puppet.deliver(lease, &good).await.verdict(), Verdict::Accepted);
    learner.finish().await.unwrap();
    learner.stop().await;
}
