//! Listening and serving.

use crate::Boxed;
use crate::exit::{self, Failure};
pub use crate::net::connections::Incoming;
use crate::net::connections::{ConnectionLimits, Connections};
use crate::net::guard::Guard;
use crate::net::socket::Sockets;
use crate::tls::ServerTls;
use std::future::Future;
use std::io::{Error, ErrorKind};
use std::net::{SocketAddr, ToSocketAddrs as _};
use std::time::Duration;
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;
use tonic::transport::Server;
use tonic::transport::server::Router;
pub use tonic_reflection::server::Error as ReflectionError;

/// How long a server waits after shutdown for open connections before it drops them. Our own streams end at once; this is for
/// silent peers. With the rest of a service's shutdown it stays within a budget of 10 s.
pub const GRACE: Duration = Duration::from_secs(3);

/// The option with a service's address.
const LISTEN: &str = "--listen";

/// Listens on `host:port`; port 0 is any free one. Must be called within a runtime.
pub async fn bind(listen: &str) -> Result<(Incoming, SocketAddr), Failure> {
    let (listener, local) = listener(listen, LISTEN).await?;
    Ok((Incoming::new(listener, ConnectionLimits::default()), local))
}

/// Listens on the address that an option gave.
pub(crate) async fn listener(listen: &str, option: &str) -> Result<(TcpListener, SocketAddr), Failure> {
    let unavailable = |problem: String| Failure::new(exit::UNAVAILABLE, problem);
    let wanted = resolve_for(listen, option).map_err(Failure::usage)?;
    let failed = |error: Error| {
        unavailable(match error.kind() {
            ErrorKind::AddrInUse => {
                let port = wanted.port();
                format!("port {port} is in use ({listen}): choose another with {option}, or port 0 for any free one")
            }
            _ => format!("cannot listen on {listen}: {error}; choose another with {option}"),
        })
    };
    let listener = TcpListener::bind(wanted).await.map_err(failed)?;
    let local = listener.local_addr().map_err(failed)?;
    Ok((listener, local))
}

/// A server with our settings: silent peers are detected within 15 s, and the streams of a connection are limited.
pub fn builder() -> Server {
    Server::builder()
        .http2_keepalive_interval(Some(Duration::from_secs(10)))
        .http2_keepalive_timeout(Some(Duration::from_secs(5)))
        .max_concurrent_streams(256)
        .http2_max_header_list_size(16 << 10)
        .initial_stream_window_size(8 << 20)
        .initial_connection_window_size(16 << 20)
}

/// Resolves `host:port`.
pub fn resolve(listen: &str) -> Result<SocketAddr, Failure> {
    resolve_for(listen, LISTEN).map_err(Failure::usage)
}

fn resolve_for(listen: &str, option: &str) -> Result<SocketAddr, String> {
    listen.to_socket_addrs().ok().and_then(|mut addresses| addresses.next()).ok_or_else(|| {
        format!(
            "{option}: '{listen}' is not an address to listen on; use the form host:port, for example 127.0.0.1:7000"
        )
    })
}

/// Serves until `shutdown`, then stops accepting, waits at most `grace` for open calls, and drops the rest. With certificates,
/// connections are encrypted.
pub fn serve(
    router: Router,
    incoming: Incoming,
    tls: Option<ServerTls>,
    shutdown: CancellationToken,
    grace: Duration,
) -> Boxed<'static, Result<(), tonic::transport::Error>> {
    Box::pin(async move {
        let serving =
            router.serve_with_incoming_shutdown(Sockets::new(incoming, tls), shutdown.clone().cancelled_owned());
        match within(serving, shutdown, grace).await {
            Some(result) => result,
            None => {
                tracing::debug!(grace_seconds = grace.as_secs_f64(), "dropped connections that did not close");
                Ok(())
            }
        }
    })
}

/// The future's value, or `None` if it is not ready `grace` after `shutdown`.
pub(crate) async fn within<T>(
    future: impl Future<Output = T>,
    shutdown: CancellationToken,
    grace: Duration,
) -> Option<T> {
    tokio::select! {
        value = future => Some(value),
        () = async { shutdown.cancelled().await; tokio::time::sleep(grace).await } => None,
    }
}

/// Adds reflection (v1, and v1alpha for older tools): it lists `service`, which the encoded descriptors describe, and health.
pub fn with_reflection(
    router: Router,
    service: &str,
    descriptors: &'static [u8],
    connections: &Connections,
) -> Result<Router, ReflectionError> {
    let describe = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(descriptors)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
            // The descriptors have the services of other processes, too.
            .with_service_name(service)
            .with_service_name(tonic_health::pb::health_server::SERVICE_NAME)
    };
    let router = router.add_service(Guard::public(describe().build_v1()?, connections.clone()));
    Ok(router.add_service(Guard::public(describe().build_v1alpha()?, connections.clone())))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Instant;

    #[tokio::test]
    async fn a_taken_port_is_named_with_a_remedy() {
        let (_incoming, address) = bind("127.0.0.1:0").await.unwrap();
        let error = bind(&address.to_string()).await.unwrap_err().to_string();
        assert!(error.contains(&format!("port {} is in use", address.port())) && error.contains("--listen"), "{error}");
        let error = bind("nonsense").await.unwrap_err().to_string();
        assert!(error.contains("host:port"), "{error}");
    }

    #[tokio::test]
    async fn an_idle_socket_does_not_delay_shutdown() {
        let (incoming, address) = bind("127.0.0.1:0").await.unwrap();
        let (_health, service) = crate::health::Health::new::<Named>().await;
        let shutdown = CancellationToken::new();
        let router = builder().add_service(service);
        let server = tokio::spawn(serve(router, incoming, None, shutdown.clone(), Duration::from_millis(100)));
        let _idle = tokio::net::TcpStream::connect(address).await.unwrap();
        tokio::time::sleep(Duration::from_millis(50)).await;
        let start = Instant::now();
        shutdown.cancel();
        server.await.unwrap().unwrap();
        assert!(start.elapsed() < Duration::from_secs(5));
    }

    struct Named;
    impl tonic::server::NamedService for Named {
        const NAME: &'static str = "test";
    }
}
