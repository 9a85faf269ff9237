//! The layer in front of a service: it authenticates a call, counts what the caller has in flight and what arrives, and ends
//! the call at its deadline. It decides from headers and announced lengths, before anything is decoded.

mod truncate_status;

use crate::net::auth::{Access, Caller, Role, peer_address};
use crate::net::call_metrics::Calls;
use crate::net::compression::{Encoding, Inflating, PREFIX};
use crate::net::connections::Connections;
use crate::net::deadline::{self, Deadline};
use crate::net::in_flight::{CallKind, InFlight, Permit};
use http_body::Frame;
use http_body_util::BodyExt as _;
use std::convert::Infallible;
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::{Duration, Instant};
use tokio::time::Sleep;
use tonic::body::Body;
use tonic::codegen::{Bytes, Service, http};
use tonic::server::NamedService;
use tonic::{Code, Status};
use truncate_status::truncate_status;

/// Timeout of a message of a stream, from its first byte to its last, and of the whole request of a unary call.
const MESSAGE: Duration = Duration::from_secs(30);

/// Longest message to a public service, bytes: the name of a service or of a symbol.
const ANONYMOUS_MESSAGE: usize = 4096;

/// Streaming methods of public services.
const ANONYMOUS_STREAMS: &[&str] = &["Watch", "ServerReflectionInfo"];

/// The rules of a guarded service.
#[derive(Debug)]
pub struct Rules {
    /// The identities that may call.
    pub access: Access,
    /// Limits of what callers have in flight.
    pub in_flight: Arc<InFlight>,
    /// Streaming methods.
    pub streams: &'static [&'static str],
    /// Longest message, bytes.
    pub message_bytes: usize,
    /// What a caller can do about a longer one; without it the service itself rejects longer ones.
    pub too_long: Option<&'static str>,
    /// Where calls are counted, if anywhere.
    pub calls: Option<Calls>,
}

/// Which calls a [`Guard`] accepts.
#[derive(Debug)]
enum Policy {
    /// Calls with credentials, within the caller's limits.
    Guarded(Rules),
    /// Calls of any client (health, reflection), within limits per address, also while the service drains.
    Public,
}

/// A service behind a guard.
#[derive(Debug, Clone)]
pub struct Guard<S> {
    service: S,
    policy: Arc<Policy>,
    connections: Connections,
}

impl<S> Guard<S> {
    /// Requires credentials and enforces the limits of `rules`.
    pub fn guarded(service: S, rules: Rules, connections: Connections) -> Self {
        Self { service, policy: Arc::new(Policy::Guarded(rules)), connections }
    }

    /// Accepts any client, within small limits per address.
    pub fn public(service: S, connections: Connections) -> Self {
        Self { service, policy: Arc::new(Policy::Public), connections }
    }

    fn admit(&self, mut request: http::Request<Body>) -> Result<(http::Request<Body>, Arc<Permit>), Status> {
        let address = peer_address(request.extensions());
        let (permit, kind, limit) = match &*self.policy {
            Policy::Guarded(rules) => {
                let caller = rules.access.authenticate(&request)?;
                if let Some(address) = address {
                    self.connections.called(address);
                }
                let kind = kind(request.uri(), rules.streams);
                let permit = rules.in_flight.acquire(&caller, kind)?;
                request.extensions_mut().insert(caller);
                (permit, kind, Limit { bytes: rules.message_bytes, remedy: rules.too_long })
            }
            Policy::Public => {
                if let Some(address) = address {
                    self.connections.probed(address);
                }
                let name = address.map_or_else(|| "local".to_owned(), |address| address.ip().to_string());
                let caller = Caller { name: name.into(), role: Role::Client };
                let kind = kind(request.uri(), ANONYMOUS_STREAMS);
                let permit = self.connections.anonymous().acquire(&caller, kind)?;
                (permit, kind, Limit { bytes: ANONYMOUS_MESSAGE, remedy: Some("send a shorter one") })
            }
        };
        if let Some(deadline) = Deadline::of(request.headers()) {
            request.extensions_mut().insert(deadline);
        }
        let encoding = Encoding::of_request(request.headers_mut())?;
        let permit = Arc::new(permit);
        let metered = permit.clone();
        Ok((request.map(|body| Body::new(Metered::new(body, metered, kind, limit, encoding))), permit))
    }
}

