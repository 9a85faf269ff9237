use super::operation::{Arg, Operation, apply1};
use super::simd::{LANES, exp_of_negative, load};
use crate::distribution::{ActionHeads, log_softmax_of_rows};
use candle_core::{Result, Shape, Tensor, bail};
use std::sync::OnceLock;
use wide::f32x16;

/// Log-probabilities and entropies of given actions: [2, R] from logits [R, A] and actions [R, H], both summed over the
/// components of an action. The log-probabilities have the bits of [`ActionHeads::choose`], so the first importance ratio
/// is exactly 1.
pub fn action_log_probs(logits: &Tensor, actions: Vec<u8>, heads: &ActionHeads) -> Result<Tensor> {
    apply1(ActionLogProbs { actions, heads: heads.clone(), saved: OnceLock::new() }, logits)
}

struct ActionLogProbs {
    actions: Vec<u8>,
    heads: ActionHeads,
    /// [R / 16, A + H] log-probabilities of every choice and entropy of every component, sixteen rows in a vector.
    saved: OnceLock<Vec<f32x16>>,
}

impl ActionLogProbs {
    /// Where each component's choices begin, and how many it has.
    fn parts(&self) -> impl Iterator<Item = (usize, usize)> {
        self.heads.sizes().iter().scan(0, |at, &size| {
            *at += size;
            Some((*at - size, size))
        })
    }
}

impl Operation<1> for ActionLogProbs {
    const NAME: &'static str = "action-log-probs";

    fn forward(&self, [logits]: [Arg<'_>; 1]) -> Result<(Vec<f32>, Shape)> {
        let (rows, width) = logits.rows();
        let components = self.heads.count();
        if width != self.heads.logits() || self.actions.len() != rows * components {
            bail!("action log-probs: {} actions and logits [{rows}, {width}] do not fit", self.actions.len());
        }
        let mut out = vec![0.0; 2 * rows];
        let (log_probs_out, entropies_out) = out.split_at_mut(rows);
        let mut saved = vec![f32x16::ZERO; rows.div_ceil(LANES) * (width + components)];
        let mut lanes = vec![[0.0f32; LANES]; width];
        for (((logits, actions), saved), (log_probs_out, entropies_out)) in logits
            .values
            .chunks(LANES * width)
            .zip(self.actions.chunks(LANES * components))
            .zip(saved.chunks_exact_mut(width + components))
            .zip(log_probs_out.chunks_mut(LANES).zip(entropies_out.chunks_mut(LANES)))
        {
            for (row, logits) in logits.chunks_exact(width).enumerate() {
                lanes.iter_mut().zip(logits).for_each(|(column, logit)| column[row] = *logit);
            }
            let (log_probs, entropies) = saved.split_at_mut(width);
            log_probs.iter_mut().zip(&lanes).for_each(|(column, lanes)| *column = f32x16::new(*lanes));
            let mut total = f32x16::ZERO;
            for ((at, size), entropy) in self.parts().zip(entropies) {
                let head = &mut log_probs[at..at + size];
                log_softmax_of_rows(head);
                let sum = head.iter().fold(f32x16::ZERO, |sum, x| sum + exp_of_negative(*x) * *x);
                *entropy = -sum;
                total += *entropy;
            }
            entropies_out.copy_from_slice(&total.to_array()[..entropies_out.len()]);
            lanes.iter_mut().zip(log_probs).for_each(|(lanes, column)| *lanes = column.to_array());
            for (row, (action, out)) in actions.chunks_exact(components).zip(log_probs_out).enumerate() {
                for (&choice, (at, size)) in action.iter().zip(self.parts()) {
                    let choice = usize::from(choice);
                    if choice >= size {
                        bail!("action log-probs: choice {choice} of {size}");
                    }
                    *out += lanes[at + choice][row];
                }
            }
        }
        // Each call of `action_log_probs` makes its own operation: the cell is empty.
        let _ = self.saved.set(saved);
        Ok((out, Shape::from((2, rows))))
    }

    fn backward(&self, [logits]: [Arg<'_>; 1], _y: &[f32], upstream: &[f32]) -> Result<[Option<Vec<f32>>; 1]> {
        let (rows, width) = logits.rows();
        let components = self.heads.count();
        let Some(saved) = self.saved.get() else { bail!("action log-probs: gradient without forward") };
        let (d_log_probs, d_entropies) = upstream.split_at(rows);
        let mut gradient = vec![0.0; rows * width];
        for (((gradient, saved), actions), (d_log_probs, d_entropies)) in gradient
            .chunks_mut(LANES * width)
            .zip(saved.chunks_exact(width + components))
            .zip(self.actions.chunks(LANES * components))
            .zip(d_log_probs.chunks(LANES).zip(d_entropies.chunks(LANES)))
        {
            let (log_probs, entropies) = saved.split_at(width);
            let (d_log_prob, d_entropy) = (load(d_log_probs), load(d_entropies));
            for ((at, size), entropy) in self.parts().zip(entropies) {
                for (j, x) in log_probs[at..at + size].iter().enumerate() {
                    let d = -exp_of_negative(*x) * (d_log_prob + d_entropy * (*x + *entropy));
                    gradient[at + j..].iter_mut().step_by(width).zip(d.to_array()).for_each(|(out, d)| *out = d);
                }
            }
            let rows = gradient.chunks_exact_mut(width).zip(actions.chunks_exact(components)).zip(d_log_probs);
            for ((gradient, action), d_log_prob) in rows {
                for (&choice, (at, _)) in action.iter().zip(self.parts()) {
                    gradient[at + usize::from(choice)] += d_log_prob;
                }
            }
        }
        Ok([Some(gradient)])
    }
}
