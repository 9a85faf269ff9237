//! The numbers of metrics.jsonl in TensorBoard's format: `tensorboard/events.out.tfevents.NNNN` in the run folder.
//!
//! Each process of a run writes its own file, and another one after a failed write. The file of a resumed run begins with the step from which it counts: TensorBoard
//! then drops later steps of earlier files, as metrics.jsonl drops those lines. Files are numbered, not named by the clock,
//! because TensorBoard reads them in the order of their names.
//!
//! A record is framed as TensorFlow does: length, masked CRC-32C of the length, bytes, masked CRC-32C of the bytes.

use crate::checkpoint::disk::{Disk as _, FileSystem, Place, identity};
use crate::report::observer::{FileError, RunObserver};
use crate::report::records::IterationMetrics;
use magex_proto::v1::IterationEvent;
use prost::Message;
use serde_json::Value;
use std::collections::VecDeque;
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

/// Limit of the records kept while they cannot be written; the oldest are dropped first.
const MAX_WAITING: usize = 4096;

/// Writes event files. Records that cannot be written wait, and begin a new file when they can: the end of the old one may be half
/// a record.
#[derive(Debug)]
pub(crate) struct EventFile {
    place: Place,
    /// The steps that a resumed run continues from.
    resumed: Option<u64>,
    /// This process has begun a file.
    begun: bool,
    open: Option<OpenFile>,
    /// Records with their steps.
    waiting: VecDeque<(u64, Vec<u8>)>,
}

#[derive(Debug)]
struct OpenFile {
    file: File,
    path: PathBuf,
    identity: Option<(u64, u64)>,
}

impl EventFile {
    /// In a run folder; `resumed` is the number of steps that the run continues from. The file appears with the first line.
    pub(crate) fn new(place: Place, resumed: Option<u64>) -> Self {
        Self { place, resumed, begun: false, open: None, waiting: VecDeque::new() }
    }

    /// Writes a line of metrics.jsonl: every number in it becomes a scalar at `step`.
    fn append(&mut self, line: &str, step: u64) {
        let failed_before = !self.waiting.is_empty();
        let mut values = Vec::new();
        if let Ok(line) = serde_json::from_str(line) {
            scalars("", &line, &mut values);
        }
        let record = record(step, Event { summary: Some(Summary { values }), ..Event::default() });
        self.waiting.push_back((step, record));
        if self.waiting.len() > MAX_WAITING {
            self.waiting.pop_front();
        }
        match self.write_waiting() {
            Ok(()) if failed_before => tracing::info!("TensorBoard events can be written again"),
            Ok(()) => {}
            Err(error) => {
                self.open = None;
                match failed_before {
                    true => tracing::debug!(%error, "TensorBoard events still cannot be written"),
                    false => tracing::warn!(%error, "TensorBoard events cannot be written; they wait until they can"),
                }
            }
        }
    }

    fn write_waiting(&mut self) -> Result<(), FileError> {
        let folder = self.place.folder().join(FOLDER);
        let at = |path: &Path| {
            let path = path.to_owned();
            move |error| FileError { path, error }
        };
        self.place.check().map_err(at(&folder))?;
        // One that another program removed takes no more records.
        let own = self.open.take().filter(|open| identity(&open.path) == open.identity);
        let Some((step, _)) = self.waiting.front() else { return Ok(()) };
        let mut open = match own {
            Some(open) => open,
            None => {
                // The end of the file before may be half a record of this step.
                let from = if self.begun { Some(*step) } else { self.resumed };
                begin(&folder, from).map_err(at(&folder))?
            }
        };
        self.begun = true;
        while let Some((_, record)) = self.waiting.front() {
            // One write, so that a concurrent reader finds whole records.
            open.file.write_all(record).map_err(at(&open.path))?;
            self.waiting.pop_front();
        }
        self.open = Some(open);
        Ok(())
    }
}

impl RunObserver for EventFile {
    fn iteration(&mut self, _metrics: &IterationMetrics, report: &IterationEvent) {
        self.append(&report.metrics_json, report.joint_env_steps);
    }

    /// Another file, as after a resume.
    fn went_back(&mut self, _iteration: u32, joint_env_steps: u64) -> Result<(), FileError> {
        self.waiting.retain(|(step, _)| *step < joint_env_steps);
        (self.resumed, self.begun, self.open) = (Some(joint_env_steps), false, None);
        Ok(())
    }
}

/// Creates the next file, with the records that every file begins with.
fn begin(folder: &Path, resumed: Option<u64>) -> Result<OpenFile, Error> {
    FileSystem.create_dir(folder)?;
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
    if let Err(error) = file.write_all(&head) {
        // A full disk would collect one with every iteration.
        let _ = std::fs::remove_file(&path);
        return Err(error);
    }
    Ok(OpenFile { identity: identity(&path), file, path })
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
