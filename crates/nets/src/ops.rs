//! Layers as candle custom operations with hand-written gradients, and elementary functions with the same bits on every
//! machine. candle's generic operations give other bits to a row alone and in a batch (gemm), call the platform's libm
//! (exp, tanh), are several times slower on a CPU (the gradient of a bias alone costs more than its matrix product), or cut
//! the gradient silently (layer norm: huggingface/candle #2977, #3011, #2168; PR #3823 would mend it).
//! docs/dependencies.md lists why each operation is ours and when it may go.

mod action_log_densities;
mod action_log_probs;
mod attention;
mod buffer;
mod chain;
mod elementwise;
mod gradient;
mod graph;
mod gru;
mod linear;
mod matmul;
mod mixing;
mod norm;
mod operation;
mod pairs;
mod picks;
mod pool;
mod recurrent;
mod simd;

pub use action_log_densities::action_log_densities;
pub use action_log_probs::action_log_probs;
pub use attention::{Attention, attention};
pub(crate) use attention::{Keys, attend};
pub use chain::{Chain, ChainBuilder, Field};
pub(crate) use elementwise::gelu_in_place;
pub use elementwise::{clamp, elu, exp, gelu, huber, softmax, tanh};
pub use graph::{GraphBlock, GraphNoise, graph_block};
pub use gru::Gru;
pub use linear::linear;
pub use matmul::Activation;
pub(crate) use matmul::{Packed, matmul};
pub use mixing::{mix, row_distances};
pub use norm::layer_norm;
pub(crate) use norm::layer_norm_in_place;
pub use pairs::{maximum, minimum, minus, plus, row, times};
pub(crate) use picks::{Mask, MaskedSoftmax};
pub use picks::{Pick, PickTable, pick_log_probs};
pub use pool::with_mean_of_others;
pub use recurrent::{Before, recurrent};
pub(crate) use simd::{LANES, exp_of_negative, load};

use candle_core::{Device, Result, Tensor};

/// A tensor [rows, width] of numbers that need no gradient.
pub fn constant(values: impl Into<Vec<f32>>, width: usize) -> Result<Tensor> {
    let values = values.into();
    let rows = values.len() / width;
    Tensor::from_vec(values, (rows, width), &Device::Cpu)
}

/// Lends a contiguous CPU tensor's values.
pub fn with_values<T>(tensor: &Tensor, f: impl FnOnce(&[f32]) -> T) -> Result<T> {
    let (storage, layout) = tensor.storage_and_layout();
    Ok(f(operation::Arg::lent(&storage, layout)?.values))
}
