//! Axes: their limits, their ticks, and how numbers are written beside them.

use magex_core::metrics_table::Scale;

/// Values from..to as pixels start..end.
#[derive(Debug, Clone, Copy)]
pub(super) struct Axis {
    pub(super) from: f64,
    pub(super) to: f64,
    pub(super) start: f64,
    pub(super) end: f64,
    /// Whether equal distances are equal ratios.
    pub(super) log: bool,
}

impl Axis {
    pub(super) fn at(&self, value: f64) -> f64 {
        let place = |value: f64| if self.log { value.log10() } else { value };
        let (from, to) = (place(self.from), place(self.to));
        self.start + (place(value) - from) / (to - from) * (self.end - self.start)
    }

    /// Up to `count` values to label.
    pub(super) fn ticks(&self, count: u32) -> Vec<f64> {
        if !self.log {
            return ticks(self.from, self.to, count);
        }
        let (first, last) = (self.from.log10().ceil() as i32, self.to.log10().floor() as i32);
        let every = (1 + last - first).max(0).unsigned_abs().div_ceil(count).max(1) as usize;
        (first..=last).step_by(every).map(|power| 10f64.powi(power)).collect()
    }
}

/// Lowest and highest value of an axis for some values.
pub(super) fn limits(scale: Scale, log: bool, values: &[f64]) -> (f64, f64) {
    let largest = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let smallest = values.iter().copied().fold(f64::INFINITY, f64::min);
    if !largest.is_finite() {
        return if scale == Scale::FromOne { (1.0, 2.0) } else { (0.0, 1.0) };
    }
    if log {
        return (smallest / 1.3, largest * 1.3);
    }
    let low = match scale {
        Scale::Share | Scale::FromZero => smallest.min(0.0),
        Scale::FromOne => smallest.min(1.0),
        Scale::Free => smallest - (largest - smallest) * 0.04,
    };
    let high = match scale {
        Scale::Share => largest.max(1.0),
        Scale::FromZero | Scale::Free => low + (largest - low) * 1.08,
        // Differences below a percent are noise to look at, and their labels would all read the same.
        Scale::FromOne => low + ((largest - low) * 1.08).max(0.05),
    };
    // A flat line still needs an axis.
    if high - low > 1e-9 * high.abs().max(1e-3) {
        (low, high)
    } else {
        (low - 0.05 * low.abs(), low + low.abs().max(0.1))
    }
}

/// Round values (1, 2 or 5 times a power of ten apart) in low..=high: as many as possible up to `count`, at least two.
pub(super) fn ticks(low: f64, high: f64, count: u32) -> Vec<f64> {
    let power = 10f64.powf(((high - low) / f64::from(count)).log10().floor());
    let ends = |step: f64| ((low / step - 1e-9).ceil() as i64, (high / step + 1e-9).floor() as i64);
    let few = |step: &f64| ends(*step).1 - ends(*step).0 < i64::from(count);
    let step = [1.0, 2.0, 5.0].into_iter().map(|k| k * power).find(few).unwrap_or(10.0 * power);
    (ends(step).0..=ends(step).1).map(|k| k as f64 * step).collect()
}

/// Labels that tell the ticks apart.
pub(super) fn labels(ticks: &[f64], log: bool) -> Vec<String> {
    if log {
        return ticks
            .iter()
            .map(|&tick| if (1e-3..1e6).contains(&tick) { tick.to_string() } else { format!("{tick:e}") })
            .collect();
    }
    let step = ticks.windows(2).map(|pair| pair[1] - pair[0]).fold(f64::INFINITY, f64::min);
    let largest = ticks.iter().fold(0.0, |largest: f64, tick| largest.max(tick.abs()));
    let write = |tick: &f64| match (0..6).find(|&digits| step >= 0.999 * 10f64.powi(-digits)) {
        _ if largest >= 1e5 => format!("{tick:.1e}"),
        Some(digits) => format!("{tick:.*}", digits as usize),
        // A tick that is 0 but for rounding.
        None if tick.abs() < 1e-3 * step => "0".to_owned(),
        None if step.is_finite() => format!("{tick:.1e}"),
        None => tick.to_string(),
    };
    ticks.iter().map(write).collect()
}

/// 0, 500k, 1.5M.
pub(super) fn short_count(value: f64) -> String {
    let (scaled, suffix) = match value {
        v if v >= 1e9 => (v / 1e9, "G"),
        v if v >= 1e6 => (v / 1e6, "M"),
        v if v >= 1e3 => (v / 1e3, "k"),
        v => (v, ""),
    };
    let text = format!("{scaled:.2}");
    format!("{}{suffix}", text.trim_end_matches('0').trim_end_matches('.'))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside_the_axis() {
        assert_eq!(ticks(0.0, 1.0, 6), [0.0, 0.2, 0.4, 0.6000000000000001, 0.8, 1.0]);
        assert_eq!(ticks(0.0, 96_000.0, 8), [0.0, 20_000.0, 40_000.0, 60_000.0, 80_000.0]);
        for k in 1..500 {
            for (low, count) in [(0.0, 6), (0.0, 10), (-0.013 * f64::from(k), 6), (0.98, 5)] {
                let ticks = ticks(low, low + 0.037 * f64::from(k), count);
                assert!((2..=count as usize).contains(&ticks.len()), "{low}, {k}: {ticks:?}");
            }
        }
        let axis = Axis { from: 0.0004, to: 30.0, start: 100.0, end: 0.0, log: true };
        assert_eq!(axis.ticks(9), [0.001, 0.01, 0.1, 1.0, 10.0]);
        assert_eq!(axis.ticks(3), [0.001, 0.1, 10.0]);
        assert!((axis.at(0.0004) - 100.0).abs() < 1e-9 && axis.at(30.0).abs() < 1e-9);
    }

    #[test]
    fn labels_tell_ticks_apart_and_keep_their_sign() {
        for (low, high) in [(0.0, 1.0), (-0.0105, -0.0015), (-2e-7, 3e-7), (0.0, 121.0), (-3e6, 1e6), (0.99, 1.05)] {
            let ticks = ticks(low, high, 4);
            let labels = labels(&ticks, false);
            let mut different = labels.clone();
            different.dedup();
            assert_eq!(labels, different);
            for (tick, label) in ticks.iter().zip(&labels) {
                assert_eq!(*tick < -1e-9, label.starts_with('-'), "{tick} is {label}");
            }
        }
        assert_eq!(labels(&[0.001, 1.0, 1000.0], true), ["0.001", "1", "1000"]);
        assert_eq!(labels(&[1e-5], true), ["1e-5"]);
    }

    #[test]
    fn a_flat_line_has_an_axis() {
        for value in [0.0, 1e-7, -4.0, 3e8] {
            for scale in [Scale::Share, Scale::FromZero, Scale::FromOne, Scale::Free] {
                let (low, high) = limits(scale, false, &[value, value]);
                assert!(low <= value && value <= high && low < high, "{value}, {scale:?}: {low} to {high}");
                assert!(ticks(low, high, 4).len() > 1);
            }
        }
    }

    #[test]
    fn step_counts_are_short() {
        for (value, text) in [(0.0, "0"), (500.0, "500"), (250_000.0, "250k"), (1_500_000.0, "1.5M"), (2e9, "2G")] {
            assert_eq!(short_count(value), text);
        }
    }
}
