//! Logs on standard error, and traces to a collector when asked for.

use crate::client;
use crate::exit::{self, Failure};
use crate::log_line;
pub use crate::log_line::{is_json, line};
use crate::trace;
use opentelemetry::KeyValue;
use opentelemetry::trace::TracerProvider as _;
use opentelemetry_otlp::{WithExportConfig as _, WithTonicConfig as _};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::error::OTelSdkResult;
use opentelemetry_sdk::trace::{BatchConfigBuilder, BatchSpanProcessor, SdkTracerProvider, SpanData, SpanExporter};
use std::io::IsTerminal as _;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use tracing::Subscriber;
use tracing_subscriber::filter::{EnvFilter, LevelFilter, Targets};
use tracing_subscriber::layer::{Layer, SubscriberExt as _};
use tracing_subscriber::registry::LookupSpan;
use tracing_subscriber::util::SubscriberInitExt as _;

/// How long a process waits at its end for the last spans to be sent.
const FLUSH: Duration = Duration::from_secs(1);
/// Timeout of a batch of spans.
const EXPORT: Duration = Duration::from_secs(3);
/// Longest time between two batches.
const DELAY: Duration = Duration::from_secs(1);
/// Capacity of the queue of spans; more are dropped.
const WAITING: usize = 8192;

/// How log lines look.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum LogFormat {
    /// For people.
    #[default]
    Text,
    /// One JSON object per line.
    Json,
}

impl LogFormat {
    /// Decides how this process writes to standard error, the message of a panic included.
    pub fn apply(self) {
        if self == Self::Json {
            log_line::write_json();
        }
    }
}

/// The option of every service that can be traced.
#[derive(Debug, Clone, Default, clap::Args, serde::Serialize)]
pub struct TraceArgs {
    /// Collector that traces are sent to (OpenTelemetry over gRPC), for example http://127.0.0.1:4317 [default: none]
    #[arg(long, env = "MAGEX_OTLP", value_name = "URL")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub otlp: Option<String>,
}

/// The exporter of traces, to be flushed when the process ends.
#[derive(Debug)]
#[must_use = "queued spans are lost without a flush"]
pub struct Telemetry {
    traces: Option<SdkTracerProvider>,
}

impl Telemetry {
    /// Sends the queued spans, for at most a second. Blocks; the runtime must still run.
    pub fn flush(self) {
        if let Some(traces) = self.traces
            && let Err(error) = traces.shutdown_with_timeout(FLUSH)
        {
            tracing::debug!(%error, "the last spans were not sent");
        }
    }
}

/// Sends logs to standard error, and the spans of [`trace::TARGET`] to a collector if there is one. `RUST_LOG` sets what is
/// logged, `info` without it. A second call changes nothing. Must be called within a runtime, which the exporter uses.
/// A collector that does not answer is no error: spans are dropped.
pub fn init(service: &str, format: LogFormat, args: &TraceArgs) -> Result<Telemetry, Failure> {
    let traces = args.otlp.as_deref().map(|url| provider(service, url)).transpose()?;
    format.apply();
    let filter = filter("info")?;
    // A second call changes nothing.
    let _ = match &traces {
        None => logging(format, filter).try_init(),
        Some(traces) => {
            let spans = tracing_opentelemetry::layer()
                .with_tracer(traces.tracer("magex"))
                .with_location(false)
                .with_threads(false)
                .with_tracked_inactivity(false)
                .with_filter(Targets::new().with_target(trace::TARGET, LevelFilter::INFO));
            tracing_subscriber::registry().with(lines(format).with_filter(filter)).with(spans).try_init()
        }
    };
    Ok(Telemetry { traces })
}

/// Logs alone. The filter is the subscriber's, not the layer's, and there is no layer that is `None`: only then does a span that is not
/// logged cost one comparison. Otherwise the network libraries' spans, dozens for a call, are all made and dropped.
fn logging(format: LogFormat, filter: EnvFilter) -> impl Subscriber + Send + Sync {
    tracing_subscriber::registry().with(filter).with(lines(format))
}

/// What is logged: what RUST_LOG says, or `default`; the spans of [`trace::TARGET`] never are.
///
/// # Errors
/// RUST_LOG is wrong.
pub fn filter(default: &str) -> Result<EnvFilter, Failure> {
    let wanted = std::env::var_os(EnvFilter::DEFAULT_ENV).map(|wanted| wanted.to_string_lossy().into_owned());
    let filter = EnvFilter::try_new(wanted.as_deref().unwrap_or(default)).map_err(|_| {
        let wanted = wanted.as_deref().unwrap_or(default);
        Failure::usage(format!(
            "RUST_LOG: '{wanted}' is no list of filters; write for example info, or info,magex_learner=debug"
        ))
    })?;
    let traced = format!("{}=off", trace::TARGET).parse().map_err(|error| Failure::new(exit::INTERNAL, error))?;
    Ok(filter.add_directive(traced))
}

