//! The numbers of metrics.jsonl in TensorBoard's format: `tensorboard/events.out.tfevents.NNNN` in the run folder.
//!
//! Each process of a run writes its own file. The file of a resumed run begins with the step from which it counts: TensorBoard
//! then drops later steps of earlier files, as metrics.jsonl drops those lines. Files are numbered, not named by the clock,
//! because TensorBoard reads them in the order of their names.
//!
//! A record is framed as TensorFlow does: length, masked CRC-32C of the length, bytes, masked CRC-32C of the bytes.

use crate::report::observer::{FileError, RunObserver};
use crate::report::records::IterationMetrics;
use magex_proto::v1::IterationEvent;
use prost::Message;
use serde_json::Value;
use std::fs::{File, OpenOptions};
use std::io::{Error, ErrorKind, Write as _};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

const FOLDER: &str = "tensorboard";

const PREFIX: &str = "events.out.tfevents.";

/// The part of tensorflow.Event that is written.
#[derive(Clone, PartialEq, Message)]
struct Event {
    #[prost(double, tag = "1")]
    wall_time: f64,
    #[prost(int64, tag = "2")]
    step: i64,
    /// One of this and the next two is set.
    #[prost(string, optional, tag = "3")]
    file_version: Option<String>,
    #[prost(message, optional, tag = "5")]
    summary: Option<Summary>,
    #[prost(message, optional, tag = "7")]
    session_log: Option<SessionLog>,
}

#[derive(Clone, PartialEq, Message)]
struct Summary {
    #[prost(message, repeated, tag = "1")]
    values: Vec<Scalar>,
}

#[derive(Clone, PartialEq, Message)]
struct Scalar {
    #[prost(string, tag = "1")]
    tag: String,
    /// Optional: it is one of several kinds of value, so that zero is written too.
    #[prost(float, optional, tag = "2")]
    simple_value: Option<f32>,
}

#[derive(Clone, PartialEq, Message)]
struct SessionLog {
    /// 1 is START.
    #[prost(int32, tag = "1")]
    status: i32,
}

/// Writes event files. An error is logged once and ends the writing; training continues.
#[derive(Debug)]
pub(crate) enum EventFile {
    /// Nothing is written after an error.
    Off,
    /// No file yet: the folder, and the steps that a resumed run continues from.
    Waiting(PathBuf, Option<u64>),
    Open(File, PathBuf),
}

impl EventFile {
    /// In a run folder; `resumed` is the number of steps that the run continues from. The file appears with the first line.
    pub(crate) fn new(folder: &Path, resumed: Option<u64>) -> Self {
        Self::Waiting(folder.join(FOLDER), resumed)
    }

    /// Writes a line of metrics.jsonl: every number in it becomes a scalar at `step`.
    fn append(&mut self, line: &str, step: u64) {
        if let Err((path, error)) = self.write(line, step) {
            tracing::warn!(path = %path.display(), %error, "no more TensorBoard events will be written");
            *self = Self::Off;
        }
    }

    fn write(&mut self, line: &str, step: u64) -> Result<(), (PathBuf, Error)> {
        if let Self::Waiting(folder, resumed) = self {
            let (file, path) = open(folder, *resumed).map_err(|error| (folder.clone(), error))?;
            *self = Self::Open(file, path);
        }
        let Self::Open(file, path) = self else { return Ok(()) };
        let mut values = Vec::new();
        if let Ok(line) = serde_json::from_str(line) {
            scalars("", &line, &mut values);
        }
        let record = record(step, Event { summary: Some(Summary { values }), ..Event::default() });
        // One write, so that a concurrent reader finds whole records.
        file.write_all(&record).map_err(|error| (path.clone(), error))
    }
}

impl RunObserver for EventFile {
    fn iteration(&mut self, _metrics: &IterationMetrics, report: &IterationEvent) {
        self.append(&report.metrics_json, report.joint_env_steps);
    }

    /// Another file, as after a resume.
    fn went_back(&mut self, folder: &Path, _iteration: u32, joint_env_steps: u64) -> Result<(), FileError> {
        *self = Self::new(folder, Some(joint_env_steps));
        Ok(())
    }
}

/// Creates the next file, with the records that every file begins with.
fn open(folder: &Path, resumed: Option<u64>) -> Result<(File, PathBuf), Error> {
    std::fs::create_dir_all(folder)?;
    let number = |name: &str| name.strip_prefix(PREFIX)?.parse::<u32>().ok();
    let names = std::fs::read_dir(folder)?.filter_map(|entry| entry.ok()?.file_name().into_string().ok());
    let mut next = names.filter_map(|name| number(&name)).max().unwrap_or(0);
    let (mut file, path) = loop {
        next = next.checked_add(1).ok_or(ErrorKind::AlreadyExists)?;
        let path = folder.join(format!("{PREFIX}{next:04}"));
        match OpenOptions::new().append(true).create_new(true).open(&path) {
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {}
            other => break (other?, path),
        }
    };
    let mut head = record(0, Event { file_version: Some("brain.Event:2".to_owned()), ..Event::default() });
    if let Some(steps) = resumed {
        head.extend(record(steps, Event { session_log: Some(SessionLog { status: 1 }), ..Event::default() }));
    }
    file.write_all(&head)?;
    Ok((file, path))
}

/// The numbers of an object: those at the top level under `run/`, the others under the name of their object.
fn scalars(group: &str, value: &Value, out: &mut Vec<Scalar>) {
    let Value::Object(fields) = value else { return };
    for (name, value) in fields {
        match value {
            Value::Number(number) => {
                let group = if group.is_empty() { "run" } else { group };
                let simple_value = number.as_f64().map(|x| x as f32);
                out.push(Scalar { tag: format!("{group}/{name}"), simple_value });
            }
            Value::Object(_) if group.is_empty() => scalars(name, value, out),
            Value::Object(_) => scalars(&format!("{group}/{name}"), value, out),
            _ => {}
        }
    }
}

fn record(step: u64, event: Event) -> Vec<u8> {
    #[allow(clippy::disallowed_methods, reason = "what a person reads in TensorBoard; no number of a run")]
    let wall_time = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |time| time.as_secs_f64());
    let event = Event { wall_time, step: step as i64, ..event }.encode_to_vec();
    let length = (event.len() as u64).to_le_bytes();
    [&length[..], &masked(&length), &event, &masked(&event)].concat()
}

/// TensorFlow's mask: a checksum of data that has checksums in it would be weak.
fn masked(bytes: &[u8]) -> [u8; 4] {
    crc32c::crc32c(bytes).rotate_right(15).wrapping_add(0xa282_ead8).to_le_bytes()
}

#[cfg(test)]
mod tests;
