//! Layers as candle custom operations with hand-written gradients. candle's generic operations would be correct, but
//! several times slower on a CPU (the gradient of a bias alone costs more than its matrix product), and some of
//! candle-nn's fused layers cut the gradient silently.

mod action_log_probs;
mod elementwise;
mod graph;
mod gru;
mod linear;
mod norm;
mod picks;
mod pool;

pub use action_log_probs::action_log_probs;
pub use elementwise::{exp, softmax, tanh};
pub use graph::{GraphBlock, GraphNoise, graph_block};
pub use gru::gru;
pub use linear::linear;
pub use norm::layer_norm;
pub(crate) use picks::{MaskedSoftmax, Open};
pub use picks::{Pick, PickTable, pick_log_probs};
pub use pool::{mean_of_others, neighbour_pool};

use candle_core::{CpuStorage, Layout, Result, Tensor, bail};

/// The contiguous f32 slice behind a custom operation's argument.
fn slice<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    match layout.contiguous_offsets() {
        Some((start, end)) => Ok(&storage.as_slice::<f32>()?[start..end]),
        None => bail!("custom operations need contiguous tensors"),
    }
}

/// Copies a tensor's numbers out, in row-major order.
fn numbers(tensor: &Tensor) -> Result<Vec<f32>> {
    tensor.flatten_all()?.to_vec1::<f32>()
}

/// Lends a contiguous CPU tensor's numbers.
pub fn with_numbers<T>(tensor: &Tensor, f: impl FnOnce(&[f32]) -> T) -> Result<T> {
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
