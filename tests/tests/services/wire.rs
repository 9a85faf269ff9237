//! What clients of other makers expect of a gRPC service: compression, reflection, streams that stay open.

use crate::clients::{positions, team};
use crate::sandbox::*;
use flate2::Compression;
use flate2::read::{GzDecoder, GzEncoder, ZlibDecoder, ZlibEncoder};
use http_body_util::BodyExt as _;
use magex_commander::service::ServiceConfig;
use magex_proto::v1;
use magex_runtime::client;
use prost::Message;
use std::io::Read as _;
use std::time::Duration;
use tokio_stream::StreamExt as _;
use tokio_stream::wrappers::ReceiverStream;
use tonic::body::Body;
use tonic::codegen::http::HeaderMap;
use tonic::codegen::{Bytes, Service as _, http};
use tonic::transport::Channel;
use tonic::{Code, Status};
use tonic_health::pb::HealthCheckRequest;
use tonic_reflection::pb::v1::ServerReflectionRequest;
use tonic_reflection::pb::v1::server_reflection_client::ServerReflectionClient;
use tonic_reflection::pb::v1::server_reflection_request::MessageRequest;
use tonic_reflection::pb::v1::server_reflection_response::MessageResponse;

async fn channel(url: &str) -> Channel {
    client::endpoint(url).unwrap().connect().await.unwrap()
}

/// A team of `n`, whose coordinates compress well.
fn flat(n: usize) -> v1::AssignRequest {
    v1::AssignRequest { agents: positions(&vec![0.5; 2 * n]), goals: positions(&vec![0.5; 2 * n]), ..team() }
}

/// A call as a client of another maker sends it: headers and one compressed message. Returns the headers of the response, its
/// messages (compressed ones inflated here), and its status.
async fn raw(url: &str, path: &str, encoding: &str, message: &impl Message) -> (HeaderMap, Vec<Vec<u8>>, Status) {
    let mut packed = Vec::new();
    match encoding {
        "deflate" => ZlibEncoder::new(&message.encode_to_vec()[..], Compression::best()).read_to_end(&mut packed),
        _ => GzEncoder::new(&message.encode_to_vec()[..], Compression::best()).read_to_end(&mut packed),
    }
    .unwrap();
    let body = [&[1][..], &(packed.len() as u32).to_be_bytes(), &packed].concat();
    let request = http::Request::post(format!("{url}{path}"))
        .header("content-type", "application/grpc")
        .header("te", "trailers")
        .header("grpc-encoding", encoding)
        .header("grpc-accept-encoding", format!("identity,{encoding}"));
    let request = request.body(Body::new(http_body_util::Full::new(Bytes::from(body)))).unwrap();
    let mut channel = channel(url).await;
    std::future::poll_fn(|cx| channel.poll_ready(cx)).await.unwrap();
    let (head, body) = within(channel.call(request)).await.unwrap().into_parts();
    let body = within(body.collect()).await.unwrap();
    let trailers = body.trailers().cloned();
    let status = trailers.as_ref().and_then(Status::from_header_map).or_else(|| Status::from_header_map(&head.headers));
    let (bytes, mut messages) = (body.to_bytes(), Vec::new());
    let mut rest = &bytes[..];
    while let [flag, a, b, c, d, after @ ..] = rest {
        let (message, after) = after.split_at(u32::from_be_bytes([*a, *b, *c, *d]) as usize);
        let mut plain = Vec::new();
        match (flag, encoding) {
            (0, _) => plain.extend_from_slice(message),
            (_, "deflate") => drop(ZlibDecoder::new(message).read_to_end(&mut plain).unwrap()),
            _ => drop(GzDecoder::new(message).read_to_end(&mut plain).unwrap()),
        }
        messages.push(plain);
        rest = after;
    }
    (head.headers, messages, status.unwrap())
}

