//! Two numbers at each place: what candle's own operations need ten to thirty passes for, most of them for gradients of constants.

use super::operation::{Arg, Operation, apply1, apply2};
use candle_core::{Result, Shape, Tensor, bail};

/// The smaller of two numbers; its gradient goes to that one, in halves if they are equal.
pub fn minimum(a: &Tensor, b: &Tensor) -> Result<Tensor> {
    apply2(Pairs::Minimum, [a, b])
}

/// The larger of two numbers; its gradient goes to that one, in halves if they are equal.
pub fn maximum(a: &Tensor, b: &Tensor) -> Result<Tensor> {
    apply2(Pairs::Maximum, [a, b])
}

/// x + numbers, which have no gradient.
pub fn plus(x: &Tensor, numbers: &Tensor) -> Result<Tensor> {
    apply2(Pairs::Plus, [x, numbers])
}

/// x − numbers, which have no gradient.
pub fn minus(x: &Tensor, numbers: &Tensor) -> Result<Tensor> {
    apply2(Pairs::Minus, [x, numbers])
}

/// x · numbers, which have no gradient.
pub fn times(x: &Tensor, numbers: &Tensor) -> Result<Tensor> {
    apply2(Pairs::Times, [x, numbers])
}

/// Row `index` `[n]` of x [m, n].
pub fn row(x: &Tensor, index: usize) -> Result<Tensor> {
    apply1(Row(index), x)
}

enum Pairs {
    Minimum,
    Maximum,
    Plus,
    Minus,
    Times,
}

impl Operation<2> for Pairs {
    const NAME: &'static str = "pairs";

    fn forward(&self, [a, b]: [Arg<'_>; 2]) -> Result<(Vec<f32>, Shape)> {
        if a.dims != b.dims {
            bail!("pairs: shapes {:?} and {:?} differ", a.dims, b.dims);
        }
        let pairs = a.values.iter().zip(b.values);
        let y = match self {
            // A comparison with NaN is false; then the sum is NaN, too.
            Self::Minimum => pairs
                .map(|(&a, &b)| {
                    if a < b {
                        a
                    } else if b <= a {
                        b
                    } else {
                        a + b
                    }
                })
                .collect(),
            Self::Maximum => pairs
                .map(|(&a, &b)| {
                    if a > b {
                        a
                    } else if b >= a {
                        b
                    } else {
                        a + b
                    }
                })
                .collect(),
            Self::Plus => pairs.map(|(a, b)| a + b).collect(),
            Self::Minus => pairs.map(|(a, b)| a - b).collect(),
            Self::Times => pairs.map(|(a, b)| a * b).collect(),
        };
        Ok((y, Shape::from(a.dims)))
    }

    fn backward(&self, [a, b]: [Arg<'_>; 2], y: &[f32], dy: &[f32]) -> Result<[Option<Vec<f32>>; 2]> {
        // Half a gradient for each of two equal numbers.
        let part = |own: &[f32], other: &[f32]| {
            let triples = own.iter().zip(other).zip(y.iter().zip(dy));
            triples
                .map(|((o, other), (y, d))| {
                    if o != y {
                        0.0
                    } else if other == y {
                        0.5 * d
                    } else {
                        *d
                    }
                })
                .collect()
        };
        Ok(match self {
            Self::Minimum | Self::Maximum => [Some(part(a.values, b.values)), Some(part(b.values, a.values))],
            Self::Plus | Self::Minus => [Some(dy.to_vec()), None],
            Self::Times => [Some(b.values.iter().zip(dy).map(|(b, d)| b * d).collect()), None],
        })
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
