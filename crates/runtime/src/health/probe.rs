//! Health check of a service, for orchestrators that run it inside the service's container.

use crate::Boxed;
use crate::client::{Settings, endpoint_from_env};
use crate::exit::{self, Failure};
use crate::peer;
use std::time::Duration;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tonic::Code;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

/// Default timeout of a health check.
pub const DEADLINE: Duration = Duration::from_secs(2);

/// Bytes that are read of a page.
const PAGE: u64 = 4096;

/// Checks the service at `url` once. A URL without a path is checked over gRPC (grpc.health.v1) for `service`, or for the whole
/// process if that is empty; https uses the certificates that `MAGEX_TLS_CA`, `MAGEX_TLS_CERT` and `MAGEX_TLS_KEY` name. A URL
/// with a path is a page, such as http://host:port/healthz, that must answer 200.
pub fn ask<'a>(url: &'a str, service: &'a str, deadline: Duration) -> Boxed<'a, Result<(), Failure>> {
    let asking = async move {
        match page_of(url) {
            Some((authority, path)) => ask_page(url, authority, path).await,
            None => ask_grpc(url, service).await,
        }
    };
    Box::pin(async move {
        let late = |_| absent(format!("{url} did not answer within {} s", deadline.as_secs_f64()));
        tokio::time::timeout(deadline, asking).await.map_err(late)?
    })
}

/// The service is there and not healthy.
fn unhealthy(problem: String) -> Failure {
    Failure::new(exit::FAILURE, problem)
}

/// No service answers there, or something else does.
fn absent(problem: String) -> Failure {
    Failure::new(exit::UNAVAILABLE, problem)
}

/// [`ask`] on its own runtime. Returns the exit code.
pub fn run(url: &str, service: &str, deadline: Duration) -> Result<u8, Failure> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(|error| Failure::new(exit::INTERNAL, error))?;
    runtime.block_on(ask(url, service, deadline)).map(|()| exit::OK)
}

/// Checks the service that was started on this machine with these options. For orchestrators: every failure has one code.
pub fn own(listen: &str, secure: bool) -> Result<u8, Failure> {
    let scheme = if secure { "https" } else { "http" };
    check_own(&format!("{scheme}://{}", reachable(listen)))
}

fn check_own(url: &str) -> Result<u8, Failure> {
    run(url, "", DEADLINE).map_err(|error| match error.code {
        exit::UNAVAILABLE => unhealthy(error.message),
        _ => error,
    })
}

/// Checks the HTTP server of the program that was started on this machine with these options. A missing address is wrong usage.
pub fn own_page(listen: Option<&str>) -> Result<u8, Failure> {
    let listen = listen.ok_or_else(|| {
        Failure::usage("--health-check: needs the address of the HTTP server; set --http or MAGEX_HTTP")
    })?;
    check_own(&format!("http://{}/healthz", reachable(listen)))
}

/// The address of a listener from its own machine. Loopback addresses become `localhost`, because certificates contain names.
fn reachable(listen: &str) -> String {
    let (host, port) = listen.rsplit_once(':').unwrap_or((listen, ""));
    let address = host.trim_start_matches('[').trim_end_matches(']').parse::<std::net::IpAddr>();
    match address {
        Ok(address) if address.is_unspecified() || address == std::net::Ipv4Addr::LOCALHOST => {
            format!("localhost:{port}")
        }
        _ => listen.to_owned(),
    }
}

/// Host with port, and path, of a URL with a path.
fn page_of(url: &str) -> Option<(&str, &str)> {
    let rest = url.strip_prefix("http://")?;
    let slash = rest.find('/')?;
    let (authority, path) = rest.split_at(slash);
    (path.len() > 1).then_some((authority, path))
}

async fn ask_grpc(url: &str, service: &str) -> Result<(), Failure> {
    let endpoint = endpoint_from_env(url)?;
    let request = HealthCheckRequest { service: service.to_owned() };
    let answer = match HealthClient::new(endpoint.connect_lazy()).check(request).await {
        Ok(answer) => answer,
        Err(status) if status.code() == Code::NotFound => {
            return Err(unhealthy(format!("{url}: no service '{service}'")));
        }
        Err(status) => {
            let settings = Settings { tls: endpoint.tls().map(|(tls, _)| tls.clone()), ..Settings::default() };
            return Err(absent(peer::explain(&settings, url, "magex service", &[], &status).await.text));
        }
    };
    match answer.into_inner().status() {
        ServingStatus::Serving => Ok(()),
        other => Err(unhealthy(format!("{url} reports {}", other.as_str_name()))),
    }
}

