//! The kinds of metrics. One that could not be declared swallows what it is told: a metric must never stop a service.

use prometheus::{GaugeVec, HistogramVec, IntCounter, IntCounterVec};
use std::time::Duration;

/// A number that only grows.
#[derive(Debug, Clone)]
pub struct Counter(Option<IntCounter>);

impl Counter {
    /// So many more.
    pub fn add(&self, count: u64) {
        if let Some(counter) = &self.0 {
            counter.inc_by(count);
        }
    }

    /// So many in all, for who counts elsewhere; callers take turns. Less than before changes nothing.
    pub fn raise_to(&self, total: u64) {
        if let Some(counter) = &self.0 {
            counter.inc_by(total.saturating_sub(counter.get()));
        }
    }
}

/// Counters by labels.
#[derive(Debug, Clone)]
pub struct Counters(pub(super) Option<IntCounterVec>);

impl Counters {
    /// The counter of these values of the labels; it appears in scrapes from now on.
    pub fn with(&self, values: &[&str]) -> Counter {
        Counter(self.0.as_ref().and_then(|all| all.get_metric_with_label_values(values).ok()))
    }
}

/// A number that goes up and down.
#[derive(Debug, Clone)]
pub struct Gauge(Option<prometheus::Gauge>);

impl Gauge {
    /// From now on.
    pub fn set(&self, value: f64) {
        if let Some(gauge) = &self.0 {
            gauge.set(value);
        }
    }

    /// So much more, or less.
    pub fn add(&self, difference: f64) {
        if let Some(gauge) = &self.0 {
            gauge.add(difference);
        }
    }

    /// One more for as long as the guard lives.
    pub fn hold(&self) -> Held {
        self.add(1.0);
        Held(self.clone())
    }
}

/// Counts in a gauge until it is dropped.
#[derive(Debug)]
pub struct Held(Gauge);

impl Drop for Held {
    fn drop(&mut self) {
        self.0.add(-1.0);
    }
}

/// Gauges by labels.
#[derive(Debug, Clone)]
pub struct Gauges(pub(super) Option<GaugeVec>);

impl Gauges {
    /// The gauge of these values of the labels; it appears in scrapes from now on.
    pub fn with(&self, values: &[&str]) -> Gauge {
        Gauge(self.0.as_ref().and_then(|all| all.get_metric_with_label_values(values).ok()))
    }
}

/// A histogram of times.
#[derive(Debug, Clone)]
pub struct Seconds(Option<prometheus::Histogram>);

impl Seconds {
    /// It took so long.
    pub fn observe(&self, time: Duration) {
        if let Some(histogram) = &self.0 {
            histogram.observe(time.as_secs_f64());
        }
    }
}

/// Histograms of times by labels.
#[derive(Debug, Clone)]
pub struct SecondsBy(pub(super) Option<HistogramVec>);

impl SecondsBy {
    /// The histogram of these values of the labels; it appears in scrapes from now on.
    pub fn with(&self, values: &[&str]) -> Seconds {
        Seconds(self.0.as_ref().and_then(|all| all.get_metric_with_label_values(values).ok()))
    }
}
