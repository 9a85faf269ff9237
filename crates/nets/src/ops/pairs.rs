//! Two numbers at each place: what candle's own operations need ten to thirty passes for, most of them for gradients of constants.

use super::operation::{Arg, Operation, apply1, apply2};
use candle_core::{Result, Shape, Tensor, bail};

/// The smaller of two numbers; its gradient goes to that one, in halves if they are equal. NaN if one of them is.
pub fn minimum(a: &Tensor, b: &Tensor) -> Result<Tensor> {
    let value = |a: f32, b: f32| {
        if a < b {
            a
        } else if b <= a {
            b
        } else {
            a + b
        }
    };
    apply2(Pairs { value, slope: chosen, both: true }, [a, b])
}

/// The larger of two numbers, as [`minimum`].
pub fn maximum(a: &Tensor, b: &Tensor) -> Result<Tensor> {
    let value = |a: f32, b: f32| {
        if a > b {
            a
        } else if b >= a {
            b
        } else {
            a + b
        }
    };
    apply2(Pairs { value, slope: chosen, both: true }, [a, b])
}

/// x + numbers, which have no gradient.
pub fn plus(x: &Tensor, numbers: &Tensor) -> Result<Tensor> {
    apply2(Pairs { value: |x, number| x + number, slope: |_, _, _| 1.0, both: false }, [x, numbers])
}

/// x − numbers, which have no gradient.
pub fn minus(x: &Tensor, numbers: &Tensor) -> Result<Tensor> {
    apply2(Pairs { value: |x, number| x - number, slope: |_, _, _| 1.0, both: false }, [x, numbers])
}

/// x · numbers, which have no gradient.
pub fn times(x: &Tensor, numbers: &Tensor) -> Result<Tensor> {
    apply2(Pairs { value: |x, number| x * number, slope: |_, number, _| number, both: false }, [x, numbers])
}

/// Row `index` `[n]` of x [m, n].
pub fn row(x: &Tensor, index: usize) -> Result<Tensor> {
    apply1(Row(index), x)
}

/// Half a gradient for each of two equal numbers.
fn chosen(own: f32, other: f32, y: f32) -> f32 {
    if own != y {
        0.0
    } else if other == y {
        0.5
    } else {
        1.0
    }
}

/// A function of two numbers, its derivative in terms of one, the other and the result, and whether the second has a gradient.
struct Pairs<V, S> {
    value: V,
    slope: S,
    both: bool,
}

impl<V, S> Operation<2> for Pairs<V, S>
where
    V: Fn(f32, f32) -> f32 + Send + Sync + 'static,
    S: Fn(f32, f32, f32) -> f32 + Send + Sync + 'static,
{
    const NAME: &'static str = "pairs";

    fn forward(&self, [a, b]: [Arg<'_>; 2]) -> Result<(Vec<f32>, Shape)> {
        if a.dims != b.dims {
            bail!("pairs: shapes {:?} and {:?} differ", a.dims, b.dims);
        }
        Ok((a.values.iter().zip(b.values).map(|(a, b)| (self.value)(*a, *b)).collect(), Shape::from(a.dims)))
    }

    fn backward(&self, [a, b]: [Arg<'_>; 2], y: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 2]> {
        let part = |own: &[f32], other: &[f32]| {
            let triples = own.iter().zip(other).zip(y.iter().zip(dy));
            triples.map(|((own, other), (y, d))| d * (self.slope)(*own, *other, *y)).collect()
        };
        Ok([Some(part(a.values, b.values)), self.both.then(|| part(b.values, a.values))])
    }
}

struct Row(usize);

impl Operation<1> for Row {
    const NAME: &'static str = "row";

    fn forward(&self, [x]: [Arg<'_>; 1]) -> Result<(Vec<f32>, Shape)> {
        let (_, width) = x.rows();
        match x.values.chunks_exact(width.max(1)).nth(self.0) {
            Some(row) => Ok((row.to_vec(), Shape::from(width))),
            None => bail!("row {} of {:?}", self.0, x.dims),
        }
    }

    fn backward(&self, [x]: [Arg<'_>; 1], _: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 1]> {
        let mut dx = vec![0.0; x.values.len()];
        dx[self.0 * dy.len()..][..dy.len()].copy_from_slice(dy);
        Ok([Some(dx)])
    }
}
