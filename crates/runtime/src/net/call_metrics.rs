//! Call metrics of a gRPC service: count and duration by method.

use crate::metrics::Metrics;
use prometheus::{HistogramVec, IntCounterVec};
use std::convert::Infallible;
use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Instant;
use tonic::codegen::{Service, http};
use tonic::server::NamedService;
use tonic::{Code, Status};

/// Calls of one service by method and code, and their durations.
#[derive(Debug, Clone)]
pub struct Calls {
    total: IntCounterVec,
    seconds: HistogramVec,
    methods: &'static [&'static str],
}

impl Calls {
    /// Declares `magex_<component>_calls_total` and `magex_<component>_call_seconds`. Methods that are not among
    /// `methods` are counted as `other`, so that a caller cannot create labels.
    pub fn new(metrics: &Metrics, component: &str, methods: &'static [&'static str]) -> Self {
        let name = |what: &str| format!("magex_{component}_{what}");
        let total = "Calls by method and code; a stream counts when it opens.";
        let seconds = "From a call to its answer, by method; of a stream to its opening.";
        let calls = Self {
            total: metrics.counters(&name("calls_total"), total, &["method", "code"]),
            seconds: metrics.seconds_by(&name("call_seconds"), seconds, &["method"]),
            methods,
        };
        // Every method appears in a scrape from the start.
        for method in methods {
            calls.total.with_label_values(&[*method, "Ok"]);
            calls.seconds.with_label_values(&[*method]);
        }
        calls
    }

    fn method(&self, path: &str) -> &'static str {
        let asked = path.rsplit('/').next().unwrap_or_default();
        self.methods.iter().find(|method| **method == asked).copied().unwrap_or("other")
    }
}

/// A gRPC service whose calls are counted.
#[derive(Debug, Clone)]
pub struct Counted<S> {
    service: S,
    calls: Calls,
}

impl<S> Counted<S> {
    /// Counts the calls of this service.
    pub fn new(service: S, calls: Calls) -> Self {
        Self { service, calls }
    }
}

impl<S: NamedService> NamedService for Counted<S> {
    const NAME: &'static str = S::NAME;
}

impl<S, B, R> Service<http::Request<B>> for Counted<S>
where
    S: Service<http::Request<B>, Response = http::Response<R>, Error = Infallible>,
    S::Future: Send + 'static,
{
    type Response = http::Response<R>;
    type Error = Infallible;
    type Future = Pin<Box<dyn Future<Output = Result<http::Response<R>, Infallible>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        self.service.poll_ready(context)
    }

    fn call(&mut self, request: http::Request<B>) -> Self::Future {
        let (calls, start) = (self.calls.clone(), Instant::now());
        let method = calls.method(request.uri().path());
        let answer = self.service.call(request);
        Box::pin(async move {
            let answer = answer.await;
            if let Ok(response) = &answer {
                // An error has its code in the headers, a success in the trailers.
                let code = Status::from_header_map(response.headers()).map_or(Code::Ok, |status| status.code());
                match code {
                    // The common case formats nothing.
                    Code::Ok => calls.total.with_label_values(&[method, "Ok"]).inc(),
                    code => calls.total.with_label_values(&[method, format!("{code:?}").as_str()]).inc(),
                }
                calls.seconds.with_label_values(&[method]).observe(start.elapsed().as_secs_f64());
            }
            answer
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tonic::codegen::Body as _;

    #[derive(Clone)]
    struct Fake(Code);

    impl Service<http::Request<()>> for Fake {
        type Response = http::Response<tonic::body::Body>;
        type Error = Infallible;
        type Future = std::future::Ready<Result<Self::Response, Infallible>>;

        fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
            Poll::Ready(Ok(()))
        }

        fn call(&mut self, _: http::Request<()>) -> Self::Future {
            let response = match self.0 {
                Code::Ok => http::Response::new(tonic::body::Body::empty()),
                code => Status::new(code, "no").into_http(),
            };
            assert!(response.body().is_end_stream());
            std::future::ready(Ok(response))
        }
    }

    #[tokio::test]
    async fn calls_are_counted_by_method_and_code() {
        let metrics = Metrics::new();
        let calls = Calls::new(&metrics, "test", &["Ask"]);
        for (code, path) in [(Code::Ok, "/s/Ask"), (Code::NotFound, "/s/Ask"), (Code::Unimplemented, "/s/Invented")] {
            let request = http::Request::builder().uri(path).body(()).unwrap();
            Counted::new(Fake(code), calls.clone()).call(request).await.unwrap();
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
