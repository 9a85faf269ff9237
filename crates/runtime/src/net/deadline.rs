//! A caller's own deadline, kept by the server with the code that the protocol has for it.

use std::convert::Infallible;
use std::task::{Context, Poll};
use std::time::Duration;
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::{BoxFuture, Service, http};
use tonic::server::NamedService;

/// What a `grpc-timeout` header says: up to eight digits and a unit.
pub fn requested(text: &str) -> Option<Duration> {
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

/// A service whose calls end with DEADLINE_EXCEEDED when the caller's time is over; the server's own timer would say CANCELLED.
#[derive(Debug, Clone)]
pub struct Deadline<S> {
    inner: S,
}

impl<S> Deadline<S> {
    /// Around a generated service.
    pub fn new(inner: S) -> Self {
        Self { inner }
    }
}

impl<S: NamedService> NamedService for Deadline<S> {
    const NAME: &'static str = S::NAME;
}

impl<S, B> Service<http::Request<B>> for Deadline<S>
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

    fn call(&mut self, request: http::Request<B>) -> Self::Future {
        let header = request.headers().get("grpc-timeout").and_then(|value| value.to_str().ok());
        let Some(time) = header.and_then(requested) else { return Box::pin(self.inner.call(request)) };
        // Begins no later than the server's own timer and is asked first, so that it has the last word.
        let sleep = tokio::time::sleep(time);
        let answer = self.inner.call(request);
        Box::pin(async move {
            tokio::select! {
                biased;
                answer = answer => answer,
                () = sleep => Ok(Status::deadline_exceeded(format!("not done within the caller's {time:?}")).into_http()),
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tonic::Code;

    #[test]
    fn timeouts_are_read_and_nonsense_is_not() {
        assert_eq!(requested("250m"), Some(Duration::from_millis(250)));
        assert_eq!(requested("1S"), Some(Duration::from_secs(1)));
        for text in ["", "S", "1", "x1S", "123456789n", "1s", "-1S"] {
            assert_eq!(requested(text), None, "{text}");
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
        let answer = Deadline::new(Mute).call(request).await.unwrap_or_else(|never| match never {});
        let status = Status::from_header_map(answer.headers()).unwrap();
        assert_eq!(status.code(), Code::DeadlineExceeded, "{status}");
    }

    #[tokio::test]
    async fn without_one_the_service_takes_its_time() {
        let waiting = Deadline::new(Mute).call(http::Request::new(Body::empty()));
        assert!(tokio::time::timeout(Duration::from_millis(50), waiting).await.is_err());
    }
}