async fn ask_page(url: &str, authority: &str, path: &str) -> Result<(), Failure> {
    let unreachable = |error: std::io::Error| absent(format!("{url}: {error}"));
    let mut socket = TcpStream::connect(authority).await.map_err(unreachable)?;
    let request = format!("GET {path} HTTP/1.0\r\nHost: {authority}\r\n\r\n");
    socket.write_all(request.as_bytes()).await.map_err(unreachable)?;
    let mut answer = Vec::new();
    socket.take(PAGE).read_to_end(&mut answer).await.map_err(unreachable)?;
    let text = String::from_utf8_lossy(&answer);
    let line = text.lines().next().unwrap_or_default();
    if line.split_whitespace().nth(1) == Some("200") {
        return Ok(());
    }
    let status = if line.is_empty() { "nothing".to_owned() } else { format!("'{line}'") };
    Err(unhealthy(format!("{url} reports {status}")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::health::Health;
    use crate::server;
    use tokio_util::sync::CancellationToken;

    struct Named;
    impl tonic::server::NamedService for Named {
        const NAME: &'static str = "test.Named";
    }

    const SOON: Duration = Duration::from_secs(5);

    #[tokio::test]
    async fn health_follows_the_reported_status() {
        let (incoming, address) = server::bind("127.0.0.1:0").await.unwrap();
        let (health, service) = Health::new::<Named>().await;
        let stop = CancellationToken::new();
        let router = server::builder().add_service(service);
        let serving = tokio::spawn(server::serve(router, incoming, None, stop.clone(), Duration::ZERO));
        let url = format!("http://{address}");
        for (healthy, service) in [(false, ""), (true, ""), (true, "test.Named"), (false, "test.Named")] {
            health.set(healthy).await;
            let answer = ask(&url, service, SOON).await;
            assert_eq!(answer.is_ok(), healthy, "{answer:?}");
            assert!(healthy || answer.unwrap_err().to_string().contains("NOT_SERVING"));
        }
        let error = ask(&url, "test.Other", SOON).await.unwrap_err().to_string();
        assert!(error.contains("no service 'test.Other'"), "{error}");
        stop.cancel();
        serving.await.unwrap().unwrap();
        let error = ask(&url, "", SOON).await.unwrap_err();
        assert!(error.code == exit::UNAVAILABLE && error.message.contains("nothing listens at 127.0.0.1:"), "{error}");
    }

    #[tokio::test]
    async fn a_page_must_answer_200() {
        let page = crate::http::bind("127.0.0.1:0").await.unwrap();
        let (address, stop) = (page.address(), CancellationToken::new());
        let metrics = std::sync::Arc::new(crate::metrics::Metrics::new());
        let serving = page.serve(crate::http::routes(metrics), stop.clone());
        ask(&format!("http://{address}/healthz"), "", SOON).await.unwrap();
        let error = ask(&format!("http://{address}/nothing"), "", SOON).await.unwrap_err().to_string();
        assert!(error.contains("404"), "{error}");
        stop.cancel();
        serving.await.unwrap();
    }

    #[tokio::test]
    async fn a_silent_service_times_out() {
        let mute = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = mute.local_addr().unwrap();
        for url in [format!("http://{address}"), format!("http://{address}/healthz")] {
            let error = ask(&url, "", Duration::from_millis(200)).await.unwrap_err();
            assert!(
                error.code == exit::UNAVAILABLE && error.message.contains("did not answer within 0.2 s"),
                "{error}"
            );
        }
    }

    #[test]
    fn loopback_listeners_are_reached_by_name() {
        let cases = [
            ("0.0.0.0:7000", "localhost:7000"),
            ("[::]:7000", "localhost:7000"),
            ("127.0.0.1:7000", "localhost:7000"),
            ("10.0.0.1:7000", "10.0.0.1:7000"),
            ("learner:7000", "learner:7000"),
        ];
        for (listen, url) in cases {
            assert_eq!(reachable(listen), url);
        }
        assert_eq!(page_of("http://h:1/healthz"), Some(("h:1", "/healthz")));
        assert_eq!((page_of("http://h:1/"), page_of("http://h:1"), page_of("https://h:1/x")), (None, None, None));
        assert_eq!(own_page(None).unwrap_err().code, exit::USAGE);
    }
}
