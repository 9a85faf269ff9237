use super::operation::{Arg, Operation, apply1, apply3};
use super::simd::{LANES, load, sum};
use candle_core::{Result, Shape, Tensor, bail};
use wide::f32x16;

/// y [S, E] with y_e = b_e + Σ_i x_i w_ie, every row with weights of its own: x [S, N], w [S, N·E], b [S, E]. The layers of a mixing
/// network, whose weights another network computes.
pub fn mix(x: &Tensor, w: &Tensor, b: &Tensor) -> Result<Tensor> {
    apply3(Mix, [x, w, b])
}

/// ‖x_r − x_o(r)‖₂ of row r and row o(r) of x [R, A], `[R]`. The gradient at a distance of zero is zero.
pub fn row_distances(x: &Tensor, others: Vec<usize>) -> Result<Tensor> {
    apply1(RowDistances { others }, x)
}

struct Mix;

impl Mix {
    /// S, N and E.
    fn sizes([x, w, b]: [&Arg<'_>; 3]) -> Result<(usize, usize, usize)> {
        let ((rows, inputs), (_, units)) = (x.rows(), b.rows());
        if w.dims != [rows, inputs * units] || b.dims != [rows, units] || x.dims != [rows, inputs] {
            bail!("mix: x {:?}, w {:?}, b {:?} do not fit", x.dims, w.dims, b.dims);
        }
        Ok((rows, inputs, units))
    }
}

impl Operation<3> for Mix {
    const NAME: &'static str = "mix";

    fn forward(&self, [x, w, b]: [Arg<'_>; 3]) -> Result<(Vec<f32>, Shape)> {
        let (rows, inputs, units) = Self::sizes([&x, &w, &b])?;
        let mut y = b.values.to_vec();
        for r in 0..rows {
            let (x, w) = (&x.values[r * inputs..][..inputs], &w.values[r * inputs * units..][..inputs * units]);
            let y = &mut y[r * units..][..units];
            for (&x, w) in x.iter().zip(w.chunks_exact(units)) {
                y.iter_mut().zip(w).for_each(|(y, &w)| *y = x.mul_add(w, *y));
            }
        }
        Ok((y, Shape::from(b.dims)))
    }

    fn backward(&self, [x, w, b]: [Arg<'_>; 3], _: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 3]> {
        let (rows, inputs, units) = Self::sizes([&x, &w, &b])?;
        let (mut dx, mut dw) = (vec![0.0; rows * inputs], vec![0.0; rows * inputs * units]);
        for r in 0..rows {
            let dy = &dy[r * units..][..units];
            for i in 0..inputs {
                let at = (r * inputs + i) * units;
                dx[r * inputs + i] = dot(dy, &w.values[at..at + units]);
                let x = x.values[r * inputs + i];
                dw[at..at + units].iter_mut().zip(dy).for_each(|(dw, &dy)| *dw = x * dy);
            }
        }
        Ok([Some(dx), Some(dw), Some(dy.to_vec())])
    }
}

/// Σ a b in an order that is the same on every machine.
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut total = f32x16::ZERO;
    for (a, b) in a.chunks(LANES).zip(b.chunks(LANES)) {
        total = load(a).mul_add(load(b), total);
    }
    sum(total)
}

struct RowDistances {
    others: Vec<usize>,
}

impl Operation<1> for RowDistances {
    const NAME: &'static str = "row_distances";

    fn forward(&self, [x]: [Arg<'_>; 1]) -> Result<(Vec<f32>, Shape)> {
        let (rows, width) = x.rows();
        if self.others.len() != rows || self.others.iter().any(|&other| other >= rows) {
            bail!("row_distances: {} indices for {rows} rows", self.others.len());
        }
        let row = |r: usize| &x.values[r * width..][..width];
        let mut difference = vec![0.0; width];
        let distance = |(r, &other): (usize, &usize)| {
            difference.iter_mut().zip(row(r).iter().zip(row(other))).for_each(|(d, (a, b))| *d = a - b);
            dot(&difference, &difference).sqrt()
        };
        Ok((self.others.iter().enumerate().map(distance).collect(), Shape::from(rows)))
    }

    fn backward(&self, [x]: [Arg<'_>; 1], y: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 1]> {
        let width = x.rows().1;
        let mut dx = vec![0.0; x.values.len()];
        let mut unit = vec![0.0; width];
        for (r, &other) in self.others.iter().enumerate() {
            if y[r] == 0.0 {
                continue;
            }
            let scale = dy[r] / y[r];
            for (k, unit) in unit.iter_mut().enumerate() {
                *unit = scale * (x.values[r * width + k] - x.values[other * width + k]);
            }
            dx[r * width..][..width].iter_mut().zip(&unit).for_each(|(dx, unit)| *dx += unit);
            dx[other * width..][..width].iter_mut().zip(&unit).for_each(|(dx, unit)| *dx -= unit);
        }
        Ok([Some(dx)])
    }
}