fn lines<S: Subscriber + for<'a> LookupSpan<'a>>(format: LogFormat) -> Box<dyn Layer<S> + Send + Sync> {
    // An error would be printed where it occurred, and a thread that cannot print panics: a closed terminal, a full disk.
    let lines = tracing_subscriber::fmt::layer().with_writer(std::io::stderr).log_internal_errors(false);
    match format {
        LogFormat::Text => lines.with_ansi(std::io::stderr().is_terminal()).with_target(false).boxed(),
        LogFormat::Json => lines.json().flatten_event(true).boxed(),
    }
}

fn provider(service: &str, url: &str) -> Result<SdkTracerProvider, Failure> {
    let endpoint = client::endpoint_from_env(url).map_err(|error| Failure::usage(format!("--otlp: {error}")))?;
    let exporter = opentelemetry_otlp::SpanExporter::builder()
        .with_tonic()
        .with_channel(endpoint.connect_lazy())
        .with_timeout(EXPORT)
        .build()
        .map_err(|error| Failure::usage(format!("--otlp: traces cannot be exported: {error}")))?;
    let exporter = LoggedExporter { exporter, unreachable: AtomicBool::new(false) };
    // A dedicated thread sends; creating a span never waits.
    let batches = BatchConfigBuilder::default().with_max_queue_size(WAITING).with_scheduled_delay(DELAY).build();
    let process = KeyValue::new("service.instance.id", crate::process::default_name());
    let resource = Resource::builder().with_service_name(service.to_owned()).with_attribute(process).build();
    let processor = BatchSpanProcessor::builder(exporter).with_batch_config(batches).build();
    Ok(SdkTracerProvider::builder().with_span_processor(processor).with_resource(resource).build())
}

/// Logs once that the collector is unreachable, and once that it is back.
#[derive(Debug)]
struct LoggedExporter {
    exporter: opentelemetry_otlp::SpanExporter,
    unreachable: AtomicBool,
}

impl SpanExporter for LoggedExporter {
    async fn export(&self, batch: Vec<SpanData>) -> OTelSdkResult {
        let result = self.exporter.export(batch).await;
        match (&result, self.unreachable.swap(result.is_err(), Ordering::Relaxed)) {
            (Err(error), false) => tracing::warn!(%error, "the collector does not accept traces; they are dropped"),
            (Ok(()), true) => tracing::info!("the collector accepts traces again"),
            _ => {}
        }
        result
    }

    fn set_resource(&mut self, resource: &Resource) {
        self.exporter.set_resource(resource);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Instant;

    #[tokio::test]
    async fn an_unreachable_collector_costs_no_time() {
        let unused = crate::http::bind("127.0.0.1:0").await.unwrap().address();
        let traces = provider("test", &format!("http://{unused}")).unwrap();
        let start = Instant::now();
        let layer = tracing_opentelemetry::layer().with_tracer(traces.tracer("test"));
        tracing::subscriber::with_default(tracing_subscriber::registry().with(layer), || {
            // More than the queue holds.
            (0..3 * WAITING).for_each(|i| drop(tracing::info_span!(target: trace::TARGET, parent: None, "span", i)));
        });
        let flushing = tokio::task::spawn_blocking(|| Telemetry { traces: Some(traces) }.flush());
        flushing.await.unwrap();
        // Generous: it is seconds where it could be minutes.
        assert!(start.elapsed() < Duration::from_secs(30), "{:?}", start.elapsed());
    }

    #[test]
    fn spans_of_the_libraries_are_not_made_unless_they_are_logged() {
        tracing::subscriber::with_default(logging(LogFormat::Text, EnvFilter::new("info,magex_trace=off")), || {
            assert!(tracing::info_span!("logged").id().is_some());
            assert!(tracing::debug_span!("not logged").id().is_none());
            assert!(tracing::info_span!(target: trace::TARGET, "exported").id().is_none());
        });
    }

    #[tokio::test]
    async fn a_malformed_address_is_named() {
        let args = TraceArgs { otlp: Some("collector:4317".into()) };
        let error = init("test", LogFormat::Text, &args).unwrap_err().to_string();
        assert!(error.starts_with("--otlp: ") && error.contains("http://host:port"), "{error}");
    }
}
