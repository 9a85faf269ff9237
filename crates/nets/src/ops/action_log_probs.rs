use super::operation::{Arg, Operation, apply1};
use super::simd::load;
use crate::distribution::ActionHeads;
use candle_core::{Result, Shape, Tensor, bail};
use std::sync::OnceLock;

/// Log-probabilities and entropies of given actions: [2, R] from logits [R, A] and actions [R, H], both summed over the
/// components of an action. The log-probabilities have the bits of [`ActionHeads::choose`], so the first importance ratio
/// is exactly 1.
pub fn action_log_probs(logits: &Tensor, actions: Vec<u8>, heads: &ActionHeads) -> Result<Tensor> {
    apply1(ActionLogProbs { actions, heads: heads.clone(), saved: OnceLock::new() }, logits)
}

struct ActionLogProbs {
    actions: Vec<u8>,
    heads: ActionHeads,
    /// [R, 2A] log-probabilities and probabilities of every choice, for the gradient.
    saved: OnceLock<Vec<f32>>,
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
        let mut saved = vec![0.0; 2 * rows * width];
        let (log_probs_out, entropies) = out.split_at_mut(rows);
        for (((logits, action), saved), (log_prob, entropy)) in logits
            .values
            .chunks_exact(width)
            .zip(self.actions.chunks_exact(components))
            .zip(saved.chunks_exact_mut(2 * width))
            .zip(log_probs_out.iter_mut().zip(entropies))
        {
            let (log_probs, probs) = saved.split_at_mut(width);
            self.heads.log_softmax(logits, log_probs);
            let mut at = 0;
            for (&choice, &size) in action.iter().zip(self.heads.sizes()) {
                let head = at..at + size;
                let Some(chosen) = log_probs[head.clone()].get(usize::from(choice)) else {
                    bail!("action log-probs: choice {choice} of {size}");
                };
                *log_prob += chosen;
                probs[head.clone()].copy_from_slice(&load(&log_probs[head.clone()]).exp().to_array()[..size]);
                *entropy += head_entropy(&log_probs[head.clone()], &probs[head]);
                at += size;
            }
        }
        // Each call of `action_log_probs` makes its own operation: the cell is empty.
        let _ = self.saved.set(saved);
        Ok((out, Shape::from((2, rows))))
    }

    fn backward(&self, [logits]: [Arg<'_>; 1], _y: &[f32], upstream: &[f32]) -> Result<[Option<Vec<f32>>; 1]> {
        let (rows, width) = logits.rows();
        let Some(saved) = self.saved.get() else { bail!("action log-probs: gradient without forward") };
        let (d_log_probs, d_entropies) = upstream.split_at(rows);
        let mut gradient = vec![0.0; rows * width];
        for (((gradient, saved), action), (d_log_prob, d_entropy)) in gradient
            .chunks_exact_mut(width)
            .zip(saved.chunks_exact(2 * width))
            .zip(self.actions.chunks_exact(self.heads.count()))
            .zip(d_log_probs.iter().zip(d_entropies))
        {
            let (log_probs, probs) = saved.split_at(width);
            let mut at = 0;
            for (&choice, &size) in action.iter().zip(self.heads.sizes()) {
                let entropy = head_entropy(&log_probs[at..at + size], &probs[at..at + size]);
                for j in at..at + size {
                    gradient[j] = -probs[j] * (d_log_prob + d_entropy * (log_probs[j] + entropy));
                }
                gradient[at + usize::from(choice)] += d_log_prob;
                at += size;
            }
        }
        Ok([Some(gradient)])
    }
}

/// −Σ p ln p.
fn head_entropy(log_probs: &[f32], probs: &[f32]) -> f32 {
    -probs.iter().zip(log_probs).map(|(p, l)| p * l).sum::<f32>()
}
