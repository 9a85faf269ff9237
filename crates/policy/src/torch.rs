//! A policy as a PyTorch module: one Python file, and its weights beside it.

use crate::export::Source;

/// The module without what it says about itself.
const MODULE: &str = include_str!("torch/policy.py");

/// The Python file; `weights` is the name of the weights file beside it.
pub fn write(source: &Source<'_>, weights: &str) -> String {
    let metadata: serde_json::Map<String, serde_json::Value> =
        source.metadata().into_iter().map(|(key, value)| (key.to_owned(), value.into())).collect();
    let text = serde_json::to_string_pretty(&metadata).unwrap_or_default();
    // JSON text within a raw string of Python: neither holds three quotation marks in a row.
    MODULE.replace("@METADATA@", &text).replace("@WEIGHTS@", weights)
}
