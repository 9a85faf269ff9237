//! Callers that connect and say nothing, or begin and never end: they get no more than their share, and others do not notice.

use crate::certificates::{Signed, sign, trusting};
use crate::clients::team;
use crate::sandbox::*;
use magex_commander::service::ServiceConfig;
use magex_proto::v1;
use magex_proto::v1::commander_service_client::CommanderServiceClient;
use magex_runtime::client::{Settings, endpoint};
use magex_runtime::net::connections::ConnectionLimits;
use magex_runtime::security::Security;
use magex_runtime::status;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tonic::body::Body;
use tonic::codegen::{Bytes, Service as _, http};
use tonic::transport::Channel;
use tonic::{Code, Status};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

const FEW: ConnectionLimits = ConnectionLimits { total: 8, per_peer: 8, first_call: Duration::from_secs(2) };

pub(crate) async fn healthy(url: &str) {
    let channel = within(endpoint(url).unwrap().connect()).await.unwrap();
    within(HealthClient::new(channel).check(HealthCheckRequest::default())).await.unwrap();
}

/// Until the other side closes it.
async fn closed(socket: &mut TcpStream) {
    let mut rest = Vec::new();
    // A reset is an end, too.
    let _ = within(socket.read_to_end(&mut rest)).await;
}

fn address(url: &str) -> &str {
    url.trim_start_matches("http://")
}

