//! Layers as candle custom operations with hand-written gradients, and elementary functions with the same bits on every
//! machine. candle's generic operations give other bits to a row alone and in a batch (gemm), call the platform's libm
//! (exp, tanh), are several times slower on a CPU (the gradient of a bias alone costs more than its matrix product), or cut
//! the gradient silently (layer norm: huggingface/candle #2977, #3011, #2168; PR #3823 would mend it).
//! docs/dependencies.md lists why each operation is ours and when it may go.

mod action_log_probs;
mod elementwise;
mod graph;
mod gru;
mod linear;
mod matmul;
mod norm;
mod picks;
mod pool;
mod simd;

pub use action_log_probs::action_log_probs;
pub use elementwise::{exp, softmax, tanh};
pub use graph::{GraphBlock, GraphNoise, graph_block};
pub use gru::gru;
pub use linear::linear;
pub use matmul::Activation;
pub use norm::layer_norm;
pub(crate) use picks::{Mask, MaskedSoftmax};
pub use picks::{Pick, PickTable, pick_log_probs};
pub use pool::{mean_of_others, neighbour_pool};
pub(crate) use simd::{LANES, load};

use candle_core::{CpuStorage, Device, Layout, Result, Tensor, bail};

/// A tensor [rows, width] of numbers that need no gradient.
pub fn constant(values: impl Into<Vec<f32>>, width: usize) -> Result<Tensor> {
    let values = values.into();
    let rows = values.len() / width;
    Tensor::from_vec(values, (rows, width), &Device::Cpu)
}

/// The contiguous f32 slice behind a custom operation's argument.
fn slice<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    match layout.contiguous_offsets() {
        Some((start, end)) => Ok(&storage.as_slice::<f32>()?[start..end]),
        None => bail!("custom operations need contiguous tensors"),
    }
}

/// Copies a tensor's values out, in row-major order.
fn values(tensor: &Tensor) -> Result<Vec<f32>> {
    tensor.flatten_all()?.to_vec1::<f32>()
}

/// Lends a contiguous CPU tensor's values.
pub fn with_values<T>(tensor: &Tensor, f: impl FnOnce(&[f32]) -> T) -> Result<T> {
    let (storage, layout) = tensor.storage_and_layout();
    match &*storage {
        candle_core::Storage::Cpu(storage) => Ok(f(slice(storage, layout)?)),
        _ => bail!("the tensor is not on the CPU"),
    }
}

/// Rows of a tensor seen as [rows, last dimension].
fn rows(layout: &Layout) -> usize {
    let dims = layout.shape().dims();
    dims[..dims.len().saturating_sub(1)].iter().product()
}
