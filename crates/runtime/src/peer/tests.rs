use super::*;
use crate::health::Health;
use crate::server;
use crate::tls::ServerTls;
use crate::tls::tests::made;
use std::path::{Path, PathBuf};
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;
use tonic_health::pb::HealthCheckResponse;

struct Learner;
impl tonic::server::NamedService for Learner {
    const NAME: &'static str = "test.Learner";
}

const KNOWN: [NamedService; 2] = [("test.Learner", "learner"), ("test.Commander", "commander")];

/// A server with health and nothing else; its address.
async fn serves(tls: Option<ServerTls>) -> String {
    serves_at("127.0.0.1:0", tls).await
}

async fn serves_at(listen: &str, tls: Option<ServerTls>) -> String {
    let (incoming, address) = server::bind(listen).await.unwrap();
    let (_, service) = Health::new::<Learner>().await;
    let router = server::builder().add_service(service);
    tokio::spawn(server::serve(router, incoming, tls, CancellationToken::new(), Duration::ZERO));
    address.to_string()
}

/// A server that reads and then says this; its address.
async fn says(answer: &'static [u8]) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap().to_string();
    tokio::spawn(async move {
        loop {
            let (mut socket, _) = listener.accept().await.unwrap();
            let _ = socket.read(&mut [0; 1024]).await;
            let _ = socket.write_all(answer).await;
        }
    });
    address
}

/// What is said of a call to a commander at `url`.
async fn asked(settings: &Settings, url: &str) -> Explanation {
    let channel = settings.lazy_channel(url).unwrap();
    let mut client = tonic::client::Grpc::new(channel);
    client.ready().await.ok();
    let codec = tonic_prost::ProstCodec::<HealthCheckRequest, HealthCheckResponse>::default();
    let path = tonic::codegen::http::uri::PathAndQuery::from_static("/test.Commander/Assign");
    let request = tonic::Request::new(HealthCheckRequest::default());
    let status = client.unary(request, path, codec).await.map(|_| ()).unwrap_err();
    explain(settings, url, "commander", &KNOWN, &status).await
}

fn trusting(ca: &Path, own: Option<&(PathBuf, PathBuf)>) -> Settings {
    let (certificate, key) = own.map(|(certificate, key)| (certificate.as_path(), key.as_path())).unzip();
    Settings { tls: Some(ClientTls::read(ca, certificate, key).unwrap()), ..Settings::default() }
}

#[tokio::test]
async fn without_tls_whatever_is_there_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let (certificate, key) = made(folder.path(), "own", 2100);
    let secure = serves(Some(ServerTls::read(&certificate, &key, None).unwrap())).await;
    let closed = TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap().to_string();
    for (address, permanent, words) in [
        (serves(None).await, true, "a learner answers at http://"),
        (secure, true, "wants TLS; use https://"),
        (says(b"HTTP/1.1 400 Bad Request\r\n\r\n").await, true, "a web server answers at"),
        (says(b"HTTP/1.0 400 Bad Request\r\n\r\nThis is an HTTPS server").await, true, "wants TLS; use https://"),
        (says(b"SSH-2.0-OpenSSH_9.6\r\n").await, true, "does not speak gRPC (it begins with 'SSH-2.0-OpenSSH_9.6')"),
        (says(b"\x15\x03\x01\x00\x02\x02\x46").await, true, "wants TLS"),
        (says(b"").await, false, "closes the connection without an answer"),
        (closed, false, "nothing listens at 127.0.0.1:"),
    ] {
        let found = asked(&Settings::default(), &format!("http://{address}")).await;
        assert!(found.text.contains(words) && found.permanent == permanent, "{found:?} instead of {words}");
    }
}

#[tokio::test]
async fn with_tls_every_disagreement_has_its_sentence() {
    let folder = tempfile::tempdir().unwrap();
    let make = |name: &str, year| made(folder.path(), name, year);
    let (own, other, ended) = (make("own", 2100), make("other", 2100), make("ended", 2001));
    let tls = |pair: &(PathBuf, PathBuf), ca: Option<&Path>| ServerTls::read(&pair.0, &pair.1, ca).unwrap();
    let open = serves(Some(tls(&own, None))).await;
    let mutual = serves(Some(tls(&own, Some(&own.0)))).await;
    let over = serves(Some(tls(&ended, None))).await;
    let plain = serves(None).await;
    let web = says(b"HTTP/1.1 400 Bad Request\r\n\r\n").await;
    for (address, ca, shown, words) in [
        (&open, &own, None, "a learner answers at https://"),
        (&open, &other, None, "is not of the CA in"),
        (&over, &ended, None, "ended"),
        (&plain, &own, None, "answers without TLS: use http://"),
        (&web, &own, None, "answers without TLS: use http://"),
        (&mutual, &own, None, "wants a client certificate: give --tls-cert and --tls-key"),
        (&mutual, &own, Some(&other), "client certificate"),
        (&mutual, &own, Some(&own), "a learner answers at https://"),
    ] {
        let found = asked(&trusting(&ca.0, shown), &format!("https://{address}")).await;
        assert!(found.text.contains(words) && found.permanent, "{found:?} instead of {words}");
    }
    let elsewhere = serves_at("127.0.0.2:0", Some(tls(&own, None))).await;
    let found = asked(&trusting(&own.0, None), &format!("https://{elsewhere}")).await;
    assert!(found.text.contains("is for ") && found.text.contains("localhost"), "{found:?}");
}

#[tokio::test]
async fn what_must_be_changed_is_said_each_time_and_what_may_pass_rarely() {
    let mut complaints = Complaints::default();
    let (passing, other) = (Explanation::new(false, "a"), Explanation::new(false, "b"));
    let permanent = Explanation::new(true, "c");
    let due: Vec<bool> = [&passing, &passing, &other, &other, &permanent, &permanent].map(|e| complaints.due(e)).into();
    assert_eq!(due, [true, false, true, false, true, true]);
    tokio::time::pause();
    assert!(complaints.due(&passing) && !complaints.due(&passing));
    tokio::time::advance(REMIND).await;
    assert!(complaints.due(&passing) && complaints.over() && !complaints.over());
    let status = Status::new(Code::Unimplemented, format!("{NO_GRPC}, mapped from HTTP status code 404"));
    let found = explain(&Settings::default(), "http://x:1", "commander", &KNOWN, &status).await;
    assert!(found.permanent && found.text.contains("(HTTP 404): a web server or a proxy"), "{found:?}");
}