#[tokio::test(flavor = "multi_thread")]
async fn idle_sockets_evict_each_other_and_no_client_that_asks() {
    let commander = Commander::start_within(FEW, ServiceConfig::default()).await;
    let mut client = commander_client(&commander.url).await;
    client.assign(team()).await.unwrap();
    let mut idle = Vec::new();
    for _ in 0..100 {
        idle.push(TcpStream::connect(address(&commander.url)).await.unwrap());
        if idle.len() % 20 == 0 {
            healthy(&commander.url).await;
        }
    }
    client.assign(team()).await.unwrap();
    // Most were closed when others came, the last when their time was over.
    for socket in &mut idle {
        closed(socket).await;
    }
    healthy(&commander.url).await;
    client.assign(team()).await.unwrap();
    commander.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn callers_that_are_at_work_keep_their_places() {
    let limits = ConnectionLimits { total: 3, per_peer: 3, ..FEW };
    let commander = Commander::start_within(limits, ServiceConfig::default()).await;
    let mut clients = Vec::new();
    for _ in 0..3 {
        let mut client = commander_client(&commander.url).await;
        client.assign(team()).await.unwrap();
        clients.push(client);
    }
    let mut fourth = CommanderServiceClient::new(endpoint(&commander.url).unwrap().connect_lazy());
    assert!(within(fourth.assign(team())).await.is_err());
    for client in &mut clients {
        client.assign(team()).await.unwrap();
    }
    clients.pop();
    // The place is free again once the service sees that the caller has gone.
    within(async { while fourth.assign(team()).await.is_err() {} }).await;
    commander.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn handshakes_that_do_not_end_are_ended() {
    let folder = tempfile::tempdir().unwrap();
    let authority: Signed = sign(folder.path(), "authority", None);
    let server = sign(folder.path(), "server", Some(&authority));
    let limits = ConnectionLimits { first_call: Duration::from_secs(1), ..FEW };
    let security = Security { tls: Some(server.server(None)), ..Security::default() };
    let secure = Commander::start_within(limits, ServiceConfig { security, ..ServiceConfig::default() }).await;
    let plain = Commander::start_within(limits, ServiceConfig::default()).await;
    // The first bytes of a TLS handshake, and of HTTP/2, one now and then.
    let drip = async |url: String, bytes: &'static [u8]| {
        let mut socket = TcpStream::connect(address(&url)).await.unwrap();
        for byte in bytes.iter().cycle() {
            if socket.write_all(&[*byte]).await.is_err() {
                break;
            }
            let mut answer = [0; 64];
            let pause = tokio::time::timeout(Duration::from_millis(100), socket.read(&mut answer)).await;
            if matches!(pause, Ok(Ok(0) | Err(_))) {
                break;
            }
        }
    };
    let slow_tls = tokio::spawn(drip(secure.url.clone(), b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03"));
    let slow_preface = tokio::spawn(drip(plain.url.clone(), b"PRI * HTTP/2.0\r\n"));
    let settings = Settings { tls: Some(trusting(&authority, None)), ..Settings::default() };
    let url = secure.url.replace("http://", "https://");
    let mut client = CommanderServiceClient::new(within(settings.connect(&url)).await.unwrap());
    client.assign(team()).await.unwrap();
    within(slow_tls).await.unwrap();
    within(slow_preface).await.unwrap();
    client.assign(team()).await.unwrap();
    healthy(&plain.url).await;
    secure.stop().await;
    plain.stop().await;
}

/// A request's body that says this much and then nothing, without ending.
struct Stuck(Option<Bytes>);

impl http_body::Body for Stuck {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        _: &mut Context<'_>,
    ) -> Poll<Option<Result<http_body::Frame<Bytes>, Status>>> {
        self.0.take().map_or(Poll::Pending, |bytes| Poll::Ready(Some(Ok(http_body::Frame::data(bytes)))))
    }
}

/// Calls a method with a request that no client of ours would send.
pub(crate) async fn post(
    channel: &Channel,
    method: &str,
    body: Body,
) -> impl Future<Output = Result<http::Response<Body>, tonic::transport::Error>> + use<> {
    let mut channel = channel.clone();
    let request = http::Request::post(format!("/magex.v1.CommanderService/{method}"))
        .header("content-type", "application/grpc")
        .header("te", "trailers")
        .body(body)
        .unwrap();
    std::future::poll_fn(|cx| channel.poll_ready(cx)).await.unwrap();
    channel.call(request)
}

/// Calls Assign with a request that announces this many bytes and does not send them. `None` while there is no answer; then
/// the call goes on in `open`.
async fn announce(open: &mut JoinSet<Option<Status>>, channel: &Channel, length: u32) -> Option<Status> {
    let prefix: Vec<u8> = [0].into_iter().chain(length.to_be_bytes()).collect();
    let call = post(channel, "Assign", Body::new(Stuck(Some(prefix.into())))).await;
    open.spawn(async move { Status::from_header_map(call.await.unwrap().headers()) });
    tokio::time::timeout(Duration::from_secs(1), open.join_next()).await.ok()?.unwrap().unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_announced_counts_before_it_arrives() {
    let commander = Commander::start_within(ConnectionLimits::default(), ServiceConfig::default()).await;
    let channel = endpoint(&commander.url).unwrap().connect().await.unwrap();
    // One caller may have 64 MiB on their way.
    let mut open = JoinSet::new();
    assert!(announce(&mut open, &channel, 32 << 20).await.is_none());
    assert!(announce(&mut open, &channel, 32 << 20).await.is_none());
    let refused = announce(&mut open, &channel, 1 << 10).await.unwrap();
    assert_eq!(refused.code(), Code::ResourceExhausted, "{refused}");
    assert!(status::retry_delay(&refused).is_some());
    healthy(&commander.url).await;
    // A connection that is closed no longer counts.
    drop((open, channel));
    let mut client = commander_client(&commander.url).await;
    within(async { while client.assign(team()).await.is_err() {} }).await;
    let mut model = commander_client(&commander.url).await;
    model.get_model(v1::GetModelRequest {}).await.unwrap();
    commander.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_call_counts_from_its_headers_on() {
    let config = ServiceConfig { calls: 2, ..ServiceConfig::default() };
    let commander = Commander::start_within(ConnectionLimits::default(), config).await;
    let channel = endpoint(&commander.url).unwrap().connect().await.unwrap();
    let mut open = JoinSet::new();
    assert!(announce(&mut open, &channel, 8).await.is_none());
    assert!(announce(&mut open, &channel, 8).await.is_none());
    let refused = announce(&mut open, &channel, 8).await.unwrap();
    assert_eq!(refused.code(), Code::ResourceExhausted, "{refused}");
    assert!(refused.message().contains("2 calls in flight") && status::retry_delay(&refused).is_some(), "{refused}");
    healthy(&commander.url).await;
    commander.stop().await;
}
