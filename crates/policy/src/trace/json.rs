//! JSON lines.

use super::{Numbers, Step, Trace};
use serde_json::{Value, json};

/// The episode as JSON lines: `{"kind":"episode",…}`, `{"kind":"step",…}` for every step, `{"kind":"end",…}`.
pub fn write(trace: &Trace) -> String {
    let mut about = trace.about.clone();
    about.insert("kind".into(), "episode".into());
    let mut text = format!("{}\n", Value::Object(about));
    for (t, step) in trace.steps.iter().enumerate() {
        text += &format!("{}\n", line(trace.agents, t, step));
    }
    let steps = trace.steps.len();
    text + &format!("{}\n", json!({ "kind": "end", "steps": steps, "metrics": trace.metrics }))
}

fn line(agents: usize, t: usize, step: &Step) -> String {
    let mut line = format!("{{\"kind\":\"step\",\"step\":{t}");
    for (name, _, numbers) in &step.arrays {
        // Not through `Value`, which widens single precision to digits that nothing needs.
        let rows = match numbers {
            Numbers::Floats(values) => {
                let rows: Vec<&[f32]> = values.chunks((values.len() / agents).max(1)).collect();
                serde_json::to_string(&rows)
            }
            Numbers::Bytes(values) => {
                let rows: Vec<&[u8]> = values.chunks((values.len() / agents).max(1)).collect();
                serde_json::to_string(&rows)
            }
        };
        line += &format!(",\"{name}\":{}", rows.unwrap_or_default());
    }
    line + "}"
}
