//! Listening and serving.

pub use crate::net::connections::Incoming;
use crate::net::connections::{ConnectionLimits, Connections};
use crate::net::guard::Guard;
use crate::tls::{ServerTls, TlsError};
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

/// Why a service cannot listen.
#[derive(Debug, thiserror::Error)]
pub enum BindError {
    /// The address is malformed.
    #[error("'{address}' is not an address to listen on: use the form host:port, for example {option} 127.0.0.1:7000")]
    Address {
        /// The address given.
        address: String,
        /// The option that sets it.
        option: &'static str,
    },
    /// Another process listens there.
    #[error("port {port} is in use ({address}): choose another with {option}, or port 0 for any free one")]
    InUse {
        /// The option that sets it.
        option: &'static str,
        /// The address.
        address: String,
        /// Its port.
        port: u16,
    },
    /// Another error of the system.
    #[error("cannot listen on {address}: {source}; choose another with {option}")]
    Other {
        /// The option that sets it.
        option: &'static str,
        /// The address.
        address: String,
        /// The error of the system.
        source: Error,
    },
}

/// Listens on `host:port`; port 0 is any free one. Must be called within a runtime.
pub async fn bind(listen: &str) -> Result<(Incoming, SocketAddr), BindError> {
    let (listener, local) = listener(listen, LISTEN).await?;
    Ok((incoming(listener), local))
}

/// Listens on the address that an option gave.
pub(crate) async fn listener(listen: &str, option: &'static str) -> Result<(TcpListener, SocketAddr), BindError> {
    let wanted = resolve_for(listen, option)?;
    let failed = |source: Error| match source.kind() {
        ErrorKind::AddrInUse => BindError::InUse { option, address: listen.to_owned(), port: wanted.port() },
        _ => BindError::Other { option, address: listen.to_owned(), source },
    };
    let listener = TcpListener::bind(wanted).await.map_err(failed)?;
    let local = listener.local_addr().map_err(failed)?;
    Ok((listener, local))
}

/// The connections of a listener, within the usual limits.
pub fn incoming(listener: TcpListener) -> Incoming {
    Incoming::new(listener, ConnectionLimits::default())
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

/// [`builder`], with TLS if there are certificates.
///
/// # Errors
/// The certificates are invalid.
pub fn secure_builder(tls: Option<&ServerTls>) -> Result<Server, TlsError> {
    match tls {
        Some(tls) => builder().tls_config(tls.config()).map_err(|error| TlsError::Unusable(error.to_string())),
        None => Ok(builder()),
    }
}

/// Resolves `host:port`.
///
/// # Errors
/// The address is malformed or unknown.
pub fn resolve(listen: &str) -> Result<SocketAddr, BindError> {
    resolve_for(listen, LISTEN)
}

fn resolve_for(listen: &str, option: &'static str) -> Result<SocketAddr, BindError> {
    let wrong = || BindError::Address { address: listen.to_owned(), option };
    listen.to_socket_addrs().map_err(|_| wrong())?.next().ok_or_else(wrong)
}

/// Serves until `shutdown`, then stops accepting, waits at most `grace` for open calls, and drops the rest.
pub async fn serve(
    router: Router,
    incoming: Incoming,
    shutdown: CancellationToken,
    grace: Duration,
) -> Result<(), tonic::transport::Error> {
    let serving = router.serve_with_incoming_shutdown(incoming, shutdown.clone().cancelled_owned());
    match within(serving, shutdown, grace).await {
        Some(result) => result,
        None => {
            tracing::debug!(grace_seconds = grace.as_secs_f64(), "dropped connections that did not close");
            Ok(())
        }
    }
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

/// Adds reflection (v1, and v1alpha for older tools) for an encoded descriptor set and for health.
///
/// # Errors
/// The descriptors cannot be decoded.
pub fn with_reflection(
    router: Router,
    descriptors: &'static [u8],
    connections: &Connections,
) -> Result<Router, ReflectionError> {
    let describe = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(descriptors)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
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
        let server = tokio::spawn(serve(router, incoming, shutdown.clone(), Duration::from_millis(100)));
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
