//! The operators' HTTP server of a service, on its own address: metrics, and the pages that the service adds.
//!
//! Read-only and optional: training does not depend on it.

use crate::exit::Failure;
use crate::metrics::Metrics;
use crate::net::connections::{ConnectionLimits, Incoming};
use crate::server::{self, GRACE};
pub use axum::Router;
use axum::extract::connect_info::Connected;
use axum::extract::{ConnectInfo, Request};
use axum::http::header::CONTENT_TYPE;
use axum::middleware::{Next, from_fn};
use axum::response::IntoResponse as _;
use axum::routing::get;
use axum::serve::IncomingStream;
use std::io::Error;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

/// Operators and their tools are few; idle sockets are closed.
const CONNECTIONS: ConnectionLimits =
    ConnectionLimits { total: 256, per_peer: 256, first_call: Duration::from_secs(10) };

/// The option of every service with an HTTP server.
#[derive(Debug, Clone, Default, clap::Args, serde::Serialize)]
pub struct HttpArgs {
    /// Address for operators: /metrics for Prometheus and /healthz, over plain HTTP; port 0 is any free one [default: none]
    #[arg(long, env = "MAGEX_HTTP", value_name = "HOST:PORT")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub http: Option<String>,
}

impl HttpArgs {
    /// Listens, if an address is given. Must be called within a runtime.
    pub async fn bind(&self) -> Result<Option<Page>, Failure> {
        match &self.http {
            Some(listen) => bind(listen).await.map(Some),
            None => Ok(None),
        }
    }
}

/// A bound HTTP server that does not serve yet.
#[derive(Debug)]
pub struct Page {
    incoming: Incoming,
    address: SocketAddr,
}

impl Page {
    /// The address it listens on.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Serves in the background until `shutdown`, and at most [`GRACE`] longer. Errors are only logged.
    pub fn serve(self, routes: Router, shutdown: CancellationToken) -> JoinHandle<()> {
        tokio::spawn(async move {
            if let Err(error) = serve(self.incoming, routes, shutdown).await {
                tracing::error!(%error, "the HTTP server failed; metrics are no longer served");
            }
        })
    }
}

/// Listens on `host:port`; port 0 is any free one. Must be called within a runtime.
pub async fn bind(listen: &str) -> Result<Page, Failure> {
    let (listener, address) = server::listener(listen, "--http").await?;
    Ok(Page { incoming: Incoming::new(listener, CONNECTIONS), address })
}

/// `/metrics` in the text format of Prometheus, and `/healthz`, which answers as long as the process is alive.
pub fn routes(metrics: Arc<Metrics>) -> Router {
    let scrape = move || {
        let text = metrics.text();
        async move { ([(CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], text).into_response() }
    };
    Router::new().route("/metrics", get(scrape)).route("/healthz", get(async || "ok\n"))
}

/// The peer of a request's connection.
#[derive(Debug, Clone, Copy)]
struct Peer(SocketAddr);

impl Connected<IncomingStream<'_, Incoming>> for Peer {
    fn connect_info(stream: IncomingStream<'_, Incoming>) -> Self {
        Self(*stream.remote_addr())
    }
}

async fn serve(incoming: Incoming, routes: Router, shutdown: CancellationToken) -> Result<(), Error> {
    let connections = incoming.connections();
    let routes = routes.layer(from_fn(move |ConnectInfo(Peer(address)), request: Request, next: Next| {
        connections.probed(address);
        next.run(request)
    }));
    let service = routes.into_make_service_with_connect_info::<Peer>();
    let serving = axum::serve(incoming, service).with_graceful_shutdown(shutdown.clone().cancelled_owned());
    server::within(serving.into_future(), shutdown, GRACE).await.unwrap_or(Ok(()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};

    #[tokio::test]
    async fn metrics_are_served_until_the_end() {
        let page = HttpArgs { http: Some("127.0.0.1:0".into()) }.bind().await.unwrap().unwrap();
        let address = page.address();
        let shutdown = CancellationToken::new();
        let metrics = Arc::new(Metrics::new());
        let serving = page.serve(routes(metrics), shutdown.clone());
        let mut socket = tokio::net::TcpStream::connect(address).await.unwrap();
        socket.write_all(b"GET /metrics HTTP/1.0\r\n\r\n").await.unwrap();
        let mut answer = String::new();
        socket.read_to_string(&mut answer).await.unwrap();
        assert!(answer.starts_with("HTTP/1.0 200") && answer.contains("process_resident_memory_bytes"), "{answer}");
        shutdown.cancel();
        serving.await.unwrap();
    }

    #[tokio::test]
    async fn idle_sockets_are_evicted() {
        let page = bind("127.0.0.1:0").await.unwrap();
        let address = page.address();
        let connections = page.incoming.connections();
        let shutdown = CancellationToken::new();
        let serving = page.serve(routes(Arc::new(Metrics::new())), shutdown.clone());
        let mut idle = Vec::new();
        for _ in 0..CONNECTIONS.total + 20 {
            idle.push(tokio::net::TcpStream::connect(address).await.unwrap());
        }
        let mut socket = tokio::net::TcpStream::connect(address).await.unwrap();
        socket.write_all(b"GET /healthz HTTP/1.0\r\n\r\n").await.unwrap();
        let mut answer = String::new();
        socket.read_to_string(&mut answer).await.unwrap();
        assert!(answer.ends_with("ok\n") && connections.open() <= CONNECTIONS.total, "{answer}");
        shutdown.cancel();
        serving.await.unwrap();
    }

    #[tokio::test]
    async fn without_an_address_nothing_is_opened_and_a_malformed_one_is_named() {
        assert!(HttpArgs::default().bind().await.unwrap().is_none());
        let page = bind("127.0.0.1:0").await.unwrap();
        let taken = page.address().to_string();
        for (listen, words) in [(taken.as_str(), "is in use"), ("nonsense", "host:port")] {
            let error = HttpArgs { http: Some(listen.into()) }.bind().await.unwrap_err().to_string();
            assert!(error.contains(words), "{error}");
            assert!(listen == "nonsense" || error.contains("--http"), "{error}");
        }
    }
}
