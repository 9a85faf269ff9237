//! Which callers are accepted: tokens, roles and limits.

use crate::clients::{positions, team};
use crate::sandbox::*;
use magex_commander::service::ServiceConfig;
use magex_dispatch::Limits;
use magex_learner::collector::Collector as _;
use magex_proto::v1;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use magex_proto::v1::learner_service_client::LearnerServiceClient;
use magex_proto::weights::sha256_hex;
use magex_runtime::client::{Channel, Settings, Token};
use magex_runtime::net::auth::Access;
use magex_runtime::security::Security;
use std::path::Path;
use tonic::{Code, Status};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

pub(crate) fn identities(folder: &Path, entries: &[(&str, &str, &str, &str)]) -> Access {
    let mut text = String::new();
    for (name, role, kind, hash) in entries {
        text += &format!("[[identity]]\nname = '{name}'\nrole = '{role}'\n{kind}_sha256 = '{hash}'\n");
    }
    let path = folder.join("identities.toml");
    std::fs::write(&path, text).unwrap();
    Access::read(&path).unwrap()
}

/// Settings with this token.
pub(crate) fn bearing(token: &str) -> Settings {
    Settings { token: Some(Token::new(token, "test").unwrap()), ..Settings::default() }
}

pub(crate) async fn commander_as(url: &str, token: &str) -> CommanderServiceClient<Channel> {
    CommanderServiceClient::new(bearing(token).connect(url).await.unwrap())
}

pub(crate) fn code<T>(result: Result<T, Status>) -> Option<Code> {
    result.err().map(|status| status.code())
}

/// A token for every role of the tests; the name is the token, too.
pub(crate) fn all_roles(folder: &Path) -> Access {
    let roles =
        [("fleet", "client"), ("other", "client"), ("rollouts", "actor"), ("goals", "commander"), ("ops", "admin")];
    let hashes = roles.map(|(name, _)| sha256_hex(name.as_bytes()));
    let entries: Vec<_> =
        roles.iter().zip(&hashes).map(|((name, role), hash)| (*name, *role, "token", hash.as_str())).collect();
    identities(folder, &entries)
}

pub(crate) fn guarded(access: Access) -> Security {
    Security { access, ..Security::default() }
}

const DENIED: Option<Code> = Some(Code::PermissionDenied);
const UNKNOWN: Option<Code> = Some(Code::Unauthenticated);
const INVALID: Option<Code> = Some(Code::InvalidArgument);
const MISSING: Option<Code> = Some(Code::NotFound);

