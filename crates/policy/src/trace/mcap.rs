//! MCAP with the scenes of an episode, which Foxglove shows: agents, balls, goals, and contacts in red.
//!
//! The file is complete when it is written: header, one chunk-less data section, a summary with what readers want to know
//! first, footer.

use super::Trace;
use serde_json::{Value, json};

const MAGIC: &[u8] = b"\x89MCAP0\r\n";
const TOPIC: &str = "/episode";
/// The properties that Foxglove reads of a scene, as JSON schema.
const SCHEMA: &str = r#"{"title":"foxglove.SceneUpdate","type":"object","properties":{"deletions":{"type":"array","items":{"type":"object"}},"entities":{"type":"array","items":{"type":"object","properties":{"timestamp":{"type":"object","properties":{"sec":{"type":"integer"},"nsec":{"type":"integer"}}},"frame_id":{"type":"string"},"id":{"type":"string"},"lifetime":{"type":"object","properties":{"sec":{"type":"integer"},"nsec":{"type":"integer"}}},"frame_locked":{"type":"boolean"},"metadata":{"type":"array","items":{"type":"object"}},"arrows":{"type":"array","items":{"type":"object"}},"cubes":{"type":"array","items":{"type":"object"}},"spheres":{"type":"array","items":{"type":"object"}},"cylinders":{"type":"array","items":{"type":"object"}},"lines":{"type":"array","items":{"type":"object"}},"triangles":{"type":"array","items":{"type":"object"}},"texts":{"type":"array","items":{"type":"object"}},"models":{"type":"array","items":{"type":"object"}}}}}}}"#;

/// The episode, from 0 s on.
pub fn write(trace: &Trace) -> Vec<u8> {
    let mut bytes = MAGIC.to_vec();
    record(&mut bytes, 0x01, &[text("magex"), text(concat!("magex ", env!("CARGO_PKG_VERSION")))].concat());
    let schema =
        [&1u16.to_le_bytes()[..], &text("foxglove.SceneUpdate"), &text("jsonschema"), &blob(SCHEMA.as_bytes())]
            .concat();
    let channel =
        [&0u16.to_le_bytes()[..], &1u16.to_le_bytes(), &text(TOPIC), &text("json"), &0u32.to_le_bytes()].concat();
    let metadata = metadata(trace);
    record(&mut bytes, 0x03, &schema);
    record(&mut bytes, 0x04, &channel);
    let (place, length) = (bytes.len() as u64, 9 + metadata.len() as u64);
    record(&mut bytes, 0x0C, &metadata);
    let seconds = f64::from(trace.step_seconds);
    // Whole microseconds: a tenth in single precision is not quite one.
    let time = |t: usize| (t as f64 * seconds * 1e6).round() as u64 * 1000;
    for t in 0..trace.steps.len() {
        let mut message = 0u16.to_le_bytes().to_vec();
        message.extend((t as u32).to_le_bytes());
        message.extend(time(t).to_le_bytes());
        message.extend(time(t).to_le_bytes());
        message.extend(scene(trace, t, time(t)).to_string().as_bytes());
        record(&mut bytes, 0x05, &message);
    }
    record(&mut bytes, 0x0F, &0u32.to_le_bytes());
    let summary = bytes.len() as u64;
    record(&mut bytes, 0x03, &schema);
    record(&mut bytes, 0x04, &channel);
    let count = trace.steps.len() as u64;
    let mut statistics = count.to_le_bytes().to_vec();
    statistics.extend(1u16.to_le_bytes());
    for number in [1u32, 0, 1, 0] {
        statistics.extend(number.to_le_bytes());
    }
    statistics.extend(0u64.to_le_bytes());
    statistics.extend(time(trace.steps.len().saturating_sub(1)).to_le_bytes());
    statistics.extend(10u32.to_le_bytes());
    statistics.extend(0u16.to_le_bytes());
    statistics.extend(count.to_le_bytes());
    record(&mut bytes, 0x0B, &statistics);
    record(&mut bytes, 0x0D, &[&place.to_le_bytes()[..], &length.to_le_bytes(), &text("magex")].concat());
    let footer = [&summary.to_le_bytes()[..], &0u64.to_le_bytes(), &0u32.to_le_bytes()].concat();
    record(&mut bytes, 0x02, &footer);
    bytes.extend(MAGIC);
    bytes
}

