//! Layers, memory and head as one operation: between operations the tensor library sets the gradient of every number to zero and adds
//! to it, and with a memory these numbers do not fit into the caches.

use super::buffer::Buffer;
use super::operation::{Arg, Operation, apply3};
use super::{Chain, Gru, chain, gru, with_values};
use crate::features::Features;
use candle_core::{Device, Result, Shape, Tensor, bail};
use std::sync::{Arc, OnceLock};

/// head(memory(first(features))), or head(memory(x)) if the layers before were an operation of their own: outputs [L·R, n] and states
/// [L·R, H], which have no gradient. What `h0` and `firsts` are, [`Gru::forward`] says.
pub fn recurrent(
    (before, gru, head): (Before<'_>, &Gru, &Chain),
    features: &Arc<Features>,
    h0: Vec<f32>,
    firsts: Vec<u8>,
) -> Result<(Tensor, Tensor)> {
    let (first, x) = match before {
        Before::Layers(chain) => (Some(chain.operation(features, false)), chain.parameters()),
        Before::Rows(x) => (None, x),
    };
    let gru_op = gru.operation(h0, firsts, x.track_op());
    let head_op = head.operation(features, x.track_op() || gru.parameters().track_op());
    let states = Arc::new(OnceLock::new());
    let op = Op { first, gru: gru_op, head: head_op, inputs: OnceLock::new(), states: states.clone() };
    let out = apply3(op, [x, gru.parameters(), head.parameters()])?;
    match states.get() {
        Some(states) => Ok((out, states.clone())),
        None => bail!("recurrent: no states"),
    }
}

/// What comes before a memory.
pub enum Before<'a> {
    /// Layers of features.
    Layers(&'a Chain),
    /// Rows [L·R, I].
    Rows(&'a Tensor),
}

struct Op {
    first: Option<chain::Op>,
    gru: gru::Op,
    head: chain::Op,
    /// [L·R, I] what the first layers gave.
    inputs: OnceLock<(Vec<f32>, Shape)>,
    /// [L·R, H]
    states: Arc<OnceLock<Tensor>>,
}

impl Op {
    fn inputs<'a>(&'a self, x: Arg<'a>) -> Arg<'a> {
        self.inputs.get().map_or(x, |(values, shape)| Arg { values, dims: shape.dims() })
    }
}

impl Operation<3> for Op {
    const NAME: &'static str = "recurrent";

    fn forward(&self, [x, of_gru, of_head]: [Arg<'_>; 3]) -> Result<(Vec<f32>, Shape)> {
        if let Some(first) = &self.first {
            let inputs = first.forward([x])?;
            self.inputs.get_or_init(|| inputs);
        }
        let (states, shape) = self.gru.forward([self.inputs(x), of_gru])?;
        let out = self.head.forward([Arg { values: &states, dims: shape.dims() }, of_head])?;
        let states = Tensor::from_vec(states, shape, &Device::Cpu)?;
        self.states.get_or_init(|| states);
        Ok(out)
    }

    fn backward(&self, [x, of_gru, of_head]: [Arg<'_>; 3], y: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 3]> {
        let Some(states) = self.states.get() else { bail!("recurrent: gradient without forward") };
        let inputs = self.inputs(x);
        with_values(states, |values| {
            let (mut d_states, mut d_inputs) = (Buffer::take(values.len()), Buffer::take(inputs.values.len()));
            let of_head = (Some(Arg { values, dims: states.dims() }), of_head.values);
            let d_head = self.head.gradients(of_head, y, dy, &mut d_states)?;
            let d_gru = self.gru.gradients([inputs, of_gru], values, &d_states, &mut d_inputs)?;
            let d_first = match &self.first {
                Some(first) => first.gradients((None, x.values), inputs.values, &d_inputs, &mut [])?,
                None => d_inputs.to_vec(),
            };
            Ok([Some(d_first), Some(d_gru), Some(d_head)])
        })?
    }
}
