//! Malicious requests: small on the wire and large in memory, unreadable, with impossible shapes; and callers that take all
//! anonymous connections.

use crate::clients::team;
use crate::floods::{healthy, post};
use crate::sandbox::*;
use crate::security::{all_roles, commander_as, guarded};
use magex_commander::scheduler::{
    AssignmentMethod, GoalReply, GoalRequest, Scheduler, SchedulerError, TeamReply, WeightsKey,
};
use magex_commander::service::ServiceConfig;
use magex_commander::weights_file::WeightsFile;
use magex_core::ids::{RunId, WeightsVersion};
use magex_proto::v1;
use magex_runtime::client::endpoint;
use magex_runtime::net::connections::ConnectionLimits;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;
use tonic::body::Body;
use tonic::codegen::Bytes;
use tonic::transport::Channel;
use tonic::{Code, Status};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;
use tonic_types::StatusExt as _;

/// Sends these bytes as a request's message.
async fn send(channel: &Channel, method: &str, message: &[u8]) -> Status {
    let framed = [&[0][..], &(message.len() as u32).to_be_bytes(), message].concat();
    let response = within(post(channel, method, Body::new(Whole(Some(framed.into())))).await).await.unwrap();
    Status::from_header_map(response.headers()).expect("it is refused")
}

/// A body of one piece.
struct Whole(Option<Bytes>);

impl http_body::Body for Whole {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        _: &mut Context<'_>,
    ) -> Poll<Option<Result<http_body::Frame<Bytes>, Status>>> {
        Poll::Ready(self.0.take().map(|bytes| Ok(http_body::Frame::data(bytes))))
    }
}

fn field(status: &Status) -> String {
    assert_eq!(status.code(), Code::InvalidArgument, "{status}");
    status.get_details_bad_request().unwrap().field_violations[0].field.clone()
}