#[tokio::test(flavor = "multi_thread")]
async fn compressed_calls_are_answered_and_limits_count_what_comes_out() {
    let config = ServiceConfig { message_bytes: 100_000, ..ServiceConfig::default() };
    let commander = Commander::start_with("127.0.0.1:0", config, load_fake).await;
    let assign = "/magex.v1.CommanderService/Assign";
    let greedy = |n| v1::AssignRequest { scheduler: v1::AssignmentMethod::Greedy.into(), ..flat(n) };
    for encoding in ["gzip", "deflate"] {
        // A short answer, and a long one.
        for n in [2, 300] {
            let (headers, messages, status) = raw(&commander.url, assign, encoding, &greedy(n)).await;
            assert_eq!(status.code(), Code::Ok, "{status}");
            // What is offered stands in every answer, for clients that choose by it.
            assert_eq!(headers["grpc-accept-encoding"], "gzip,deflate,identity");
            assert_eq!(headers["grpc-encoding"], encoding);
            assert_eq!(v1::AssignResponse::decode(&messages[0][..]).unwrap().pairs.len(), n);
        }
        // 12,000 points of 8 bytes on each side: a kilobyte on the wire, and more than the limit behind it.
        let (_, _, status) = raw(&commander.url, assign, encoding, &greedy(12_000)).await;
        assert!(status.code() == Code::OutOfRange && status.message().contains("100000"), "{status}");
        let check = "/grpc.health.v1.Health/Check";
        let (_, messages, status) = raw(&commander.url, check, encoding, &HealthCheckRequest::default()).await;
        assert_eq!((status.code(), messages.len()), (Code::Ok, 1));
        let long = HealthCheckRequest { service: "x".repeat(100_000) };
        assert_eq!(raw(&commander.url, check, encoding, &long).await.2.code(), Code::OutOfRange);
    }
    let (headers, _, status) = raw(&commander.url, assign, "snappy", &greedy(2)).await;
    assert!(status.code() == Code::Unimplemented && status.message().contains("'snappy'"), "{status}");
    assert_eq!(headers["grpc-accept-encoding"], "gzip,deflate,identity");
    commander.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn reflection_lists_what_the_service_offers() {
    let (learner, commander) = (Learner::start().await, Commander::start("127.0.0.1:0", None).await);
    for (url, own) in [(&learner.url, "magex.v1.LearnerService"), (&commander.url, "magex.v1.CommanderService")] {
        let mut client = ServerReflectionClient::new(channel(url).await);
        let ask = |request| ServerReflectionRequest { host: String::new(), message_request: Some(request) };
        let requests = [
            ask(MessageRequest::ListServices(String::new())),
            ask(MessageRequest::FileContainingSymbol(own.to_owned())),
        ];
        let mut answers = client.server_reflection_info(tokio_stream::iter(requests)).await.unwrap().into_inner();
        let listed = within(answers.message()).await.unwrap().unwrap().message_response;
        let Some(MessageResponse::ListServicesResponse(listed)) = listed else { panic!("{listed:?}") };
        let mut names: Vec<String> = listed.service.into_iter().map(|service| service.name).collect();
        names.sort();
        assert_eq!(names, ["grpc.health.v1.Health", own]);
        let file = within(answers.message()).await.unwrap().unwrap().message_response;
        assert!(matches!(file, Some(MessageResponse::FileDescriptorResponse(_))), "{file:?}");
    }
    commander.stop().await;
    learner.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn quiet_streams_carry_heartbeats_and_the_rest_in_order() {
    let heartbeat = Some(Duration::from_millis(20));
    let config = ServiceConfig { heartbeat, ..ServiceConfig::default() };
    let commander = Commander::start_with("127.0.0.1:0", config, load_fake).await;
    let mut client = commander_client(&commander.url).await;
    let request = v1::WatchAssignmentsRequest { mission_ids: vec!["mine".into()], ..Default::default() };
    let mut events = client.watch_assignments(request).await.unwrap().into_inner();
    let (_sender, receiver) = tokio::sync::mpsc::channel::<v1::AssignStreamRequest>(1);
    let mut answers = client.assign_stream(ReceiverStream::new(receiver)).await.unwrap().into_inner();
    let mut kinds = Vec::new();
    while kinds.len() < 4 {
        kinds.push(within(events.message()).await.unwrap().unwrap().kind());
        // Events of others do not keep this watcher's heartbeats away.
        client.create_mission(v1::CreateMissionRequest::default()).await.unwrap();
        let answer = within(answers.message()).await.unwrap().unwrap();
        assert_eq!((answer.sequence, answer.result), (0, None));
    }
    use v1::WatchKind::{Heartbeat, Synced};
    assert_eq!(kinds, [Synced, Heartbeat, Heartbeat, Heartbeat]);
    let mine = v1::CreateMissionRequest { mission_id: "mine".into(), ..Default::default() };
    client.create_mission(mine).await.unwrap();
    let mut rest = events.filter(|event| event.as_ref().is_ok_and(|event| event.kind() != Heartbeat));
    assert_eq!(within(rest.next()).await.unwrap().unwrap().kind(), v1::WatchKind::Changed);
    commander.stop().await;

    // The learner's streams: those of outside clients, and the weights that actors follow.
    let mut learner = Learner::start_with(LearnerOptions { heartbeat, ..LearnerOptions::default() }).await;
    let mut watching = learner_client(&learner.url).await;
    let mut events = watching.watch_run(v1::WatchRunRequest {}).await.unwrap().into_inner();
    for _ in 0..3 {
        assert_eq!(within(events.message()).await.unwrap().unwrap().event, None);
    }
    let mut raw = watching.watch_weights(v1::WatchWeightsRequest::default()).await.unwrap().into_inner();
    assert_eq!(within(raw.message()).await.unwrap().unwrap(), v1::WatchWeightsResponse::default());
    let actor = Actor::start_with(config_of(&learner), FakeWorker::default());
    tokio::time::sleep(Duration::from_millis(100)).await;
    assert_eq!(learner.iterate(0, 4).await.unwrap(), expected(&plan(0, 4)));
    actor.stop().await;
    learner.stop().await;
}

fn config_of(learner: &Learner) -> magex_actor::run::ActorConfig {
    config(&learner.url, "a")
}
