//! What an update reports: named numbers, in the order in which they are shown.

use magex_core::metrics_table::as_written;
use serde::ser::{Serialize, Serializer};

/// An ordered list of named numbers, an object in JSON. Metrics, event files and pages show what is in it: they know no
/// algorithm's losses by name.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct UpdateStats(Vec<(String, f64)>);

impl UpdateStats {
    /// Appends a number.
    pub fn push(&mut self, name: impl Into<String>, value: f64) {
        self.0.push((name.into(), value));
    }

    /// The number of a name.
    pub fn get(&self, name: &str) -> Option<f64> {
        self.0.iter().find(|(own, _)| own == name).map(|(_, value)| *value)
    }

    /// Names and numbers in order.
    pub fn iter(&self) -> impl Iterator<Item = (&str, f64)> {
        self.0.iter().map(|(name, value)| (name.as_str(), *value))
    }
}

impl Serialize for UpdateStats {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self.iter().map(|(name, value)| (name, as_written(value))))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_order_of_names_is_kept() {
        let mut stats = UpdateStats::default();
        stats.push("value_loss", f64::from(0.1_f32));
        stats.push("entropy", f64::NAN);
        assert_eq!(serde_json::to_string(&stats).unwrap(), r#"{"value_loss":0.1,"entropy":null}"#);
        assert_eq!((stats.get("value_loss"), stats.get("other")), (Some(f64::from(0.1_f32)), None));
    }
}
