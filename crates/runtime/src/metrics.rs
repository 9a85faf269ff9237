//! The metrics of a process, in the text format of Prometheus.
//!
//! Each service declares its metrics in one place, with the methods of [`Metrics`]; docs/metrics.md lists all of them, and a
//! test compares that list with a scrape. Metrics are write-only: no number of a run depends on one.

mod process;

pub use prometheus::{Gauge, GaugeVec, Histogram, HistogramVec, IntCounter, IntCounterVec};

use crate::sync::lock;
use prometheus::core::Collector;
use prometheus::{HistogramOpts, Opts, Registry, TextEncoder};
use std::fmt;
use std::sync::{Arc, Mutex};

/// Upper bounds of the buckets of every duration histogram, seconds.
const BUCKETS: [f64; 18] =
    [1e-4, 2.5e-4, 5e-4, 1e-3, 2.5e-3, 5e-3, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0];

type Hook = Box<dyn Fn() + Send + Sync>;

/// The metrics of one service, so that several services in one process do not mix.
///
/// # Panics
/// Declaring a metric panics if its name is taken or invalid. That is a programming error, which the test of the metrics
/// catalogue finds.
pub struct Metrics {
    registry: Registry,
    hooks: Arc<Mutex<Vec<Hook>>>,
    /// What the names of the metrics begin with that are declared from here.
    prefix: String,
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
    /// The metrics of the process itself (memory, processor time, open files); the service declares more.
    pub fn new() -> Self {
        let metrics = Self { registry: Registry::new(), hooks: Arc::default(), prefix: String::new() };
        process::declare(&metrics);
        metrics
    }

    /// The same metrics, to declare those of a service: their names begin with `magex_<service>_`.
    pub fn of(&self, service: &str) -> Self {
        let (registry, hooks) = (self.registry.clone(), self.hooks.clone());
        Self { registry, hooks, prefix: format!("magex_{service}_") }
    }

    /// Declares a counter.
    pub fn counter(&self, name: &str, help: &str) -> IntCounter {
        self.declare(IntCounter::new(self.name(name), help))
    }

    /// Declares a counter for every combination of labels.
    pub fn counters(&self, name: &str, help: &str, labels: &[&str]) -> IntCounterVec {
        self.declare(IntCounterVec::new(Opts::new(self.name(name), help), labels))
    }

    /// Declares a gauge.
    pub fn gauge(&self, name: &str, help: &str) -> Gauge {
        self.declare(Gauge::new(self.name(name), help))
    }

    /// Declares a gauge for every combination of labels.
    pub fn gauges(&self, name: &str, help: &str, labels: &[&str]) -> GaugeVec {
        self.declare(GaugeVec::new(Opts::new(self.name(name), help), labels))
    }

    /// Declares a histogram of durations, in seconds.
    pub fn seconds(&self, name: &str, help: &str) -> Histogram {
        self.declare(Histogram::with_opts(HistogramOpts::new(self.name(name), help).buckets(BUCKETS.to_vec())))
    }

    /// Declares a histogram of durations, in seconds, for every combination of labels.
    pub fn seconds_by(&self, name: &str, help: &str, labels: &[&str]) -> HistogramVec {
        self.declare(HistogramVec::new(HistogramOpts::new(self.name(name), help).buckets(BUCKETS.to_vec()), labels))
    }

    /// Calls `hook` before every scrape, to set gauges that are computed on demand (ages, lengths of queues).
    pub fn before_scrape(&self, hook: impl Fn() + Send + Sync + 'static) {
        lock(&self.hooks).push(Box::new(hook));
    }

    /// All metrics, in the text format.
    pub fn text(&self) -> String {
        for hook in lock(&self.hooks).iter() {
            hook();
        }
        TextEncoder::new().encode_to_string(&self.registry.gather()).unwrap_or_else(|error| format!("# {error}\n"))
    }

    fn name(&self, name: &str) -> String {
        format!("{}{name}", self.prefix)
    }

    #[allow(
        clippy::expect_used,
        reason = "a wrong declaration is a programming error, found by the first test that runs"
    )]
    fn declare<T: Collector + Clone + 'static>(&self, made: Result<T, prometheus::Error>) -> T {
        let metric = made.expect("a metric has a valid name and valid labels");
        self.registry.register(Box::new(metric.clone())).expect("a metric is declared once");
        metric
    }
}

/// Raises a counter to `total`, which is counted elsewhere and never falls. Not atomic: callers hold a lock.
pub fn raise_to(counter: &IntCounter, total: u64) {
    counter.inc_by(total.saturating_sub(counter.get()));
}

/// Counts one in a gauge until it is dropped.
#[derive(Debug)]
pub struct GaugeGuard(Gauge);

impl GaugeGuard {
    /// Adds one to the gauge.
    pub fn new(gauge: Gauge) -> Self {
        gauge.inc();
        Self(gauge)
    }
}

impl Drop for GaugeGuard {
    fn drop(&mut self) {
        self.0.dec();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU32, Ordering};

    #[test]
    fn declared_metrics_are_scraped() {
        let metrics = Metrics::new();
        let counter = metrics.counter("magex_test_things_total", "Things.");
        counter.inc_by(2);
        raise_to(&counter, 5);
        raise_to(&counter, 3);
        metrics.gauges("magex_test_depth", "Depth.", &["queue"]).with_label_values(&["in"]).set(1.5);
        metrics.seconds("magex_test_wait_seconds", "Wait.").observe(2e-3);
        let held = metrics.gauge("magex_test_held", "Held.");
        let guards = [GaugeGuard::new(held.clone()), GaugeGuard::new(held.clone())];
        assert!(held.get() == 2.0);
        drop(guards);
        let calls = Arc::new(AtomicU32::new(0));
        let seen = calls.clone();
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
            "magex_test_held 0",
        ] {
            assert!(text.contains(line), "{line}\n{text}");
        }
        assert_eq!(calls.load(Ordering::Relaxed), 1);
    }
}