#[tokio::test(flavor = "multi_thread")]
async fn every_method_of_the_commander_opens_for_its_roles_only() {
    let folder = tempfile::tempdir().unwrap();
    let config = ServiceConfig { security: guarded(all_roles(folder.path())), ..ServiceConfig::default() };
    let commander = Commander::start_with("127.0.0.1:0", config, load_fake).await;
    // What a call ends with that was let in: some of these ask for nothing that there is.
    let let_in = [None, None, None, None, INVALID, MISSING, MISSING, None, None, MISSING, None];
    let only = |open: &[usize]| {
        let mut found = [DENIED; 11];
        open.iter().for_each(|&method| found[method] = let_in[method]);
        found
    };
    let clients = only(&[0, 1, 2, 3, 5, 6, 7, 8, 9, 10]);
    for (token, expected) in [
        ("fleet", clients),
        ("other", clients),
        ("rollouts", only(&[4, 10])),
        ("goals", only(&[])),
        ("ops", let_in),
        ("wrong", [UNKNOWN; 11]),
    ] {
        let mut c = commander_as(&commander.url, token).await;
        let many = v1::AssignManyRequest { teams: vec![team()] };
        let mission = v1::CreateMissionRequest { mission_id: format!("of-{token}"), ..Default::default() };
        let id = "nowhere".to_owned();
        let update = v1::UpdateMissionRequest { mission_id: id.clone(), ..Default::default() };
        let found = [
            code(c.assign(team()).await),
            code(c.assign_many(many).await),
            code(c.assign_stream(tokio_stream::empty()).await),
            code(c.create_mission(mission).await),
            code(c.assign_batch(v1::AssignBatchRequest::default()).await),
            code(c.update_mission(update).await),
            code(c.get_assignment(v1::GetAssignmentRequest { mission_id: id.clone() }).await),
            code(c.list_assignments(v1::ListAssignmentsRequest::default()).await),
            code(c.watch_assignments(v1::WatchAssignmentsRequest::default()).await),
            code(c.delete_mission(v1::DeleteMissionRequest { mission_id: id }).await),
            code(c.get_model(v1::GetModelRequest {}).await),
        ];
        assert_eq!(found, expected, "{token}");
    }
    let mut anonymous = commander_client(&commander.url).await;
    assert_eq!(code(anonymous.assign(team()).await), UNKNOWN);
    // Health needs no token.
    let channel = magex_runtime::client::endpoint(&commander.url).unwrap().connect().await.unwrap();
    HealthClient::new(channel).check(HealthCheckRequest { service: String::new() }).await.unwrap();
    for (token, missions) in
        [("fleet", vec!["of-fleet"]), ("other", vec!["of-other"]), ("ops", vec!["of-fleet", "of-ops", "of-other"])]
    {
        let mut client = commander_as(&commander.url, token).await;
        let own = v1::ListAssignmentsRequest { source: v1::MissionSource::Client.into(), ..Default::default() };
        let page = client.list_assignments(own).await.unwrap().into_inner();
        let names: Vec<&str> = page.assignments.iter().map(|a| a.mission_id.as_str()).collect();
        assert_eq!(names, missions, "{token}");
        let theirs = if token == "fleet" { "of-other" } else { "of-fleet" };
        let theirs = v1::DeleteMissionRequest { mission_id: theirs.into() };
        let expected = if token == "ops" { None } else { MISSING };
        assert_eq!(code(client.delete_mission(theirs).await), expected, "{token}");
    }
    commander.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn every_method_of_the_learner_opens_for_its_roles_only() {
    let folder = tempfile::tempdir().unwrap();
    let security = guarded(all_roles(folder.path()));
    let learner = Learner::start_with(LearnerOptions { security, ..LearnerOptions::default() }).await;
    for (token, expected) in [
        ("fleet", [DENIED, DENIED, None, None, DENIED, DENIED]),
        ("rollouts", [None, None, DENIED, DENIED, DENIED, DENIED]),
        ("goals", [DENIED, None, DENIED, DENIED, DENIED, DENIED]),
        ("wrong", [UNKNOWN; 6]),
        // Last: it drains.
        ("ops", [None; 6]),
    ] {
        let mut c = LearnerServiceClient::new(bearing(token).connect(&learner.url).await.unwrap());
        let found = [
            code(c.rollout(tokio_stream::pending()).await),
            code(c.watch_weights(v1::WatchWeightsRequest::default()).await),
            code(c.get_run(v1::GetRunRequest {}).await),
            code(c.watch_run(v1::WatchRunRequest {}).await),
            code(c.checkpoint(v1::CheckpointRequest {}).await),
            code(c.drain(v1::DrainRequest { reason: "test".into() }).await),
        ];
        assert_eq!(found, expected, "{token}");
    }
    let mut anonymous = learner_client(&learner.url).await;
    assert_eq!(code(anonymous.get_run(v1::GetRunRequest {}).await), UNKNOWN);
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_actor_that_is_not_let_in_says_so_and_ends() {
    let folder = tempfile::tempdir().unwrap();
    let security = guarded(all_roles(folder.path()));
    let learner = Learner::start_with(LearnerOptions { security, ..LearnerOptions::default() }).await;
    for (client, words) in [(Settings::default(), "authorization"), (bearing("fleet"), "role client")] {
        let config = magex_actor::run::ActorConfig { client, ..config(&learner.url, "a") };
        let error = Actor::start_with(config, FakeWorker::default()).end().await.unwrap_err().to_string();
        assert!(error.contains("refused") && error.contains(words), "{error}");
    }
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_actor_that_the_commander_does_not_let_in_ends_and_its_shard_is_done_by_another() {
    let folder = tempfile::tempdir().unwrap();
    let mut learner = Learner::start().await;
    let (security, learner_url) = (guarded(all_roles(folder.path())), Some(learner.url.clone()));
    let config = ServiceConfig { security, learner_url, ..ServiceConfig::default() };
    let commander = Commander::start_with("127.0.0.1:0", config, load_fake).await;
    learner.collector.publish(&weights(0)).unwrap();
    learner.collector.open(plan(0, 3)).unwrap();
    let asking = |client: Settings| {
        let config = magex_actor::run::ActorConfig {
            client,
            commander_url: commander.url.clone(),
            ..crate::sandbox::config(&learner.url, "asking")
        };
        Actor::start_with(config, FakeWorker { ask_goals: true, ..FakeWorker::default() })
    };
    for (client, words) in [(Settings::default(), "authorization"), (bearing("fleet"), "role client")] {
        let error = asking(client).end().await.unwrap_err().to_string();
        assert!(error.contains("rejected this actor's credentials") && error.contains(words), "{error}");
    }
    // More often than a shard may fail for good.
    for _ in 0..4 {
        asking(bearing("wrong")).end().await.unwrap_err();
    }
    assert_eq!(learner.ledger().failed, 6);
    let good = asking(bearing("rollouts"));
    assert_eq!(learner.finish().await.unwrap(), expected(&plan(0, 3)));
    good.stop().await;
    commander.stop().await;
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn sizes_and_calls_in_flight_are_limited() {
    let limits = Limits { members: 3, ..Limits::default() };
    let config = ServiceConfig { limits, message_bytes: 4096, calls: 1, streams: 1, ..ServiceConfig::default() };
    let commander = Commander::start_with("127.0.0.1:0", config, load_fake).await;
    let mut client = commander_client(&commander.url).await;
    let large = v1::AssignRequest { agents: positions(&[0.0; 8]), ..team() };
    let status = client.assign(large).await.unwrap_err();
    assert!(
        status.code() == Code::InvalidArgument && status.message().contains("4 points exceed the limit of 3"),
        "{status}"
    );
    let huge = v1::AssignRequest { agents: positions(&[0.0; 3000]), ..team() };
    let status = client.assign(huge).await.unwrap_err();
    assert!(matches!(status.code(), Code::OutOfRange | Code::ResourceExhausted), "{status}");
    let watch = || v1::WatchAssignmentsRequest::default();
    let mut first = client.watch_assignments(watch()).await.unwrap().into_inner();
    assert!(first.message().await.unwrap().is_some());
    assert_eq!(code(client.watch_assignments(watch()).await), Some(Code::ResourceExhausted));
    drop(first);
    // The place is free again once the service sees that the watcher has gone.
    within(async { while client.watch_assignments(watch()).await.is_err() {} }).await;
    client.assign(team()).await.unwrap();
    commander.stop().await;
}
