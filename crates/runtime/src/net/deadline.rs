//! A caller's deadline (`grpc-timeout`), parsed once per call and enforced with DEADLINE_EXCEEDED.
//!
//! tonic parses the header too, but its parser is private and its timer answers CANCELLED (hyperium/tonic#606).

use std::future::Future;
use std::time::{Duration, Instant};
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::http;

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

impl Deadline {
    /// The deadline of a call that arrives now, if its caller set one.
    pub(super) fn of(headers: &http::HeaderMap) -> Option<Self> {
        let timeout = parse(headers.get("grpc-timeout")?.to_str().ok()?)?;
        Some(Self { start: Instant::now(), timeout })
    }
}

/// The answer, or DEADLINE_EXCEEDED at the deadline.
pub(super) fn within<E>(
    deadline: Option<Deadline>,
    answer: impl Future<Output = Result<http::Response<Body>, E>>,
) -> impl Future<Output = Result<http::Response<Body>, E>> {
    // Starts no later than tonic's own timer and is polled first, so that this answer wins.
    let sleep = deadline.map(|Deadline { timeout, .. }| (tokio::time::sleep(timeout), timeout));
    async move {
        let Some((sleep, timeout)) = sleep else { return answer.await };
        tokio::select! {
            biased;
            answer = answer => answer,
            () = sleep => {
                let problem = format!("grpc-timeout: not done within {timeout:?}");
                Ok(Status::deadline_exceeded(problem).into_http())
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::convert::Infallible;
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
    fn mute() -> impl Future<Output = Result<http::Response<Body>, Infallible>> {
        std::future::pending()
    }

    #[tokio::test]
    async fn a_deadline_that_passes_has_its_own_code() {
        let mut headers = http::HeaderMap::new();
        headers.insert("grpc-timeout", http::HeaderValue::from_static("20m"));
        let answer = within(Deadline::of(&headers), mute()).await.unwrap_or_else(|never| match never {});
        let status = Status::from_header_map(answer.headers()).unwrap();
        assert_eq!(status.code(), Code::DeadlineExceeded, "{status}");
    }

    #[tokio::test]
    async fn without_a_deadline_the_service_is_not_cut_off() {
        let waiting = within(Deadline::of(&http::HeaderMap::new()), mute());
        assert!(tokio::time::timeout(Duration::from_millis(50), waiting).await.is_err());
    }
}
