use super::operation::{Arg, Operation, apply1};
use crate::distribution::{entropy, log_density};
use candle_core::{Result, Shape, Tensor, bail};

/// Logarithms of densities and entropies of given actions of real numbers: [2, R] from outputs [R, 2C] (means, then logarithms of
/// standard deviations) and actions [R, C], both summed over the components. The first have the bits of
/// [`crate::distribution::ActionHeads::draw`].
pub fn action_log_densities(outputs: &Tensor, moves: Vec<f32>) -> Result<Tensor> {
    apply1(ActionLogDensities { moves }, outputs)
}

struct ActionLogDensities {
    moves: Vec<f32>,
}

impl Operation<1> for ActionLogDensities {
    const NAME: &'static str = "action-log-densities";

    fn forward(&self, [outputs]: [Arg<'_>; 1]) -> Result<(Vec<f32>, Shape)> {
        let (rows, width) = outputs.rows();
        if self.moves.len() * 2 != rows * width {
            bail!("action log-densities: {} numbers and outputs [{rows}, {width}] do not fit", self.moves.len());
        }
        let mut out = vec![0.0; 2 * rows];
        let (log_probs, entropies) = out.split_at_mut(rows);
        let rows_of = outputs.values.chunks_exact(width).zip(self.moves.chunks_exact(width / 2));
        for ((outputs, moves), (log_prob, sum)) in rows_of.zip(log_probs.iter_mut().zip(entropies)) {
            let (means, log_deviations) = outputs.split_at(width / 2);
            *log_prob = log_density(means, log_deviations, moves);
            *sum = entropy(log_deviations);
        }
        Ok((out, Shape::from((2, rows))))
    }

    fn backward(&self, [outputs]: [Arg<'_>; 1], _y: &[f32], upstream: &[f32]) -> Result<[Option<Vec<f32>>; 1]> {
        let (rows, width) = outputs.rows();
        let components = width / 2;
        let (d_log_probs, d_entropies) = upstream.split_at(rows);
        let mut gradient = vec![0.0; rows * width];
        for (row, gradient) in gradient.chunks_exact_mut(width).enumerate() {
            let (means, log_deviations) = outputs.values[row * width..(row + 1) * width].split_at(components);
            let (d_means, d_log_deviations) = gradient.split_at_mut(components);
            let (d_log_prob, d_entropy) = (d_log_probs[row], d_entropies[row]);
            for (c, u) in self.moves[row * components..(row + 1) * components].iter().enumerate() {
                let inverse = libm::expf(-log_deviations[c]);
                let z = (u - means[c]) * inverse;
                d_means[c] = d_log_prob * z * inverse;
                d_log_deviations[c] = d_log_prob * (z * z - 1.0) + d_entropy;
            }
        }
        Ok([Some(gradient)])
    }
}
