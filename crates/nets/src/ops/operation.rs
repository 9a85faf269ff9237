//! Custom operations of candle in terms of slices.

use candle_core::{CpuStorage, CustomOp1, CustomOp2, CustomOp3, Layout, Result, Shape, Storage, Tensor, bail};

/// A contiguous argument of an operation.
#[derive(Clone, Copy, Default)]
pub(super) struct Arg<'a> {
    pub(super) values: &'a [f32],
    pub(super) dims: &'a [usize],
}

impl<'a> Arg<'a> {
    pub(super) fn of(storage: &'a CpuStorage, layout: &'a Layout) -> Result<Self> {
        match layout.contiguous_offsets() {
            Some((start, end)) => Ok(Self { values: &storage.as_slice::<f32>()?[start..end], dims: layout.dims() }),
            None => bail!("custom operations need contiguous tensors"),
        }
    }

    /// Of a tensor's parts.
    pub(super) fn lent(storage: &'a Storage, layout: &'a Layout) -> Result<Self> {
        match storage {
            Storage::Cpu(storage) => Self::of(storage, layout),
            _ => bail!("the tensor is not on the CPU"),
        }
    }

    /// Rows of the argument seen as [rows, last dimension], and that dimension.
    pub(super) fn rows(&self) -> (usize, usize) {
        let width = self.dims.last().copied().unwrap_or(0);
        (self.dims[..self.dims.len().saturating_sub(1)].iter().product(), width)
    }
}

/// An operation on N tensors with a hand-written gradient.
pub(super) trait Operation<const N: usize>: Send + Sync + 'static {
    const NAME: &'static str;

    /// The numbers and the shape of the result.
    fn forward(&self, args: [Arg<'_>; N]) -> Result<(Vec<f32>, Shape)>;

    /// The gradients of the arguments, given the result and its gradient; `None` for those that need none.
    fn backward(&self, args: [Arg<'_>; N], y: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; N]>;
}

/// Applies an operation; the first argument is made contiguous, others are.
pub(super) fn apply1(operation: impl Operation<1>, x: &Tensor) -> Result<Tensor> {
    x.contiguous()?.apply_op1(Custom(operation))
}

/// The same for two arguments.
pub(super) fn apply2(operation: impl Operation<2>, [x, b]: [&Tensor; 2]) -> Result<Tensor> {
    x.contiguous()?.apply_op2(b, Custom(operation))
}

/// The same for three arguments.
pub(super) fn apply3(operation: impl Operation<3>, [x, b, c]: [&Tensor; 3]) -> Result<Tensor> {
    x.contiguous()?.apply_op3(b, c, Custom(operation))
}

/// An operation as candle sees it.
struct Custom<O>(O);

impl<O: Operation<1>> CustomOp1 for Custom<O> {
    fn name(&self) -> &'static str {
        O::NAME
    }

    fn cpu_fwd(&self, x: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let (y, shape) = self.0.forward([Arg::of(x, layout)?])?;
        Ok((CpuStorage::F32(y), shape))
    }

    fn bwd(&self, x: &Tensor, y: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
        let [dx] = gradients(&self.0, [x], y, dy)?;
        Ok(dx)
    }
}

impl<O: Operation<2>> CustomOp2 for Custom<O> {
    fn name(&self) -> &'static str {
        O::NAME
    }

    fn cpu_fwd(&self, a: &CpuStorage, la: &Layout, b: &CpuStorage, lb: &Layout) -> Result<(CpuStorage, Shape)> {
        let (y, shape) = self.0.forward([Arg::of(a, la)?, Arg::of(b, lb)?])?;
        Ok((CpuStorage::F32(y), shape))
    }

    fn bwd(&self, a: &Tensor, b: &Tensor, y: &Tensor, dy: &Tensor) -> Result<(Option<Tensor>, Option<Tensor>)> {
        Ok(gradients(&self.0, [a, b], y, dy)?.into())
    }
}

impl<O: Operation<3>> CustomOp3 for Custom<O> {
    fn name(&self) -> &'static str {
        O::NAME
    }

    fn cpu_fwd(
        &self,
        a: &CpuStorage,
        la: &Layout,
        b: &CpuStorage,
        lb: &Layout,
        c: &CpuStorage,
        lc: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (y, shape) = self.0.forward([Arg::of(a, la)?, Arg::of(b, lb)?, Arg::of(c, lc)?])?;
        Ok((CpuStorage::F32(y), shape))
    }

    fn bwd(&self, a: &Tensor, b: &Tensor, c: &Tensor, y: &Tensor, dy: &Tensor) -> Result<Gradients> {
        Ok(gradients(&self.0, [a, b, c], y, dy)?.into())
    }
}

type Gradients = (Option<Tensor>, Option<Tensor>, Option<Tensor>);

fn gradients<const N: usize, O: Operation<N>>(
    operation: &O,
    tensors: [&Tensor; N],
    y: &Tensor,
    dy: &Tensor,
) -> Result<[Option<Tensor>; N]> {
    let dy = dy.contiguous()?;
    let (lent, y, dy) = (tensors.map(Tensor::storage_and_layout), y.storage_and_layout(), dy.storage_and_layout());
    let mut args = [Arg::default(); N];
    for (arg, (storage, layout)) in args.iter_mut().zip(&lent) {
        *arg = Arg::lent(storage, layout)?;
    }
    let found = operation.backward(args, Arg::lent(&y.0, y.1)?.values, Arg::lent(&dy.0, dy.1)?.values)?;
    let mut gradients = [const { None }; N];
    for ((gradient, found), tensor) in gradients.iter_mut().zip(found).zip(tensors) {
        *gradient = found.map(|found| Tensor::from_vec(found, tensor.shape(), tensor.device())).transpose()?;
    }
    Ok(gradients)
}
