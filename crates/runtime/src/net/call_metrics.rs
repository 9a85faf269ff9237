//! Call metrics of a gRPC service: count and duration by method.

use crate::metrics::Metrics;
use prometheus::{HistogramVec, IntCounterVec};
use std::time::Duration;
use tonic::codegen::http;
use tonic::{Code, Status};

/// Calls of one service by method and code, and their durations.
#[derive(Debug, Clone)]
pub struct Calls {
    total: IntCounterVec,
    seconds: HistogramVec,
    methods: &'static [&'static str],
}

impl Calls {
    /// Declares `calls_total` and `call_seconds` of a service. Methods that are not among `methods` are counted as `other`, so
    /// that a caller cannot create labels.
    pub fn new(metrics: &Metrics, methods: &'static [&'static str]) -> Self {
        let total = "Calls by method and code; a stream counts when it opens.";
        let seconds = "From a call to its answer, by method; of a stream to its opening.";
        let calls = Self {
            total: metrics.counters("calls_total", total, &["method", "code"]),
            seconds: metrics.seconds_by("call_seconds", seconds, &["method"]),
            methods,
        };
        // Every method appears in a scrape from the start.
        for method in methods {
            calls.total.with_label_values(&[*method, "Ok"]);
            calls.seconds.with_label_values(&[*method]);
        }
        calls
    }

    /// The label of a method, of its path.
    pub(super) fn method(&self, path: &str) -> &'static str {
        let asked = path.rsplit('/').next().unwrap_or_default();
        self.methods.iter().find(|method| **method == asked).copied().unwrap_or("other")
    }

    /// Counts a call to a method by the headers of its answer.
    pub(super) fn count(&self, method: &str, answer: &http::HeaderMap, elapsed: Duration) {
        // An error has its code in the headers, a success in the trailers.
        match Status::from_header_map(answer).map_or(Code::Ok, |status| status.code()) {
            // The common case formats nothing.
            Code::Ok => self.total.with_label_values(&[method, "Ok"]).inc(),
            code => self.total.with_label_values(&[method, format!("{code:?}").as_str()]).inc(),
        }
        self.seconds.with_label_values(&[method]).observe(elapsed.as_secs_f64());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tonic::body::Body;

    #[test]
    fn calls_are_counted_by_method_and_code() {
        let metrics = Metrics::new();
        let calls = Calls::new(&metrics.of("test"), &["Ask"]);
        for (code, path) in [(Code::Ok, "/s/Ask"), (Code::NotFound, "/s/Ask"), (Code::Unimplemented, "/s/Invented")] {
            let answer = match code {
                Code::Ok => http::Response::new(Body::empty()),
                code => Status::new(code, "no").into_http(),
            };
            calls.count(calls.method(path), answer.headers(), Duration::from_millis(1));
        }
        let text = metrics.text();
        for line in [
            "magex_test_calls_total{code=\"Ok\",method=\"Ask\"} 1",
            "magex_test_calls_total{code=\"NotFound\",method=\"Ask\"} 1",
            "magex_test_calls_total{code=\"Unimplemented\",method=\"other\"} 1",
            "magex_test_call_seconds_count{method=\"Ask\"} 2",
        ] {
            assert!(text.contains(line), "{line}\n{text}");
        }
    }
}
