//! Why a recording cannot be checked.

/// A recording that is malformed or of a kind that this version does not support. Every message names the field.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// The text is not JSON.
    #[error("recording: not valid JSON: {0}")]
    Json(#[from] serde_json::Error),
    /// The file is of another format.
    #[error("format: '{found}' is not supported; use a recording of format {expected}")]
    Format {
        /// What the file says it is.
        found: String,
        /// The formats that the check reads.
        expected: &'static str,
    },
    /// The recording is of a task that this version does not simulate.
    #[error("scenario: '{found}' is not supported; use a recording of scenario spread or push_ball")]
    UnsupportedScenario {
        /// What the file says it is.
        found: String,
    },
    /// A field is missing or malformed.
    #[error("{field}: {problem}")]
    Field {
        /// Path of the field, such as `pos[3][0]`.
        field: String,
        /// What is wrong with it.
        problem: String,
    },
}
