//! One measured difference between a recording and our code.

/// A measured difference and its limit.
#[derive(Debug, Clone, PartialEq)]
pub struct Check {
    /// What was compared.
    pub what: &'static str,
    /// The worst difference.
    pub worst: f64,
    /// The largest difference that passes; `None` if the number is informative only.
    pub limit: Option<f64>,
    /// Remark for a reader; may be empty.
    pub words: String,
}

impl Check {
    /// A difference that must not exceed `limit`.
    pub(crate) fn limited(what: &'static str, worst: f64, limit: f64) -> Self {
        Self { what, worst, limit: Some(limit), words: String::new() }
    }
}

/// The checks that exceed their limits, in words. NaN exceeds every limit.
pub(crate) fn disagreements(checks: &[Check]) -> Vec<String> {
    let outside = checks.iter().filter_map(|check| {
        let limit = check.limit.filter(|&limit| check.worst.is_nan() || check.worst > limit)?;
        Some(format!("{}: {:e} is above {limit:e}", check.what, check.worst))
    });
    outside.collect()
}

/// The larger difference. Unlike `max` it keeps a NaN.
pub(crate) fn worse(worst: f64, difference: f64) -> f64 {
    if difference > worst || difference.is_nan() { difference } else { worst }
}
