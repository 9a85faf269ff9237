//! What a comparison with a recording measured.

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

/// The comparison with one recording.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct Report {
    /// What was compared, for example `N = 50, 120 steps`.
    pub(crate) content: String,
    pub(crate) checks: Vec<Check>,
    pub(crate) mismatches: Vec<String>,
}

impl Report {
    /// Adds a difference that must not exceed `limit`.
    pub(crate) fn limited(&mut self, what: &'static str, worst: f64, limit: f64) {
        self.checks.push(Check { what, worst, limit: Some(limit), words: String::new() });
    }

    /// Adds a difference that is informative only.
    pub(crate) fn informative(&mut self, what: &'static str, worst: f64, words: impl Into<String>) {
        self.checks.push(Check { what, worst, limit: None, words: words.into() });
    }

    /// Everything that disagrees, in words; empty if the recording agrees. NaN exceeds every limit.
    pub(crate) fn disagreements(&self) -> Vec<String> {
        let outside = self.checks.iter().filter_map(|check| {
            let limit = check.limit.filter(|&limit| check.worst.is_nan() || check.worst > limit)?;
            Some(format!("{}: {:e} is above {limit:e}", check.what, check.worst))
        });
        self.mismatches.iter().cloned().chain(outside).collect()
    }
}

/// The larger difference. Unlike `max` it keeps a NaN.
pub(crate) fn worse(worst: f64, difference: f64) -> f64 {
    if difference > worst || difference.is_nan() { difference } else { worst }
}

#[cfg(test)]
impl Report {
    /// Whether nothing disagrees.
    pub(crate) fn agrees(&self) -> bool {
        self.disagreements().is_empty()
    }

    /// The worst difference of a check.
    pub(crate) fn worst(&self, what: &str) -> f64 {
        self.checks.iter().find(|check| check.what == what).unwrap().worst
    }
}
