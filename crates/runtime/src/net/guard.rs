//! What stands before a service: who calls, how much it has in flight already, how much is on its way. All of that is known
//! from a call's headers and from the length that a message announces, before anything of it is decoded.

mod truncate_status;

use crate::net::auth::{Access, Caller, Role};
use crate::net::in_flight::{Admission, Kind, Slot};
use crate::net::connections::Connections;
use http_body::{Frame, SizeHint};
use std::convert::Infallible;
use std::future::Future;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::time::Sleep;
use tonic::body::Body;
use tonic::codegen::{Service, http};
use tonic::metadata::MetadataMap;
use tonic::server::NamedService;
use tonic::transport::server::{TcpConnectInfo, TlsConnectInfo};
use tonic::{Request, Status};

/// How long a message of a stream may take from its first byte to its last, and the whole request of a call.
const MESSAGE: Duration = Duration::from_secs(30);

/// Bytes before every message: whether it is compressed, and its length.
const PREFIX: usize = 5;

/// Longest message to a service without a door, bytes: the name of a service or of a symbol.
const GUEST_MESSAGE: usize = 4096;

/// Methods of services without a door that stay open.
const GUEST_STREAMS: &[&str] = &["Watch", "ServerReflectionInfo"];

/// The rules of a door.
#[derive(Debug)]
pub struct Rules {
    /// Who is let in.
    pub access: Access,
    /// How much everybody may have in flight.
    pub admission: Arc<Admission>,
    /// Methods that stay open.
    pub streams: &'static [&'static str],
    /// Longest message, bytes; the service refuses longer ones.
    pub message_bytes: usize,
    /// Where calls come in.
    pub connections: Connections,
}

/// A service behind a door.
#[derive(Debug, Clone)]
pub struct Door<S> {
    service: S,
    rules: Arc<Rules>,
}

impl<S> Door<S> {
    /// Puts a door before a service.
    pub fn new(service: S, rules: Rules) -> Self {
        Self { service, rules: Arc::new(rules) }
    }
}

impl<S: NamedService> NamedService for Door<S> {
    const NAME: &'static str = S::NAME;
}

type Answer = Pin<Box<dyn Future<Output = Result<http::Response<Body>, Infallible>> + Send>>;

impl<S> Service<http::Request<Body>> for Door<S>
where
    S: Service<http::Request<Body>, Response = http::Response<Body>, Error = Infallible>,
    S::Future: Send + 'static,
{
    type Response = http::Response<Body>;
    type Error = Infallible;
    type Future = Answer;

    fn poll_ready(&mut self, cx: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        self.service.poll_ready(cx)
    }

    fn call(&mut self, request: http::Request<Body>) -> Self::Future {
        match self.rules.admit(request) {
            Ok((request, slot)) => held(self.service.call(request), slot),
            Err(status) => Box::pin(std::future::ready(Ok(status.into_http()))),
        }
    }
}

/// An answer that is short where it says what went wrong, and that keeps its place until it, or the last of a stream of them,
/// is on its way.
fn held(
    answer: impl Future<Output = Result<http::Response<Body>, Infallible>> + Send + 'static,
    slot: Arc<Slot>,
) -> Answer {
    Box::pin(async move {
        let mut response = answer.await?;
        truncate_status::truncate_status(response.headers_mut());
        Ok(response.map(|body| Body::new(Held { body, _slot: slot })))
    })
}

impl Rules {
    fn admit(&self, request: http::Request<Body>) -> Result<(http::Request<Body>, Arc<Slot>), Status> {
        let (mut parts, body) = request.into_parts();
        let headers = std::mem::take(&mut parts.headers);
        let mut request =
            Request::from_parts(MetadataMap::from_headers(headers), std::mem::take(&mut parts.extensions), ());
        let caller = self.access.identify(&request)?;
        // Only who is known has a connection for as long as it likes.
        if let Some(address) = peer(request.extensions()) {
            self.connections.called(address);
        }
        let kind = kind(&parts.uri, self.streams);
        let slot = Arc::new(self.admission.enter(&caller, kind)?);
        request.extensions_mut().insert(caller);
        let (metadata, extensions, ()) = request.into_parts();
        (parts.headers, parts.extensions) = (metadata.into_headers(), extensions);
        let body = Metered::new(body, slot.clone(), kind, self.message_bytes, false);
        Ok((http::Request::from_parts(parts, Body::new(body)), slot))
    }
}

fn kind(uri: &http::Uri, streams: &[&str]) -> Kind {
    let method = uri.path().rsplit('/').next().unwrap_or_default();
    if streams.contains(&method) { Kind::Stream } else { Kind::Call }
}

/// Where a call comes from.
fn peer(extensions: &http::Extensions) -> Option<SocketAddr> {
    let plain = extensions.get::<TcpConnectInfo>();
    let info = plain.or_else(|| extensions.get::<TlsConnectInfo<TcpConnectInfo>>().map(TlsConnectInfo::get_ref));
    info.and_then(TcpConnectInfo::remote_addr)
}

/// A service without a door (health, reflection): anybody may call, each address a little, also while the others are full or
/// the service drains.
#[derive(Debug, Clone)]
pub struct Open<S> {
    service: S,
    connections: Connections,
}

