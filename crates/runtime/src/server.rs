//! Listening and serving.

pub use crate::net::connections::Incoming;
use crate::net::connections::{ConnectionLimits, Connections};
use crate::net::guard::Open;
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

/// How long a server that was told to stop waits for its peers before it leaves them: with what else a service does at its
/// end, within the budget of 10 s. Streams of ours end at once; this is for peers that say nothing.
pub const GRACE: Duration = Duration::from_secs(3);

/// The option that says where a service listens.
const LISTEN: &str = "--listen";

/// A socket that cannot be listened on.
#[derive(Debug, thiserror::Error)]
pub enum BindError {
    /// The address makes no sense.
    #[error("'{address}' is not an address to listen on: use the form host:port, for example {option} 127.0.0.1:7000")]
    Address {
        /// What was given.
        address: String,
        /// The option that sets it.
        option: &'static str,
    },
    /// Somebody else listens there.
    #[error("port {port} is in use ({address}): choose another with {option}, or port 0 for any free one")]
    InUse {
        /// The option that sets it.
        option: &'static str,
        /// The address.
        address: String,
        /// Its port.
        port: u16,
    },
    /// Anything else.
    #[error("cannot listen on {address}: {source}; choose another with {option}")]
    Other {
        /// The option that sets it.
        option: &'static str,
        /// The address.
        address: String,
        /// What the system says.
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

/// A server with our settings: mute peers are noticed within 15 s, and no connection opens streams without bound.
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
/// Certificates that cannot be used.
pub fn secure_builder(tls: Option<&ServerTls>) -> Result<Server, TlsError> {
    match tls {
        Some(tls) => builder().tls_config(tls.config()).map_err(|error| TlsError::Unusable(error.to_string())),
        None => Ok(builder()),
    }
}

/// The address that `host:port` stands for.
///
/// # Errors
/// It makes no sense.
pub fn resolve(listen: &str) -> Result<SocketAddr, BindError> {
    resolve_for(listen, LISTEN)
}

fn resolve_for(listen: &str, option: &'static str) -> Result<SocketAddr, BindError> {
    let wrong = || BindError::Address { address: listen.to_owned(), option };
    listen.to_socket_addrs().map_err(|_| wrong())?.next().ok_or_else(wrong)
}

/// Serves until `shutdown`, then stops accepting, waits for open calls for at most `grace`, and leaves the rest.
/// A connection that never says anything cannot hold it up.
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
            tracing::debug!(grace_seconds = grace.as_secs_f64(), "left connections that did not close");
            Ok(())
        }
    }
}

/// The future's value, unless it is not there `grace` after `shutdown`.
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

/// Adds reflection (v1, and v1alpha for older tools) for an encoded descriptor set; health is described too.
///
/// # Errors
/// Descriptors that cannot be read.
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
    let router = router.add_service(Open::new(describe().build_v1()?, connections.clone()));
    Ok(router.add_service(Open::new(describe().build_v1alpha()?, connections.clone())))
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
    async fn an_idle_socket_does_not_hold_up_the_end() {
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