#[tokio::test(flavor = "multi_thread")]
async fn elements_of_nothing_are_refused_before_they_take_memory() {
    let commander = Commander::start("127.0.0.1:0", None).await;
    let channel = endpoint(&commander.url).unwrap().connect().await.unwrap();
    let empty = |tag: u8, count: usize| [tag, 0].repeat(count);
    // Teams; overrides; pairs; within a team of many, and within one of a stream.
    let wrapped = |tag: u8, inner: &[u8]| {
        let mut bytes = vec![tag];
        prost::encoding::encode_varint(inner.len() as u64, &mut bytes);
        bytes.extend(inner);
        bytes
    };
    let half = 1 << 20;
    for (method, message) in [
        ("AssignMany", empty(0x0a, 2 * half)),
        ("Assign", empty(0x4a, half)),
        ("Assign", empty(0x52, half)),
        ("AssignMany", wrapped(0x0a, &empty(0x4a, half))),
        ("CreateMission", empty(0x1a, half)),
        ("WatchAssignments", empty(0x0a, half)),
    ] {
        let refused = send(&channel, method, &message).await;
        assert_eq!(field(&refused), "request", "{method}");
        assert!(refused.message().contains("elements"), "{refused}");
    }
    healthy(&commander.url).await;
    commander.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn what_cannot_be_read_is_its_callers_fault_and_named() {
    let commander = Commander::start("127.0.0.1:0", None).await;
    let channel = endpoint(&commander.url).unwrap().connect().await.unwrap();
    // A number where a message belongs; a name that is no text; an end that is missing.
    for (message, path) in
        [(&[0x08, 0x01][..], "agents"), (&[0x1a, 0x01, 0xff], "agent_ids"), (&[0x0a, 0x02, 0x0a, 0x05], "agents.dims")]
    {
        assert_eq!(field(&send(&channel, "Assign", message).await), path);
    }
    commander.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn what_a_caller_made_long_comes_back_short() {
    let commander = Commander::start("127.0.0.1:0", None).await;
    let mut client = commander_client(&commander.url).await;
    let mission_id = "é".repeat(200_000);
    let missing = client.get_assignment(v1::GetAssignmentRequest { mission_id }).await.unwrap_err();
    assert_eq!(missing.code(), Code::NotFound, "{missing}");
    assert!(missing.message().len() < 2048 && missing.message().ends_with('…'), "{missing}");
    let array = v1::Array { shape: vec![7; 100_000], ..Default::default() };
    let agents = Some(v1::Positions { array: Some(array), ..Default::default() });
    let refused = client.assign(v1::AssignRequest { agents, ..team() }).await.unwrap_err();
    assert_eq!(field(&refused), "agents.array");
    assert!(refused.message().len() < 200, "{refused}");
    commander.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn impossible_shards_are_rejected() {
    let folder = run_folder(b"weights");
    let weights = Some(WeightsFile::find(folder.path(), None).unwrap());
    let config = ServiceConfig { weights, ..ServiceConfig::default() };
    let commander = Commander::start_with("127.0.0.1:0", config, load_fake).await;
    let mut client = commander_client(&commander.url).await;
    let model = client.get_model(v1::GetModelRequest {}).await.unwrap().into_inner();
    let shard = plan(0, 1)[0];
    let key = WeightsKey { run_id: RunId(model.run_id), version: WeightsVersion(model.version), sha256: model.sha256 };
    let good = goal_request(&task(), &shard);
    client.assign_batch(good.to_message(&key)).await.unwrap();
    let shaped = |agents: [u32; 4], goals: [u32; 4]| {
        let mut message = good.to_message(&key);
        let empty = |shape: [u32; 4]| {
            Some(v1::Array { r#type: v1::DataType::F32.into(), shape: shape.to_vec(), data: Default::default() })
        };
        (message.agents, message.goals) = (empty(agents), empty(goals));
        message
    };
    let b = shard.episodes;
    // No number is needed to fill these.
    for (message, path) in [
        (shaped([b, 1, u32::MAX, 0], [b, 1, u32::MAX, 0]), "agents.shape[2]"),
        (shaped([b, u32::MAX, 0, 2], [b, u32::MAX, 0, 2]), "agents.shape[2]"),
        (shaped([b, 1, 1, 0], [b, 1, 1, 0]), "agents.shape[3]"),
        (v1::AssignBatchRequest { run_id: "r".repeat(1000), ..good.to_message(&key) }, "run_id"),
    ] {
        assert_eq!(field(&within(client.assign_batch(message)).await.unwrap_err()), path);
    }
    client.assign_batch(good.to_message(&key)).await.unwrap();
    commander.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn unknown_callers_are_evicted_for_known_ones() {
    let folder = tempfile::tempdir().unwrap();
    let limits = ConnectionLimits { total: 3, per_peer: 3, first_call: Duration::from_secs(60) };
    let config = ServiceConfig { security: guarded(all_roles(folder.path())), ..ServiceConfig::default() };
    let commander = Commander::start_within(limits, config).await;
    let mut strangers = Vec::new();
    for _ in 0..3 {
        let mut stranger = commander_client(&commander.url).await;
        assert_eq!(stranger.assign(team()).await.unwrap_err().code(), Code::Unauthenticated);
        strangers.push(stranger);
    }
    let mut known = commander_as(&commander.url, "fleet").await;
    known.assign(team()).await.unwrap();
    commander.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn too_many_health_watches_are_refused_and_probes_are_answered() {
    let commander = Commander::start("127.0.0.1:0", None).await;
    let mut client = HealthClient::new(endpoint(&commander.url).unwrap().connect().await.unwrap());
    let mut open = Vec::new();
    let refused = loop {
        match within(client.watch(HealthCheckRequest::default())).await {
            Ok(stream) => open.push(stream),
            Err(status) => break status,
        }
        assert!(open.len() <= 64);
    };
    assert_eq!(refused.code(), Code::ResourceExhausted, "{refused}");
    healthy(&commander.url).await;
    let service = "s".repeat(10_000);
    assert!(client.check(HealthCheckRequest { service }).await.is_err());
    let mut caller = commander_client(&commander.url).await;
    caller.assign(team()).await.unwrap();
    commander.stop().await;
}

/// The model of a run that has no learned commander.
struct Classical;

impl Scheduler for Classical {
    fn assign_batch(&self, _: &GoalRequest, _: &dyn Fn() -> bool) -> Result<GoalReply, SchedulerError> {
        Err(SchedulerError::Interrupted)
    }

    fn method(&self) -> AssignmentMethod {
        AssignmentMethod::Exact
    }

    fn assign_team(&self, _: &magex_dispatch::Problem) -> Result<TeamReply, SchedulerError> {
        Err(SchedulerError::Unsupported("the run has no learned commander".into()))
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_run_without_a_learned_commander_offers_none() {
    let folder = run_folder(b"weights");
    let weights = Some(WeightsFile::find(folder.path(), None).unwrap());
    let config = ServiceConfig { weights, ..ServiceConfig::default() };
    let commander = Commander::start_with("127.0.0.1:0", config, |_, _| Ok(Arc::new(Classical))).await;
    let mut client = commander_client(&commander.url).await;
    let model = client.get_model(v1::GetModelRequest {}).await.unwrap().into_inner();
    assert!(!model.ready && !model.sha256.is_empty());
    assert!(!model.schedulers.contains(&v1::AssignmentMethod::Learned.into()), "{:?}", model.schedulers);
    let reply = client.assign(team()).await.unwrap().into_inner();
    assert_eq!(reply.scheduler(), v1::AssignmentMethod::Exact);
    assert!(reply.fallback_reason.contains("no learned commander"), "{}", reply.fallback_reason);
    commander.stop().await;
}
