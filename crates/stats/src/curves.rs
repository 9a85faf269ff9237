//! Several learning curves as one.

/// A point of the mean of several curves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BandPoint {
    /// Place on the horizontal axis, such as joint environment steps.
    pub x: f64,
    /// Mean over the curves.
    pub mean: f64,
    /// Lowest of the curves.
    pub low: f64,
    /// Highest of the curves.
    pub high: f64,
}

/// The mean of curves with a band from the lowest to the highest, at every place that a curve has a point. A curve is a list of
/// `[x, y]` with rising x; between its points it is a straight line, before the first one it is not there, and behind the last one
/// it keeps its value: a run that has reached its target stays as good as it is.
pub fn band(curves: &[Vec<[f64; 2]>]) -> Vec<BandPoint> {
    let mut places: Vec<f64> = curves.iter().flatten().map(|&[x, _]| x).collect();
    places.sort_unstable_by(f64::total_cmp);
    places.dedup();
    let point = |x: f64| {
        let values: Vec<f64> = curves.iter().filter_map(|curve| value_at(curve, x)).collect();
        let [low, high] = [f64::min, f64::max].map(|pick| values.iter().copied().reduce(pick));
        Some(BandPoint { x, mean: crate::aggregate::average(&values), low: low?, high: high? })
    };
    places.into_iter().filter_map(point).collect()
}

/// The value of a curve at a place: see [`band`].
pub fn value_at(curve: &[[f64; 2]], x: f64) -> Option<f64> {
    let behind = curve.partition_point(|&[at, _]| at <= x);
    let &[left, from] = curve.get(behind.checked_sub(1)?)?;
    let Some(&[right, to]) = curve.get(behind) else { return Some(from) };
    Some(from + (to - from) * (x - left) / (right - left))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_that_ended_keeps_its_value_and_one_that_has_not_begun_is_not_there() {
        let curves = [vec![[0.0, 0.0], [10.0, 1.0]], vec![[5.0, 0.1], [20.0, 0.4]]];
        let points = band(&curves);
        assert_eq!(points.iter().map(|point| point.x).collect::<Vec<_>>(), [0.0, 5.0, 10.0, 20.0]);
        assert_eq!((points[0].low, points[0].mean, points[0].high), (0.0, 0.0, 0.0));
        assert_eq!((points[1].low, points[1].high), (0.1, 0.5));
        assert!((points[2].mean - 0.6).abs() < 1e-12 && (points[3].mean - 0.7).abs() < 1e-12);
        assert_eq!(band(&[]), []);
        assert_eq!(value_at(&[], 1.0), None);
    }
}
