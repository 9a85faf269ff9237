//! Which actors a learner accepts.

use crate::sandbox::*;
use magex_actor::run::{ActorConfig, ActorError};
use magex_proto::v1::rollout_request::Message as Request;
use magex_proto::v1::rollout_response::Message as Response;
use magex_proto::{PROTOCOL_VERSION, v1};
use tonic::Code;
use tonic_types::StatusExt as _;

#[tokio::test(flavor = "multi_thread")]
async fn a_wrong_task_is_refused_with_both_sides_named() {
    let learner = Learner::start().await;
    let config = ActorConfig { expected_task: Some("fade".into()), ..config(&learner.url, "a") };
    let error = Actor::start_with(config, FakeWorker::default()).end().await.unwrap_err();
    assert!(matches!(error, ActorError::Refused(..)));
    let text = error.to_string();
    assert!(text.contains("task fade") && text.contains(&task().fingerprint()), "{text}");
    let config = ActorConfig { expected_task: Some(task().fingerprint()), ..crate::sandbox::config(&learner.url, "b") };
    let right = Actor::start_with(config, FakeWorker::default());
    until(|| learner.handle.status().actors.len() == 1).await;
    right.stop().await;
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_wrong_protocol_is_refused_with_both_sides_named() {
    let learner = Learner::start().await;
    let theirs = PROTOCOL_VERSION + 1;
    let hello = v1::Hello { protocol_version: theirs, ..Puppet::hello() };
    let status = Puppet::connect(&learner.url, hello).await.unwrap().next().await.unwrap_err();
    assert_eq!(status.code(), Code::FailedPrecondition);
    let named = format!("actor speaks protocol {theirs}, learner speaks protocol {PROTOCOL_VERSION}");
    assert!(status.message().contains(&named), "{}", status.message());
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn manners_are_required() {
    let learner = Learner::start().await;
    let mut puppet = Puppet::connect(&learner.url, Puppet::hello()).await.unwrap();
    assert!(matches!(puppet.next().await, Ok(Response::Welcome(_))));
    puppet.send(Request::Hello(Puppet::hello())).await;
    assert_eq!(puppet.next().await.unwrap_err().code(), Code::InvalidArgument);
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_learner_says_so_and_when_to_try_again() {
    let learner = Learner::start_with(LearnerOptions { max_actors: 1, ..LearnerOptions::default() }).await;
    let _first = Puppet::ready(&learner.url, 1, 0).await;
    let hello = v1::Hello { process_id: 2, ..Puppet::hello() };
    let status = Puppet::connect(&learner.url, hello).await.unwrap().next().await.unwrap_err();
    assert_eq!(status.code(), Code::ResourceExhausted);
    assert!(status.get_details_retry_info().is_some());
    learner.stop().await;
}
