use super::matmul::{Activation, Packed, matmul, weight_gradient};
use super::operation::{Arg, Operation, apply3};
use candle_core::{Result, Shape, Tensor, bail};

/// y [.., n] = act(x [.., k] · w [k, n] + b `[n]`). With `constant_input` no gradient is computed for x: candle would
/// otherwise compute one even for observations.
pub fn linear(x: &Tensor, w: &Tensor, b: &Tensor, act: Activation, constant_input: bool) -> Result<Tensor> {
    apply3(Linear { act, constant_input }, [x, w, b])
}

struct Linear {
    act: Activation,
    constant_input: bool,
}

impl Operation<3> for Linear {
    const NAME: &'static str = "linear";

    fn forward(&self, [x, w, b]: [Arg<'_>; 3]) -> Result<(Vec<f32>, Shape)> {
        let ((m, width), (k, n)) = (x.rows(), w.rows());
        if w.dims.len() != 2 || width != k || b.dims != [n] {
            bail!("linear: x {:?}, w {:?}, b {:?} do not fit", x.dims, w.dims, b.dims);
        }
        let mut y = vec![0.0; m * n];
        matmul(x.values, &Packed::new(w.values, k, n), Some(b.values), self.act, &mut y);
        let outer = &x.dims[..x.dims.len() - 1];
        Ok((y, Shape::from([outer, &[n]].concat())))
    }

    fn backward(&self, [x, w, _]: [Arg<'_>; 3], y: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 3]> {
        let (k, n) = w.rows();
        let dz = self.act.backward(y, dy);
        let (dw, db) = weight_gradient(x.values, &dz, k, n);
        let dx = (!self.constant_input).then(|| {
            let mut dx = vec![0.0; x.values.len()];
            matmul(&dz, &Packed::transposed(w.values, k, n), None, Activation::Identity, &mut dx);
            dx
        });
        Ok([dx, Some(dw), Some(db)])
    }
}
