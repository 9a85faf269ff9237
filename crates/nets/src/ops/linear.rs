use super::buffer::Buffer;
use super::chain::{TILE, slopes};
use super::gradient::Gradient;
use super::matmul::{Activation, Packed, Rows, Start, layer, matmul};
use super::operation::{Arg, Operation, apply3};
use super::simd::LANES;
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
        let ((rows, _), (k, n)) = (x.rows(), w.rows());
        let stride = n.next_multiple_of(LANES);
        let mut dz = Buffer::take(TILE * stride);
        dz.fill(0.0);
        let mut gradient = Gradient::new(k, n);
        let transposed = (!self.constant_input).then(|| Packed::transposed(w.values, k, n));
        let mut dx = transposed.as_ref().map(|_| vec![0.0; x.values.len()]);
        for from in (0..rows).step_by(TILE) {
            let count = TILE.min(rows - from);
            let (these, to) = (from * n..(from + count) * n, from + count);
            slopes(self.act, &y[these.clone()], &dy[these], n, &mut dz, stride);
            let dz = Rows::new(&dz, stride);
            gradient.add(Rows::new(&x.values[from * k..to * k], k), dz, count);
            if let (Some(dx), Some(w)) = (&mut dx, &transposed) {
                layer(dz, w, Start::Zero, Activation::Identity, &mut dx[from * k..to * k], k, count);
            }
        }
        let (mut dw, mut db) = (vec![0.0; k * n], vec![0.0; n]);
        gradient.write(&mut dw, Some(&mut db));
        Ok([dx, Some(dw), Some(db)])
    }
}
