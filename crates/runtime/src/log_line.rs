//! Lines of standard error that no filter removes: messages for people, or in the JSON format objects like those of the log.

use std::io::Write as _;
use std::sync::atomic::{AtomicBool, Ordering};
use tracing_subscriber::fmt::format::Writer;
use tracing_subscriber::fmt::time::{FormatTime as _, SystemTime};

/// Whether everything on standard error is JSON.
static JSON: AtomicBool = AtomicBool::new(false);

/// From now on every line is JSON, the message of a panic included.
pub(crate) fn write_json() {
    if !JSON.swap(true, Ordering::Relaxed) {
        std::panic::set_hook(Box::new(|panic| line("ERROR", &panic.to_string(), None)));
    }
}

/// Whether standard error carries JSON objects only.
pub fn is_json() -> bool {
    JSON.load(Ordering::Relaxed)
}

/// Writes a line to standard error that no filter removes: the text, or in the JSON format an object like those of the log.
pub fn line(level: &str, message: &str, exit_code: Option<u8>) {
    let text = match is_json() {
        false => message.to_owned(),
        true => {
            let mut object = serde_json::json!({ "timestamp": timestamp(), "level": level, "message": message });
            if let Some(code) = exit_code {
                object["exit_code"] = code.into();
            }
            object.to_string()
        }
    };
    // If it fails there is no other place to report it.
    let _ = writeln!(std::io::stderr().lock(), "{text}");
}

/// The time of day as log lines have it.
pub fn timestamp() -> String {
    let mut text = String::new();
    // Writing to a string does not fail.
    let _ = SystemTime.format_time(&mut Writer::new(&mut text));
    text
}
