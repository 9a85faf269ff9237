//! The networks of the executors as nodes of a graph; the tensors keep the names of the weights file.

use super::features::Inputs;
use super::graph::{Builder, Value};
use crate::tensors::Tensors;
use magex_core::config::ExecutorKind;

/// Width and number of heads of the attention ablation.
const HEADS: usize = 4;
const HEAD_WIDTH: usize = 16;

/// What the networks are built of.
pub(super) struct Networks<'a> {
    pub(super) inputs: &'a Inputs<'a>,
    pub(super) tensors: &'a Tensors,
    /// Choices of each component of an action.
    pub(super) choices: &'a [usize],
}

/// GELU by the hyperbolic tangent.
fn gelu(g: &mut Builder, x: &str) -> Value {
    let square = g.mul(x, x);
    let cube = g.mul(&square, x);
    let cube = g.times(&cube, 0.044_715);
    let inner = g.add(x, &cube);
    let inner = g.times(&inner, 0.797_884_6);
    let (gate, one) = (g.tanh(&inner), g.scalar(1.0));
    let gate = g.add(&gate, &one);
    let half = g.times(x, 0.5);
    g.mul(&half, &gate)
}

impl Networks<'_> {
    fn weight(&self, g: &mut Builder, name: &str) -> Value {
        let (name, shape, values) = self.tensors.get(name);
        g.tensor(&name, shape, values)
    }

    fn layer(&self, g: &mut Builder, name: &str, x: &str) -> Value {
        let (w, b) = (self.weight(g, &format!("{name}.weight")), self.weight(g, &format!("{name}.bias")));
        let product = g.matmul(x, &w);
        g.add(&product, &b)
    }

    fn norm(&self, g: &mut Builder, name: &str, x: &str) -> Value {
        let (scale, shift) = (self.weight(g, &format!("{name}.scale")), self.weight(g, &format!("{name}.shift")));
        g.layer_norm(x, &scale, &shift)
    }

    /// A gated recurrent unit, gates in the order reset, update, new. Of primitives: every runtime computes them alike, for any
    /// batch, and without a reshape to one sequence.
    fn gru(&self, g: &mut Builder, x: &str, h: &str, width: usize) -> Value {
        let (x, u) = (self.layer(g, "gru.input", x), self.layer(g, "gru", h));
        let (x, u) = (g.split(&x, &[width; 3]), g.split(&u, &[width; 3]));
        let gate = |g: &mut Builder, k: usize| {
            let sum = g.add(&x[k], &u[k]);
            g.op("Sigmoid", &[&sum])
        };
        let (reset, update) = (gate(g, 0), gate(g, 1));
        let candidate = g.mul(&reset, &u[2]);
        let candidate = g.add(&x[2], &candidate);
        let new = g.tanh(&candidate);
        let way = g.sub(h, &new);
        let way = g.mul(&update, &way);
        g.add(&new, &way)
    }

    /// Σ over an agent's nearest neighbours of relu(neighbour → units).
    fn crowd(&self, g: &mut Builder, name: &str) -> Value {
        let (seen, exists) = self.inputs.neighbours(g);
        let units = self.layer(g, name, &seen);
        let units = g.relu(&units);
        let units = g.mul(&units, &exists);
        g.sum(&units, 2, false)
    }

    /// E_a [B, N, F].
    fn team(&self, g: &mut Builder) -> Value {
        let executor = self.inputs.executor;
        let (f, units, n) = (executor.feature_size, executor.pair_hidden, self.inputs.task.agents);
        let (nodes, pairs) = self.inputs.team(g);
        let x = self.layer(g, "f_o", &nodes);
        let x = g.relu(&x);
        match executor.kind {
            ExecutorKind::Mlp => {
                let flat = g.reshape(&x, &[0, 1, (n * f) as i64]);
                let team = self.layer(g, "concat", &flat);
                let team = g.relu(&team);
                // The same for all agents.
                let zeros = g.times(&x, 0.0);
                return g.add(&team, &zeros);
            }
            ExecutorKind::Attention => {
                let inner = HEADS * HEAD_WIDTH;
                let qkv = self.layer(g, "attention.qkv", &x);
                let parts = g.split(&qkv, &[inner; 3]);
                let heads = |g: &mut Builder, x: &str, order: [i64; 4]| {
                    let x = g.reshape(x, &[0, 0, HEADS as i64, HEAD_WIDTH as i64]);
                    g.transpose(&x, &order)
                };
                let (q, v) = (heads(g, &parts[0], [0, 2, 1, 3]), heads(g, &parts[2], [0, 2, 1, 3]));
                let k = heads(g, &parts[1], [0, 2, 3, 1]);
                let score = g.matmul(&q, &k);
                let score = g.times(&score, 0.25);
                let score = g.softmax(&score);
                let mixed = g.matmul(&score, &v);
                let mixed = g.transpose(&mixed, &[0, 2, 1, 3]);
                let mixed = g.reshape(&mixed, &[0, 0, inner as i64]);
                return self.layer(g, "attention.out", &mixed);
            }
            _ => {}
        }
        let literal = executor.kind == ExecutorKind::MagexLiteral;
        let (total, count) = (g.sum(&x, 1, true), self.inputs.agents(g));
        let mut h = if literal {
            // The mean of all agents, the same for each.
            let (mean, zeros) = (g.div(&total, &count), g.times(&x, 0.0));
            g.add(&mean, &zeros)
        } else {
            let others = g.sub(&total, &x);
            let minus = g.scalar(-1.0);
            let left = g.add(&count, &minus);
            let left = g.at_least(&left, 1.0);
            let others = g.div(&others, &left);
            g.concat(-1, &[&x, &others])
        };
        h = self.layer(g, "gcn", &h);
        h = g.relu(&h);
        let itself = self.inputs.diagonal(g);
        let others = g.op("Not", &[&itself]);
        for b in 0..executor.graph_blocks {
            let projected = self.layer(g, &format!("block{b}.project"), &h);
            let parts = g.split(&projected, &[units, units, f, f]);
            let (mut sender, mut receiver) = (parts[0].clone(), parts[1].clone());
            if !literal {
                let relative = self.weight(g, &format!("block{b}.relative"));
                let relative = g.matmul(&pairs, &relative);
                sender = g.sub(&sender, &relative);
                receiver = g.add(&receiver, &relative);
            }
            let (sender, receiver) = (g.unsqueeze(&sender, 2), g.unsqueeze(&receiver, 1));
            let hidden = g.add(&sender, &receiver);
            let hidden = g.relu(&hidden);
            let score = self.weight(g, &format!("block{b}.score"));
            let score = g.split(&score, &[units, 1]);
            let column = g.unsqueeze(&score[0], 1);
            let logits = g.matmul(&hidden, &column);
            let logits = g.squeeze(&logits, -1);
            let logits = g.add(&logits, &score[1]);
            let zero = g.scalar(0.0);
            let edges = g.op("Greater", &[&logits, &zero]);
            let edges = g.op("And", &[&edges, &others]);
            let edges = g.cast_float(&edges);
            let degree = g.sum(&edges, -1, true);
            let degree = g.at_least(&degree, 1.0);
            let message = g.matmul(&edges, &parts[2]);
            let message = g.div(&message, &degree);
            let sum = if literal { message } else { g.add(&parts[3], &message) };
            h = g.relu(&sum);
        }
        h
    }

    /// Logits in each agent's own frame, and what it carries on.
    pub(super) fn build(
        &self,
        g: &mut Builder,
        values: bool,
        last_action: bool,
        memory: Option<&str>,
    ) -> (Value, Option<Value>) {
        let executor = self.inputs.executor;
        match executor.kind {
            ExecutorKind::Local => {
                let own = self.inputs.own(g, true);
                let own = self.layer(g, "own", &own);
                let (own, crowd) = (g.relu(&own), self.crowd(g, "neighbour"));
                let both = g.concat(-1, &[&own, &crowd]);
                let mixed = self.layer(g, "mix", &both);
                let mixed = g.relu(&mixed);
                (self.layer(g, "head", &mixed), None)
            }
            ExecutorKind::Mat | ExecutorKind::MatDec => (self.transformer(g), None),
            ExecutorKind::Dicg => (self.dicg(g), None),
            ExecutorKind::Flat => self.flat(g, values, last_action, memory),
            _ => {
                let literal = executor.kind == ExecutorKind::MagexLiteral;
                let own = self.inputs.own(g, !literal);
                let goal = self.layer(g, "f_goal", &own);
                let mut parts = vec![g.relu(&goal), self.team(g)];
                if self.tensors.has("f_near.weight") {
                    parts.push(self.crowd(g, "f_near"));
                }
                let parts: Vec<&str> = parts.iter().map(String::as_str).collect();
                let mut x = g.concat(-1, &parts);
                if executor.feature_norm {
                    x = self.norm(g, "f_state.norm", &x);
                }
                x = self.layer(g, "f_state", &x);
                x = g.relu(&x);
                let h = self.gru(g, &x, memory.unwrap_or_default(), executor.feature_size);
                let x = self.norm(g, "gru.norm", &h);
                (self.layer(g, "head", &x), Some(h))
            }
        }
    }

    fn flat(&self, g: &mut Builder, values: bool, last_action: bool, memory: Option<&str>) -> (Value, Option<Value>) {
        let executor = self.inputs.executor;
        let (width, choices) = (if executor.recurrent { executor.hidden } else { 0 }, self.choices.iter().sum());
        let carried = memory.unwrap_or_default();
        let (mut h, mut last) = (carried.to_owned(), carried.to_owned());
        if width > 0 && last_action {
            let parts = g.split(carried, &[width, choices]);
            (h, last) = (parts[0].clone(), parts[1].clone());
        }
        let act = |g: &mut Builder, x: &str| if values { g.relu(x) } else { g.tanh(x) };
        let mut x = self.inputs.vector(g);
        if last_action {
            x = g.concat(-1, &[&x, &last]);
        }
        x = self.layer(g, if values { "first" } else { "own" }, &x);
        x = act(g, &x);
        let mut next = None;
        if width > 0 {
            x = self.gru(g, &x, &h, width);
            next = Some(x.clone());
            if !values {
                x = self.norm(g, "gru.norm", &x);
            }
        } else {
            x = self.layer(g, "second", &x);
            x = act(g, &x);
        }
        let logits = self.layer(g, "head", &x);
        if last_action {
            let chosen = self.one_hot(g, &logits);
            next = Some(match next {
                Some(h) => g.concat(-1, &[&h, &chosen]),
                None => chosen,
            });
        }
        (logits, next)
    }

    fn dicg(&self, g: &mut Builder) -> Value {
        let mut x = self.inputs.vector(g);
        for k in 0..2 {
            x = self.layer(g, &format!("encoder.{k}"), &x);
            x = g.tanh(&x);
        }
        let start = x.clone();
        let w = self.weight(g, "attention.weight");
        let (asked, across) = (g.matmul(&start, &w), g.transpose(&start, &[0, 2, 1]));
        let score = g.matmul(&asked, &across);
        let mixing = g.softmax(&score);
        for k in 0..2 {
            let (w, b) = (self.weight(g, &format!("graph.{k}.weight")), self.weight(g, &format!("graph.{k}.bias")));
            let projected = g.matmul(&x, &w);
            let mixed = g.matmul(&mixing, &projected);
            let mixed = g.add(&mixed, &b);
            x = g.tanh(&mixed);
        }
        x = g.add(&start, &x);
        for k in 0..3 {
            x = self.layer(g, &format!("head.{k}"), &x);
            x = g.tanh(&x);
        }
        self.layer(g, "head.3", &x)
    }

    /// The best choice of every component as ones in zeros [.., A].
    fn one_hot(&self, g: &mut Builder, logits: &str) -> Value {
        let parts = g.split(logits, self.choices);
        let mut chosen = Vec::new();
        for (part, &size) in parts.iter().zip(self.choices) {
            let best = g.argmax(part, true);
            let range: Vec<i64> = (0..size as i64).collect();
            let range = g.ints(&[size], &range);
            let equal = g.op("Equal", &[&best, &range]);
            chosen.push(g.cast_float(&equal));
        }
        let chosen: Vec<&str> = chosen.iter().map(String::as_str).collect();
        g.concat(-1, &chosen)
    }

    fn feed(&self, g: &mut Builder, name: &str, x: &str) -> Value {
        let wide = self.layer(g, &format!("{name}.wide"), x);
        let wide = gelu(g, &wide);
        self.layer(g, &format!("{name}.narrow"), &wide)
    }

    /// x [B, R, d] as heads: [B, heads, R, d / heads], or with the last two swapped.
    fn heads(&self, g: &mut Builder, x: &str, swapped: bool) -> Value {
        let (heads, d) = (self.inputs.executor.attention_heads, self.inputs.executor.hidden);
        let x = g.reshape(x, &[0, 0, heads as i64, (d / heads) as i64]);
        g.transpose(&x, if swapped { &[0, 2, 3, 1] } else { &[0, 2, 1, 3] })
    }

    /// What queries [B, R, d] get of keys and values [B, S, d].
    fn attend(&self, g: &mut Builder, name: &str, query: &str, keys: &str, values: &str) -> Value {
        let (heads, d) = (self.inputs.executor.attention_heads, self.inputs.executor.hidden);
        let (q, k, v) = (self.heads(g, query, false), self.heads(g, keys, true), self.heads(g, values, false));
        let score = g.matmul(&q, &k);
        let score = g.times(&score, 1.0 / ((d / heads) as f32).sqrt());
        let score = g.softmax(&score);
        let mixed = g.matmul(&score, &v);
        let mixed = g.transpose(&mixed, &[0, 2, 1, 3]);
        let mixed = g.reshape(&mixed, &[0, 0, d as i64]);
        self.layer(g, &format!("{name}.out"), &mixed)
    }

    fn transformer(&self, g: &mut Builder) -> Value {
        let executor = self.inputs.executor;
        let (n, blocks) = (self.inputs.task.agents, executor.attention_blocks);
        let vector = self.inputs.vector(g);
        let vector = self.norm(g, "encoder.vector_norm", &vector);
        let x = self.layer(g, "encoder.embed", &vector);
        let x = gelu(g, &x);
        let mut x = self.norm(g, "encoder.norm", &x);
        for b in 0..blocks {
            let name = format!("encoder.{b}.attention");
            let [q, k, v] = ["query", "key", "value"].map(|part| self.layer(g, &format!("{name}.{part}"), &x));
            let mixed = self.attend(g, &name, &q, &k, &v);
            let sum = g.add(&x, &mixed);
            x = self.norm(g, &format!("encoder.{b}.norm.0"), &sum);
            let fed = self.feed(g, &format!("encoder.{b}.mlp"), &x);
            let sum = g.add(&x, &fed);
            x = self.norm(g, &format!("encoder.{b}.norm.1"), &sum);
        }
        if executor.kind == ExecutorKind::MatDec {
            return self.logits(g, &x);
        }
        // Agent by agent: the graph has a copy of the decoder for each, which sees keys and values of those before.
        let embed = self.weight(g, "decoder.embed.weight");
        let choices: usize = self.choices.iter().sum();
        let zero = g.ints(&[1], &[0]);
        let mut first = vec![0.0; 1 + choices];
        first[0] = 1.0;
        let first = g.floats(&[1, 1, 1 + choices], &first);
        let start = g.gather(&x, &zero, 1);
        let start = g.gather(&start, &zero, 2);
        let nothing = g.times(&start, 0.0);
        let mut token = g.add(&first, &nothing);
        let mut kept: Vec<[Option<(Value, Value)>; 2]> = vec![[None, None]; blocks];
        let mut all = Vec::new();
        let begin = g.floats(&[1, 1, 1], &[0.0]);
        for i in 0..n {
            let at = g.ints(&[1], &[i as i64]);
            let encoded = g.gather(&x, &at, 1);
            let embedded = g.matmul(&token, &embed);
            let embedded = gelu(g, &embedded);
            let mut y = self.norm(g, "decoder.norm", &embedded);
            for (b, kept) in kept.iter_mut().enumerate() {
                for (which, kept) in ["own", "cross"].into_iter().zip(kept) {
                    let name = format!("decoder.{b}.{which}");
                    let asking = if which == "own" { y.clone() } else { encoded.clone() };
                    let query = self.layer(g, &format!("{name}.query"), &asking);
                    let [key, value] = ["key", "value"].map(|part| self.layer(g, &format!("{name}.{part}"), &y));
                    let (keys, values) = match kept.take() {
                        Some((keys, values)) => (g.concat(1, &[&keys, &key]), g.concat(1, &[&values, &value])),
                        None => (key, value),
                    };
                    let mixed = self.attend(g, &name, &query, &keys, &values);
                    *kept = Some((keys, values));
                    let sum = g.add(&asking, &mixed);
                    let place = if which == "own" { 0 } else { 1 };
                    y = self.norm(g, &format!("decoder.{b}.norm.{place}"), &sum);
                }
                let fed = self.feed(g, &format!("decoder.{b}.mlp"), &y);
                let sum = g.add(&y, &fed);
                y = self.norm(g, &format!("decoder.{b}.norm.2"), &sum);
            }
            let logits = self.logits(g, &y);
            let chosen = self.one_hot(g, &logits);
            let begin = g.add(&begin, &nothing);
            token = g.concat(-1, &[&begin, &chosen]);
            all.push(logits);
        }
        let all: Vec<&str> = all.iter().map(String::as_str).collect();
        g.concat(1, &all)
    }

    fn logits(&self, g: &mut Builder, x: &str) -> Value {
        let wide = self.layer(g, "logits.wide", x);
        let wide = gelu(g, &wide);
        let normal = self.norm(g, "logits.norm", &wide);
        self.layer(g, "logits.out", &normal)
    }
}
