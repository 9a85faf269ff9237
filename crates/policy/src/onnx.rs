//! A policy as one ONNX file (opset 17, IR 8): raw positions, velocities and goals in, features inside, logits and actions out.

mod features;
mod graph;
mod networks;
mod proto;

use crate::export::{ExportError, Source};
use features::Inputs;
use graph::{Builder, Size, Value};
use magex_core::config::{ExecutorKind, Observes};
use networks::Networks;
use prost::Message as _;
use proto::{Model, OperatorSet, Property};

/// Largest team whose decoder is written out agent by agent.
const DECODED: usize = 100;

/// The file.
///
/// # Errors
/// The policy cannot be written as a graph; the error says what can.
pub fn write(source: &Source<'_>) -> Result<Vec<u8>, ExportError> {
    let (config, about) = (source.config, &source.about);
    let (task, executor) = (&config.task, &config.executor);
    if executor.kind == ExecutorKind::Mat && task.agents > DECODED {
        return Err(ExportError::TooLarge { agents: task.agents, most: DECODED });
    }
    let mut builder = Builder::default();
    let g = &mut builder;
    let (d, n) = (task.dims(), task.agents);
    let agents = if executor.kind.fixed_team_size() { Size::Fixed(n) } else { Size::Named("agents") };
    let rows = |width: usize| [Size::Named("batch"), agents, Size::Fixed(width)];
    let positions = g.input("positions", &rows(d), "of the agents, from the middle of the map");
    let velocities = g.input("velocities", &rows(d), "of the agents, per second");
    let landmarks = executor.kind.flat() && executor.observes == Observes::Landmarks;
    let goals = match landmarks {
        true => g.input("landmarks", &rows(d), "all landmarks, in the order of their index"),
        false => g.input("goals", &rows(d), "of the agent of the same index"),
    };
    let balls = (task.balls() > 0).then(|| {
        let of = if landmarks { "all balls, in the order of their index" } else { "of the agent of the same index" };
        (g.input("balls", &rows(d), of), g.input("ball_velocities", &rows(d), of))
    });
    let agent_state = (task.agent_state() > 0).then(|| {
        g.input("agent_state", &rows(task.agent_state()), "target velocity (3), x and y of the up axis (2), out (1)")
    });
    // Absolute positions are measured in it.
    let half_side = match executor.kind {
        ExecutorKind::Local => Value::new(),
        _ if executor.kind.fixed_team_size() => g.scalar(task.side / 2.0),
        _ => g.input("half_side", &[Size::Fixed(1)], "half of the side of the map; see half_side in the metadata"),
    };
    let carried = (about.memory > 0)
        .then(|| g.input("memory", &rows(about.memory), "zeros at the start of an episode, then the last output"));
    let o = magex_nets::executor::feature_spec(executor, task).observation;
    let mut inputs =
        Inputs { task, executor, o, positions, velocities, goals, balls, agent_state, half_side, frame: None };
    inputs.find_frame(g);
    let choices = &about.actions.choices;
    let networks = Networks { inputs: &inputs, tensors: &source.tensors, choices };
    let values = config.run.algorithm.off_policy();
    let (logits, memory) = networks.build(g, values, about.last_action, carried.as_deref());
    let logits = to_world(g, &inputs, logits);
    let best: Vec<Value> = g.split(&logits, choices).iter().map(|part| g.argmax(part, true)).collect();
    let best: Vec<&str> = best.iter().map(String::as_str).collect();
    let actions = g.concat(-1, &best);
    g.output("logits", &logits, false, &rows(choices.iter().sum()), "along the axes of the world");
    g.output("actions", &actions, true, &rows(choices.len()), "the best choices, along the axes of the world");
    if let Some(memory) = memory {
        g.output("memory_out", &memory, false, &rows(about.memory), "the next step's memory");
    }
    let mut graph = builder.graph;
    graph.name = "policy".into();
    let metadata = source.metadata();
    let model = Model {
        ir_version: 8,
        producer_name: "magex".into(),
        producer_version: env!("CARGO_PKG_VERSION").into(),
        doc_string: format!("{}: see docs/policy.md of MAGE-X", about.run),
        graph: Some(graph),
        opset_import: vec![OperatorSet { domain: String::new(), version: 17 }],
        metadata_props: metadata.into_iter().map(|(key, value)| Property { key: key.to_owned(), value }).collect(),
    };
    Ok(model.encode_to_vec())
}

/// Logits [B, N, 5] in each agent's own frame along the axes of the world.
fn to_world(g: &mut Builder, inputs: &Inputs<'_>, logits: Value) -> Value {
    let Some(frame) = &inputs.frame else { return logits };
    let (own, signs) = (g.split(&logits, &[1; 5]), g.split(&frame.sign, &[1, 1]));
    let mut parts = vec![own[0].clone()];
    let zero = g.scalar(0.0);
    for (axis, sign) in signs.iter().enumerate() {
        let mirrored = g.op("Less", &[sign, &zero]);
        for negative in 0..2 {
            let along = |g: &mut Builder, axis: usize| {
                g.choose(&mirrored, &own[1 + 2 * axis + (1 - negative)], &own[1 + 2 * axis + negative])
            };
            let (same, other) = (along(g, axis), along(g, 1 - axis));
            parts.push(g.choose(&frame.swap, &other, &same));
        }
    }
    let parts: Vec<&str> = parts.iter().map(String::as_str).collect();
    g.concat(-1, &parts)
}
