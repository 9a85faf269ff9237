//! Reads the files back with a reader of its own: bytes by hand, the checksum bit by bit.

use super::*;
use std::collections::BTreeMap;

/// One event as the reader understands it.
#[derive(Debug, Default, PartialEq)]
struct Read {
    wall_time: f64,
    step: u64,
    version: Option<String>,
    started: bool,
    scalars: BTreeMap<String, f32>,
}

/// CRC-32C by its definition.
fn checksum(bytes: &[u8]) -> u32 {
    let mut crc = u32::MAX;
    for byte in bytes {
        crc ^= u32::from(*byte);
        for _ in 0..8 {
            crc = if crc & 1 == 1 { crc >> 1 ^ 0x82f6_3b78 } else { crc >> 1 };
        }
    }
    !crc
}

fn check_mask(bytes: &[u8], stored: &[u8]) {
    let stored = u32::from_le_bytes(stored.try_into().unwrap()).wrapping_sub(0xa282_ead8);
    assert_eq!(stored.rotate_left(15), checksum(bytes));
}

fn varint(bytes: &mut &[u8]) -> u64 {
    let mut value = 0;
    for shift in (0..).step_by(7) {
        let (first, rest) = bytes.split_first().unwrap();
        *bytes = rest;
        value |= u64::from(first & 0x7f) << shift;
        if first & 0x80 == 0 {
            break;
        }
    }
    value
}

/// Number, and bytes (or the number's eight bytes), of each field.
fn fields(mut bytes: &[u8]) -> Vec<(u64, Vec<u8>)> {
    let mut out = Vec::new();
    while !bytes.is_empty() {
        let key = varint(&mut bytes);
        let mut take = |count: usize| {
            let (head, rest) = bytes.split_at(count);
            bytes = rest;
            head.to_vec()
        };
        let value = match key & 7 {
            0 => varint(&mut bytes).to_le_bytes().to_vec(),
            1 => take(8),
            5 => take(4),
            2 => {
                let length = varint(&mut bytes) as usize;
                let (head, rest) = bytes.split_at(length);
                bytes = rest;
                head.to_vec()
            }
            other => panic!("wire type {other}"),
        };
        out.push((key >> 3, value));
    }
    out
}

fn event(bytes: &[u8]) -> Read {
    let mut read = Read::default();
    for (field, value) in fields(bytes) {
        match field {
            1 => read.wall_time = f64::from_le_bytes(value.try_into().unwrap()),
            2 => read.step = u64::from_le_bytes(value.try_into().unwrap()),
            3 => read.version = Some(String::from_utf8(value).unwrap()),
            5 => {
                for (field, scalar) in fields(&value) {
                    assert_eq!(field, 1);
                    let parts = fields(&scalar);
                    assert_eq!(parts.iter().map(|(field, _)| *field).collect::<Vec<_>>(), [1, 2]);
                    let tag = String::from_utf8(parts[0].1.clone()).unwrap();
                    let value = f32::from_le_bytes(parts[1].1.clone().try_into().unwrap());
                    assert_eq!(read.scalars.insert(tag, value), None);
                }
            }
            7 => read.started = fields(&value) == [(1, 1u64.to_le_bytes().to_vec())],
            other => panic!("field {other}"),
        }
    }
    read
}

fn read(path: &Path) -> Vec<Read> {
    let bytes = std::fs::read(path).unwrap();
    let (mut rest, mut events) = (&bytes[..], Vec::new());
    while !rest.is_empty() {
        let (length, tail) = rest.split_at(8);
        check_mask(length, &tail[..4]);
        let count = u64::from_le_bytes(length.try_into().unwrap()) as usize;
        let body = &tail[4..4 + count];
        check_mask(body, &tail[4 + count..8 + count]);
        events.push(event(body));
        rest = &tail[8 + count..];
    }
    events
}

const LINE: &str = r#"{"iteration":3,"joint_env_steps":480,"success_rate":null,"reward":-0.5,"bound":"actor",
    "executor":{"entropy":0.0,"skipped":0},"timing":{"collect_s":0.25}}"#;