impl<S> Open<S> {
    /// Anybody may call.
    pub fn new(service: S, connections: Connections) -> Self {
        Self { service, connections }
    }

    fn admit(&self, request: http::Request<Body>) -> Result<(http::Request<Body>, Arc<Slot>), Status> {
        let address = peer(request.extensions());
        if let Some(address) = address {
            self.connections.probed(address);
        }
        let name = address.map_or_else(|| "local".to_owned(), |address| address.ip().to_string());
        let guest = Caller { name: name.into(), role: Role::Client };
        let kind = kind(request.uri(), GUEST_STREAMS);
        let slot = Arc::new(self.connections.guests().enter(&guest, kind)?);
        let metered = slot.clone();
        Ok((request.map(|body| Body::new(Metered::new(body, metered, kind, GUEST_MESSAGE, true))), slot))
    }
}

impl<S: NamedService> NamedService for Open<S> {
    const NAME: &'static str = S::NAME;
}

impl<S> Service<http::Request<Body>> for Open<S>
where
    S: Service<http::Request<Body>, Response = http::Response<Body>, Error = Infallible>,
    S::Future: Send + 'static,
{
    type Response = http::Response<Body>;
    type Error = Infallible;
    type Future = Answer;

    fn poll_ready(&mut self, cx: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        self.service.poll_ready(cx)
    }

    fn call(&mut self, request: http::Request<Body>) -> Self::Future {
        match self.admit(request) {
            Ok((request, slot)) => held(self.service.call(request), slot),
            Err(status) => Box::pin(std::future::ready(Ok(status.into_http()))),
        }
    }
}

/// A request's body whose messages are counted while they arrive.
struct Metered {
    body: Body,
    slot: Arc<Slot>,
    limit: usize,
    /// Longer messages are refused here; otherwise the service has words of its own for them, and keeps nothing of them.
    strict: bool,
    prefix: [u8; PREFIX],
    /// Bytes of the prefix that are known, and bytes of the message that are still to come.
    known: usize,
    rest: usize,
    kind: Kind,
    /// Something has to come in time.
    begun: bool,
    patience: Option<Pin<Box<Sleep>>>,
}

impl Metered {
    fn new(body: Body, slot: Arc<Slot>, kind: Kind, limit: usize, strict: bool) -> Self {
        // A stream may begin, and go on, with silence.
        let begun = kind == Kind::Call;
        Self { body, slot, limit, strict, prefix: [0; PREFIX], known: 0, rest: 0, kind, begun, patience: None }
    }

    fn count(&mut self, mut data: &[u8]) -> Result<(), Status> {
        while !data.is_empty() {
            if self.rest > 0 {
                let step = self.rest.min(data.len());
                (self.rest, data) = (self.rest - step, &data[step..]);
                if self.rest == 0 {
                    // The next one has its own time.
                    self.patience = None;
                }
            } else {
                let step = (PREFIX - self.known).min(data.len());
                self.prefix[self.known..self.known + step].copy_from_slice(&data[..step]);
                (self.known, data) = (self.known + step, &data[step..]);
                if self.known == PREFIX {
                    let [_, a, b, c, d] = self.prefix;
                    (self.known, self.rest) = (0, u32::from_be_bytes([a, b, c, d]) as usize);
                    if self.rest <= self.limit {
                        self.slot.announce(self.rest)?;
                    } else if self.strict {
                        let problem = format!("a message of {} bytes; at most {} are read here", self.rest, self.limit);
                        return Err(Status::out_of_range(problem));
                    }
                    if self.rest == 0 {
                        self.patience = None;
                    }
                }
            }
        }
        self.begun = self.kind == Kind::Call || self.rest > 0 || self.known > 0;
        if !self.begun {
            self.patience = None;
        }
        Ok(())
    }
}

impl http_body::Body for Metered {
    type Data = tonic::codegen::Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Self::Data>, Status>>> {
        let next = Pin::new(&mut self.body).poll_frame(cx);
        match &next {
            Poll::Ready(Some(Ok(frame))) => {
                if let Some(data) = frame.data_ref()
                    && let Err(status) = self.count(data)
                {
                    return Poll::Ready(Some(Err(status)));
                }
            }
            Poll::Pending if self.begun => {
                let patience = self.patience.get_or_insert_with(|| Box::pin(tokio::time::sleep(MESSAGE)));
                if patience.as_mut().poll(cx).is_ready() {
                    let problem = format!("the message did not arrive within {} s", MESSAGE.as_secs());
                    return Poll::Ready(Some(Err(Status::deadline_exceeded(problem))));
                }
            }
            _ => {}
        }
        next
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

/// An answer's body that holds its place.
struct Held {
    body: Body,
    _slot: Arc<Slot>,
}

impl http_body::Body for Held {
    type Data = tonic::codegen::Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Self::Data>, Status>>> {
        let mut next = Pin::new(&mut self.body).poll_frame(cx);
        if let Poll::Ready(Some(Ok(frame))) = &mut next
            && let Some(trailers) = frame.trailers_mut()
        {
            truncate_status::truncate_status(trailers);
        }
        next
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

#[cfg(test)]
mod tests;
