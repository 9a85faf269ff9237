//! Traces across processes: spans and their propagation.
//!
//! Spans of a trace have [`TARGET`] as their target; unless traces are exported, a span costs one comparison.

use opentelemetry::propagation::TextMapPropagator as _;
use opentelemetry_sdk::propagation::TraceContextPropagator;
use std::collections::HashMap;
use tonic::metadata::MetadataMap;
use tracing::Span;
use tracing_opentelemetry::OpenTelemetrySpanExt as _;

/// Target of the spans that are exported.
pub const TARGET: &str = "magex_trace";

/// Key of the trace context in messages and in the headers of calls (W3C Trace Context).
const TRACEPARENT: &str = "traceparent";

/// The trace context of a span; empty unless traces are exported.
pub fn traceparent(span: &Span) -> String {
    if span.is_disabled() {
        return String::new();
    }
    let mut carrier = HashMap::new();
    TraceContextPropagator::new().inject_context(&span.context(), &mut carrier);
    carrier.remove(TRACEPARENT).unwrap_or_default()
}

/// Makes a new span the child of another process's span. With an invalid context it stays the root of its own trace.
pub fn continue_from(span: &Span, traceparent: &str) {
    if span.is_disabled() || traceparent.is_empty() {
        return;
    }
    let carrier = HashMap::from([(TRACEPARENT.to_owned(), traceparent.to_owned())]);
    let parent = TraceContextPropagator::new().extract(&carrier);
    if let Err(error) = span.set_parent(parent) {
        tracing::debug!(?error, "the parent of a span cannot be set");
    }
}

/// Adds the trace context of a span to the headers of a call.
pub fn add_to(metadata: &mut MetadataMap, span: &Span) {
    if let Ok(value) = traceparent(span).parse()
        && !span.is_disabled()
    {
        metadata.insert(TRACEPARENT, value);
    }
}

/// The trace context in the headers of a call; empty if absent.
pub fn of(metadata: &MetadataMap) -> &str {
    metadata.get(TRACEPARENT).and_then(|value| value.to_str().ok()).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use opentelemetry::trace::TracerProvider as _;
    use opentelemetry_sdk::trace::SdkTracerProvider;
    use tracing_subscriber::layer::SubscriberExt as _;

    #[test]
    fn a_trace_continues_in_another_process_and_costs_nothing_unless_exported() {
        let span = tracing::info_span!(target: TARGET, "unseen");
        assert_eq!(traceparent(&span), "");
        let provider = SdkTracerProvider::builder().build();
        let layer = tracing_opentelemetry::layer().with_tracer(provider.tracer("test"));
        tracing::subscriber::with_default(tracing_subscriber::registry().with(layer), || {
            let here = tracing::info_span!(target: TARGET, parent: None, "here");
            let mut headers = MetadataMap::new();
            add_to(&mut headers, &here);
            let there = tracing::info_span!(target: TARGET, parent: None, "there");
            continue_from(&there, of(&headers));
            let trace = |span: &Span| traceparent(span).split('-').nth(1).map(str::to_owned);
            assert_eq!(trace(&here).map(|id| id.len()), Some(32));
            assert_eq!(trace(&here), trace(&there));
            assert_ne!(traceparent(&here), traceparent(&there));
            let stranger = tracing::info_span!(target: TARGET, parent: None, "stranger");
            continue_from(&stranger, "00-nonsense");
            assert_ne!(trace(&here), trace(&stranger));
        });
    }
}