impl<S: NamedService> NamedService for Guard<S> {
    const NAME: &'static str = S::NAME;
}

type Answer = Pin<Box<dyn Future<Output = Result<http::Response<Body>, Infallible>> + Send>>;

impl<S> Service<http::Request<Body>> for Guard<S>
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
        let calls = match &*self.policy {
            Policy::Guarded(rules) => rules.calls.clone(),
            Policy::Public => None,
        };
        let counted = calls.map(|calls| (calls.method(request.uri().path()), calls, Instant::now()));
        let accepted = Encoding::for_response(request.headers());
        let admitted = self.admit(request).map(|(request, permit)| {
            let deadline = request.extensions().get().copied();
            (deadline::within(deadline, self.service.call(request)), permit)
        });
        Box::pin(async move {
            let response = match admitted {
                Ok((answer, permit)) => finish(answer.await?, permit, accepted),
                Err(status) => status.into_http(),
            };
            if let Some((method, calls, start)) = counted {
                calls.count(method, response.headers(), start.elapsed());
            }
            Ok(response)
        })
    }
}

/// Cuts the texts of statuses, compresses messages if the caller accepts that, and holds the permit until the last frame is sent.
fn finish(mut response: http::Response<Body>, permit: Arc<Permit>, encoding: Option<Encoding>) -> http::Response<Body> {
    truncate_status(response.headers_mut());
    Encoding::announce(encoding, response.headers_mut());
    response.map(|body| {
        Body::new(body.map_frame(move |mut frame| {
            let _held = &permit;
            if let Some(trailers) = frame.trailers_mut() {
                truncate_status(trailers);
            }
            match encoding {
                Some(encoding) => frame.map_data(|data| encoding.compress(data)),
                None => frame,
            }
        }))
    })
}

fn kind(uri: &http::Uri, streams: &[&str]) -> CallKind {
    let method = uri.path().rsplit('/').next().unwrap_or_default();
    if streams.contains(&method) { CallKind::Stream } else { CallKind::Call }
}

/// The limit of a message's length.
#[derive(Debug, Clone, Copy)]
struct Limit {
    bytes: usize,
    /// With it, longer messages are rejected here. Otherwise the service rejects them itself, without buffering them.
    remedy: Option<&'static str>,
}

impl Limit {
    /// The status of a message that is too long, with what its sender can do about it.
    fn too_long(&self, what: &str) -> Status {
        let remedy = self.remedy.map(|remedy| format!("; {remedy}")).unwrap_or_default();
        Status::out_of_range(format!("{what} exceeds the limit of {} bytes{remedy}", self.bytes))
    }
}

/// A request's body whose messages are counted while they arrive.
struct Metered {
    body: Body,
    permit: Arc<Permit>,
    limit: Limit,
    kind: CallKind,
    /// The compression of messages whose flag is set.
    encoding: Option<Encoding>,
    /// The compressed message that arrives.
    inflating: Option<Inflating>,
    prefix: [u8; PREFIX],
    /// Bytes of the prefix that have arrived, and bytes of the message that have not.
    known: usize,
    rest: usize,
    /// The next bytes must arrive within [`MESSAGE`].
    timed: bool,
    timeout: Option<Pin<Box<Sleep>>>,
}

impl Metered {
    fn new(body: Body, permit: Arc<Permit>, kind: CallKind, limit: Limit, encoding: Option<Encoding>) -> Self {
        // A stream may be silent before and between messages.
        let timed = kind == CallKind::Call;
        let (inflating, prefix) = (None, [0; PREFIX]);
        Self { body, permit, limit, kind, encoding, inflating, prefix, known: 0, rest: 0, timed, timeout: None }
    }

