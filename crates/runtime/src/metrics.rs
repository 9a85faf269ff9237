//! The metrics of a process, in the format of Prometheus.
//!
//! Each service declares its own in one place, by the methods of [`Metrics`]; docs/metrics.md lists them all, and a test
//! compares that list with a scrape. Metrics are written and never read back: no number of a run depends on one.

mod kinds;

pub use kinds::{Counter, Counters, Gauge, Gauges, Held, Seconds, SecondsBy};
use prometheus::core::Collector;
use prometheus::process_collector::ProcessCollector;
use prometheus::{GaugeVec, HistogramOpts, HistogramVec, IntCounterVec, Opts, Registry, TextEncoder};
use std::fmt;
use std::sync::{Mutex, PoisonError};

/// Bounds of the buckets of every time that is measured, seconds.
const BUCKETS: [f64; 18] =
    [1e-4, 2.5e-4, 5e-4, 1e-3, 2.5e-3, 5e-3, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0];

type Look = Box<dyn Fn() + Send + Sync>;

/// What a scrape returns. One per service, so that several services in one process do not mix.
pub struct Metrics {
    registry: Registry,
    looks: Mutex<Vec<Look>>,
}

impl fmt::Debug for Metrics {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Metrics").finish_non_exhaustive()
    }
}

impl Default for Metrics {
    fn default() -> Self {
        Self::new()
    }
}

impl Metrics {
    /// The metrics of the process itself (memory, processor time, open files); more is declared by the service.
    pub fn new() -> Self {
        let metrics = Self { registry: Registry::new(), looks: Mutex::default() };
        metrics.register(ProcessCollector::for_self());
        metrics
    }

    /// Adds a metric. One whose name is taken or unusable is left out, and said so.
    pub fn register(&self, collector: impl Collector + 'static) {
        if let Err(error) = self.registry.register(Box::new(collector)) {
            tracing::error!(%error, "a metric cannot be registered");
        }
    }

    /// A number that only grows.
    pub fn counter(&self, name: &str, help: &str) -> Counter {
        self.counters(name, help, &[]).with(&[])
    }

    /// One such number for every combination of labels.
    pub fn counters(&self, name: &str, help: &str, labels: &[&str]) -> Counters {
        Counters(self.declare(IntCounterVec::new(Opts::new(name, help), labels)))
    }

    /// A number that goes up and down.
    pub fn gauge(&self, name: &str, help: &str) -> Gauge {
        self.gauges(name, help, &[]).with(&[])
    }

    /// One such number for every combination of labels.
    pub fn gauges(&self, name: &str, help: &str, labels: &[&str]) -> Gauges {
        Gauges(self.declare(GaugeVec::new(Opts::new(name, help), labels)))
    }

    /// A histogram of times.
    pub fn seconds(&self, name: &str, help: &str) -> Seconds {
        self.seconds_by(name, help, &[]).with(&[])
    }

    /// One such histogram for every combination of labels.
    pub fn seconds_by(&self, name: &str, help: &str, labels: &[&str]) -> SecondsBy {
        let options = HistogramOpts::new(name, help).buckets(BUCKETS.to_vec());
        SecondsBy(self.declare(HistogramVec::new(options, labels)))
    }

    /// Called before every scrape: sets what is only known by looking (ages, lengths of queues).
    pub fn before_scrape(&self, look: impl Fn() + Send + Sync + 'static) {
        self.looks.lock().unwrap_or_else(PoisonError::into_inner).push(Box::new(look));
    }

    /// Everything, in the text format.
    pub fn text(&self) -> String {
        for look in self.looks.lock().unwrap_or_else(PoisonError::into_inner).iter() {
            look();
        }
        TextEncoder::new().encode_to_string(&self.registry.gather()).unwrap_or_else(|error| format!("# {error}\n"))
    }

    fn declare<T: Collector + Clone + 'static>(&self, made: Result<T, prometheus::Error>) -> Option<T> {
        match made {
            Ok(metric) => {
                self.register(metric.clone());
                Some(metric)
            }
            Err(error) => {
                tracing::error!(%error, "a metric cannot be declared");
                None
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU32, Ordering};
    use std::time::Duration;

    #[test]
    fn what_is_declared_is_scraped() {
        let metrics = Metrics::new();
        let counter = metrics.counter("magex_test_things_total", "Things.");
        counter.add(2);
        counter.raise_to(5);
        counter.raise_to(3);
        metrics.gauges("magex_test_depth", "Depth.", &["queue"]).with(&["in"]).set(1.5);
        metrics.seconds("magex_test_wait_seconds", "Wait.").observe(Duration::from_millis(2));
        let looks = Arc::new(AtomicU32::new(0));
        let seen = looks.clone();
        metrics.before_scrape(move || {
            seen.fetch_add(1, Ordering::Relaxed);
        });
        let text = metrics.text();
        for line in [
            "magex_test_things_total 5",
            "magex_test_depth{queue=\"in\"} 1.5",
            "magex_test_wait_seconds_bucket{le=\"0.0025\"} 1",
            "magex_test_wait_seconds_count 1",
            "# TYPE magex_test_wait_seconds histogram",
        ] {
            assert!(text.contains(line), "{line}\n{text}");
        }
        assert_eq!(looks.load(Ordering::Relaxed), 1);
    }

    #[test]
    fn a_metric_that_cannot_be_is_left_out_and_harmless() {
        let metrics = Metrics::new();
        metrics.counter("no name", "").add(1);
        metrics.gauge("magex_test_twice", "Once.").set(1.0);
        metrics.gauge("magex_test_twice", "Again.").set(2.0);
        metrics.counters("magex_test_labels_total", "", &["a"]).with(&["x", "y"]).add(1);
        let text = metrics.text();
        assert!(text.contains("magex_test_twice 1") && !text.contains("no name"), "{text}");
    }
}
