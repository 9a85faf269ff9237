//! Order statistics of measured times.

/// The q-quantile of the times, which get sorted; 0 without any.
pub(crate) fn quantile(times: &mut [f64], q: f64) -> f64 {
    times.sort_unstable_by(f64::total_cmp);
    let place = (times.len() as f64 * q) as usize;
    times.get(place.min(times.len().saturating_sub(1))).copied().unwrap_or_default()
}