#[test]
fn every_number_of_a_line_is_read_back() {
    let folder = tempfile::tempdir().unwrap();
    let mut file = EventFile::new(Place::of(folder.path()), None);
    assert!(!folder.path().join(FOLDER).exists(), "nothing before the first line");
    file.append(LINE, 480);
    file.append(r#"{"reward":1e300,"iteration":4}"#, 640);
    let events = read(&folder.path().join("tensorboard/events.out.tfevents.0001"));
    assert_eq!(events.len(), 3);
    assert_eq!((events[0].version.as_deref(), events[0].step), (Some("brain.Event:2"), 0));
    let expected = [
        ("executor/entropy", 0.0),
        ("executor/skipped", 0.0),
        ("run/iteration", 3.0),
        ("run/joint_env_steps", 480.0),
        ("run/reward", -0.5),
        ("timing/collect_s", 0.25),
    ];
    assert_eq!(events[1].scalars, expected.map(|(tag, value)| (tag.to_owned(), value)).into());
    assert_eq!((events[1].step, events[2].step), (480, 640));
    assert!(events[1].wall_time > 1.6e9 && events[2].wall_time >= events[1].wall_time);
    assert_eq!(events[2].scalars["run/reward"], f32::INFINITY);
}

#[test]
fn a_resumed_run_begins_a_file_that_takes_back_what_it_does_again() {
    let folder = tempfile::tempdir().unwrap();
    let mut first = EventFile::new(Place::of(folder.path()), None);
    (0..=2).for_each(|k| first.append(LINE, 160 * k));
    // A trainer that ends before its first line leaves nothing.
    drop(EventFile::new(Place::of(folder.path()), Some(320)));
    let mut second = EventFile::new(Place::of(folder.path()), Some(320));
    second.append(LINE, 320);
    let events = read(&folder.path().join("tensorboard/events.out.tfevents.0002"));
    assert!(events[1].started && events[1].step == 320, "{:?}", events[1]);
    assert_eq!(events[2].step, 320);
    assert_eq!(std::fs::read_dir(folder.path().join(FOLDER)).unwrap().count(), 2);
}

#[test]
fn events_that_cannot_be_written_wait_and_begin_a_new_file() {
    let folder = tempfile::tempdir().unwrap();
    let events = folder.path().join(FOLDER);
    std::fs::write(&events, "a file in the way").unwrap();
    let mut file = EventFile::new(Place::of(folder.path()), None);
    (1..=2).for_each(|k| file.append(LINE, 160 * k));
    std::fs::remove_file(&events).unwrap();
    file.append(LINE, 480);
    let steps = |number: u32| {
        let read = read(&events.join(format!("{PREFIX}{number:04}")));
        read.iter().map(|event| event.step).collect::<Vec<_>>()
    };
    assert_eq!(steps(1), [0, 160, 320, 480]);
    // Another program removes the file: the next one takes back what may be left of its first step.
    std::fs::remove_file(events.join(format!("{PREFIX}0001"))).unwrap();
    file.append(LINE, 640);
    assert_eq!(steps(1), [0, 640, 640]);
    // A folder in the place of the run gets nothing.
    let (run, away) = (folder.path().join("run"), folder.path().join("away"));
    std::fs::create_dir(&run).unwrap();
    let mut file = EventFile::new(Place::of(&run), None);
    file.append(LINE, 160);
    std::fs::rename(&run, &away).unwrap();
    std::fs::create_dir(&run).unwrap();
    file.append(LINE, 320);
    assert_eq!(std::fs::read_dir(&run).unwrap().count(), 0);
    std::fs::remove_dir(&run).unwrap();
    std::fs::rename(&away, &run).unwrap();
    file.append(LINE, 480);
    let second = read(&run.join(FOLDER).join(format!("{PREFIX}0002")));
    assert_eq!(second.iter().map(|event| event.step).collect::<Vec<_>>(), [0, 320, 320, 480]);
}
