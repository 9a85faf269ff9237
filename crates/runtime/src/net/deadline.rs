//! A caller's deadline (`grpc-timeout`), parsed once per call and enforced with DEADLINE_EXCEEDED.
//!
//! tonic parses the header too, but its parser is private and its timer answers CANCELLED (hyperium/tonic#606).

use std::convert::Infallible;
use std::task::{Context, Poll};
use std::time::{Duration, Instant};
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::{BoxFuture, Service, http};
use tonic::server::NamedService;

/// The deadline of a call, in the request's extensions. Absent when the caller sent none.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Deadline {
    /// Arrival of the call.
    pub start: Instant,
    /// Time from arrival to the deadline.
    pub timeout: Duration,
}

/// Parses a `grpc-timeout` header: up to eight digits and a unit.
fn parse(text: &str) -> Option<Duration> {
    let (digits, unit) = text.split_at_checked(text.len().checked_sub(1)?)?;
    if digits.len() > 8 {
        return None;
    }
    let count: u64 = digits.parse().ok()?;
    match unit {
        "H" => Some(Duration::from_secs(3600 * count)),
        "M" => Some(Duration::from_secs(60 * count)),
        "S" => Some(Duration::from_secs(count)),
        "m" => Some(Duration::from_millis(count)),
        "u" => Some(Duration::from_micros(count)),
        "n" => Some(Duration::from_nanos(count)),
        _ => None,
    }
}

/// A service whose calls end with DEADLINE_EXCEEDED at the caller's deadline, and whose handlers find it as [`Deadline`].
#[derive(Debug, Clone)]
pub struct WithDeadline<S> {
    inner: S,
}

impl<S> WithDeadline<S> {
    /// Wraps a generated service.
    pub fn new(inner: S) -> Self {
        Self { inner }
    }
}

impl<S: NamedService> NamedService for WithDeadline<S> {
    const NAME: &'static str = S::NAME;
}

impl<S, B> Service<http::Request<B>> for WithDeadline<S>
where
    S: Service<http::Request<B>, Response = http::Response<Body>, Error = Infallible>,
    S::Future: Send + 'static,
{
    type Response = http::Response<Body>;
    type Error = Infallible;
    type Future = BoxFuture<Self::Response, Infallible>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, mut request: http::Request<B>) -> Self::Future {
        let header = request.headers().get("grpc-timeout").and_then(|value| value.to_str().ok());
        let Some(timeout) = header.and_then(parse) else { return Box::pin(self.inner.call(request)) };
        request.extensions_mut().insert(Deadline { start: Instant::now(), timeout });
        // Starts no later than tonic's own timer and is polled first, so that this answer wins.
        let sleep = tokio::time::sleep(timeout);
        let answer = self.inner.call(request);
        Box::pin(async move {
            tokio::select! {
                biased;
                answer = answer => answer,
                () = sleep => {
                    let problem = format!("grpc-timeout: not done within {timeout:?}");
                    Ok(Status::deadline_exceeded(problem).into_http())
                }
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tonic::Code;

    #[test]
    fn valid_timeouts_are_parsed_and_invalid_ones_ignored() {
        assert_eq!(parse("250m"), Some(Duration::from_millis(250)));
        assert_eq!(parse("1S"), Some(Duration::from_secs(1)));
        for text in ["", "S", "1", "x1S", "123456789n", "1s", "-1S"] {
            assert_eq!(parse(text), None, "{text}");
        }
    }

    /// Never answers.
    #[derive(Clone)]
    struct Mute;

    impl Service<http::Request<Body>> for Mute {
        type Response = http::Response<Body>;
        type Error = Infallible;
        type Future = BoxFuture<Self::Response, Infallible>;

        fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
            Poll::Ready(Ok(()))
        }

        fn call(&mut self, _: http::Request<Body>) -> Self::Future {
            Box::pin(std::future::pending())
        }
    }

    #[tokio::test]
    async fn a_deadline_that_passes_has_its_own_code() {
        let mut request = http::Request::new(Body::empty());
        request.headers_mut().insert("grpc-timeout", http::HeaderValue::from_static("20m"));
        let answer = WithDeadline::new(Mute).call(request).await.unwrap_or_else(|never| match never {});
        let status = Status::from_header_map(answer.headers()).unwrap();
        assert_eq!(status.code(), Code::DeadlineExceeded, "{status}");
    }

    #[tokio::test]
    async fn without_a_deadline_the_service_is_not_cut_off() {
        let waiting = WithDeadline::new(Mute).call(http::Request::new(Body::empty()));
        assert!(tokio::time::timeout(Duration::from_millis(50), waiting).await.is_err());
    }
}