    /// Counts the messages in these bytes. Returns them as the service gets them, if that is otherwise than as they came.
    fn count(&mut self, mut data: &[u8]) -> Result<Option<Bytes>, Status> {
        // Nothing is copied unless messages may be compressed.
        let mut plain = self.encoding.map(|_| Vec::new());
        while !data.is_empty() {
            if self.rest > 0 {
                let step = self.rest.min(data.len());
                let arrived;
                (arrived, data) = data.split_at(step);
                self.rest -= step;
                if let Some(inflating) = &mut self.inflating {
                    let length = inflating.push(arrived).map_err(|status| match status.code() {
                        Code::OutOfRange => self.limit.too_long("what comes out of the compressed message"),
                        _ => status,
                    })?;
                    self.permit.reserve(length)?;
                } else if let Some(plain) = &mut plain {
                    plain.extend_from_slice(arrived);
                }
                if self.rest == 0 {
                    // The next message has its own timeout.
                    self.timeout = None;
                    self.unpack(&mut plain)?;
                }
            } else {
                let step = (PREFIX - self.known).min(data.len());
                self.prefix[self.known..self.known + step].copy_from_slice(&data[..step]);
                (self.known, data) = (self.known + step, &data[step..]);
                if self.known == PREFIX {
                    let [flag, a, b, c, d] = self.prefix;
                    (self.known, self.rest) = (0, u32::from_be_bytes([a, b, c, d]) as usize);
                    self.inflating = self.encoding.filter(|_| flag == 1).map(|e| Inflating::new(e, self.limit.bytes));
                    if let Some(plain) = plain.as_mut().filter(|_| self.inflating.is_none()) {
                        plain.extend_from_slice(&self.prefix);
                    }
                    if self.rest <= self.limit.bytes {
                        self.permit.reserve(self.rest)?;
                    } else if self.limit.remedy.is_some() || self.inflating.is_some() {
                        return Err(self.limit.too_long(&format!("a message of {} bytes", self.rest)));
                    }
                    if self.rest == 0 {
                        self.timeout = None;
                        self.unpack(&mut plain)?;
                    }
                }
            }
        }
        self.timed = self.kind == CallKind::Call || self.rest > 0 || self.known > 0;
        if !self.timed {
            self.timeout = None;
        }
        Ok(plain.map(Bytes::from))
    }

    /// Appends a compressed message that has arrived.
    fn unpack(&mut self, plain: &mut Option<Vec<u8>>) -> Result<(), Status> {
        if let (Some(inflating), Some(plain)) = (self.inflating.take(), plain) {
            let message = inflating.finish()?;
            self.permit.reserve(message.len())?;
            plain.extend_from_slice(&message);
        }
        Ok(())
    }
}

impl http_body::Body for Metered {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Self::Data>, Status>>> {
        let mut next = Pin::new(&mut self.body).poll_frame(cx);
        match &mut next {
            Poll::Ready(Some(Ok(frame))) => {
                if let Some(data) = frame.data_mut() {
                    match self.count(data) {
                        Ok(Some(plain)) => *data = plain,
                        Ok(None) => {}
                        Err(status) => return Poll::Ready(Some(Err(status))),
                    }
                }
            }
            Poll::Pending if self.timed => {
                let timeout = self.timeout.get_or_insert_with(|| Box::pin(tokio::time::sleep(MESSAGE)));
                if timeout.as_mut().poll(cx).is_ready() {
                    let problem = format!("the message did not arrive within {} s", MESSAGE.as_secs());
                    return Poll::Ready(Some(Err(Status::deadline_exceeded(problem))));
                }
            }
            _ => {}
        }
        next
    }
}

#[cfg(test)]
mod tests;