/// What the episode is of, by name.
fn metadata(trace: &Trace) -> Vec<u8> {
    let pairs: Vec<u8> = trace
        .about
        .iter()
        .flat_map(|(key, value)| {
            let value = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
            [text(key), text(&value)].concat()
        })
        .collect();
    [text("magex"), blob(&pairs)].concat()
}

fn record(bytes: &mut Vec<u8>, code: u8, content: &[u8]) {
    bytes.push(code);
    bytes.extend((content.len() as u64).to_le_bytes());
    bytes.extend(content);
}

fn text(text: &str) -> Vec<u8> {
    blob(text.as_bytes())
}

fn blob(content: &[u8]) -> Vec<u8> {
    [&(content.len() as u32).to_le_bytes()[..], content].concat()
}

fn scene(trace: &Trace, t: usize, nanos: u64) -> Value {
    let step = &trace.steps[t];
    let d = trace.dims;
    let (agents, goals) = (step.floats("positions"), step.floats("goals"));
    let point = |at: &[f32]| json!({ "x": at[0], "y": at[1], "z": at.get(2).copied().unwrap_or(0.0) });
    let sphere = |at: &[f32], radius: f32, colour: [f32; 4]| {
        let [r, g, b, a] = colour;
        let size = json!({ "x": 2.0 * radius, "y": 2.0 * radius, "z": 2.0 * radius });
        let pose = json!({ "position": point(at), "orientation": { "x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0 } });
        json!({ "pose": pose, "size": size, "color": { "r": r, "g": g, "b": b, "a": a } })
    };
    let touches = |i: usize| {
        agents.chunks_exact(d).enumerate().any(|(j, other)| {
            let square: f32 = other.iter().zip(&agents[i * d..]).map(|(a, b)| (a - b) * (a - b)).sum();
            i != j && square < trace.contact_radius * trace.contact_radius
        })
    };
    let [agent, ball, landmark] = trace.radii;
    let mut spheres: Vec<Value> = Vec::new();
    for (i, at) in agents.chunks_exact(d).enumerate() {
        let colour = if touches(i) { [0.9, 0.1, 0.1, 1.0] } else { [0.15, 0.4, 0.85, 1.0] };
        spheres.push(sphere(at, agent, colour));
    }
    spheres.extend(step.floats("balls").chunks_exact(d).map(|at| sphere(at, ball, [0.95, 0.6, 0.1, 1.0])));
    spheres.extend(goals.chunks_exact(d).map(|at| sphere(at, landmark, [0.2, 0.7, 0.3, 0.6])));
    let points: Vec<Value> =
        agents.chunks_exact(d).zip(goals.chunks_exact(d)).flat_map(|(from, to)| [point(from), point(to)]).collect();
    let lines = json!([{
        "type": 2, "pose": { "position": point(&[0.0, 0.0]), "orientation": { "x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0 } },
        "thickness": 1.0, "scale_invariant": true, "points": points,
        "color": { "r": 0.5, "g": 0.5, "b": 0.5, "a": 0.5 }, "colors": [], "indices": []
    }]);
    json!({ "deletions": [], "entities": [{
        "timestamp": { "sec": nanos / 1_000_000_000, "nsec": nanos % 1_000_000_000 }, "frame_id": "map", "id": "episode",
        "lifetime": { "sec": 0, "nsec": 0 }, "frame_locked": false, "metadata": [], "arrows": [], "cubes": [],
        "spheres": spheres, "cylinders": [], "lines": lines, "triangles": [], "texts": [], "models": []
    }] })
}
