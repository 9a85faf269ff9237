//! The two loss functions of MAPPO as candle operations with hand-written gradients: one pass over the rows computes the
//! loss, its statistics and the gradient with respect to logits or values.

use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor, bail};
use magex_nets::distribution::ActionHeads;
use std::sync::{Arc, Mutex, PoisonError};

/// What the policy loss saw, summed over rows.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PolicyStats {
    /// Σ surrogate loss.
    pub loss: f64,
    /// Σ entropy.
    pub entropy: f64,
    /// Rows whose ratio was outside 1 ± ε.
    pub clipped: f64,
    /// Σ (ρ − 1 − ln ρ), an estimate of the divergence from the old policy.
    pub divergence: f64,
    /// max |ρ − 1|.
    pub ratio_error: f64,
    /// Rows.
    pub rows: f64,
}

/// Data of the rows of a minibatch shard.
#[derive(Debug, Clone)]
pub struct PolicyRows {
    /// [R, H]
    pub actions: Vec<u8>,
    /// `[R]` log-probability under the policy that acted.
    pub old_log_probs: Vec<f32>,
    /// `[R]` normalised advantages.
    pub advantages: Vec<f32>,
}

/// Scalar Σ_rows [ −min(ρ A, clip(ρ, 1 ± ε) A) − c H ] · scale, with ρ = exp(ln π − ln π_old) of the whole action of one
/// agent, and H the entropy summed over the action's components. `scale` is 1 / rows of the whole minibatch, so that
/// shards add up.
pub fn policy_loss(
    logits: &Tensor,
    rows: PolicyRows,
    heads: &ActionHeads,
    clip: f32,
    entropy: f32,
    scale: f32,
) -> Result<(Tensor, PolicyStats)> {
    let saved = Arc::new(Mutex::new((Vec::new(), PolicyStats::default())));
    let op = PolicyLoss { rows, heads: heads.clone(), clip, entropy, scale, saved: saved.clone() };
    let loss = logits.apply_op1(op)?;
    let stats = saved.lock().unwrap_or_else(PoisonError::into_inner).1;
    Ok((loss, stats))
}

struct PolicyLoss {
    rows: PolicyRows,
    heads: ActionHeads,
    clip: f32,
    entropy: f32,
    scale: f32,
    /// Gradient of the loss with respect to the logits, and statistics.
    saved: Arc<Mutex<(Vec<f32>, PolicyStats)>>,
}

impl CustomOp1 for PolicyLoss {
    fn name(&self) -> &'static str {
        "ppo-policy-loss"
    }

    fn cpu_fwd(&self, logits: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let (count, width) = layout.shape().dims2()?;
        let heads = self.heads.count();
        let Some((start, end)) = layout.contiguous_offsets() else { bail!("policy loss needs contiguous logits") };
        let logits = &logits.as_slice::<f32>()?[start..end];
        let rows = &self.rows;
        if width != self.heads.logits()
            || rows.actions.len() != count * heads
            || rows.old_log_probs.len() != count
            || rows.advantages.len() != count
        {
            bail!("policy loss: {count} rows of {width} logits do not fit the data");
        }
        let mut gradient = vec![0.0; count * width];
        let mut stats = PolicyStats { rows: count as f64, ..PolicyStats::default() };
        let mut total = 0.0f64;
        let mut log_probs = vec![0.0; width];
        for r in 0..count {
            self.heads.log_softmax(&logits[r * width..(r + 1) * width], &mut log_probs);
            let action = &rows.actions[r * heads..(r + 1) * heads];
            let mut at = 0;
            let mut log_prob = 0.0;
            for (&a, &size) in action.iter().zip(self.heads.sizes()) {
                log_prob += log_probs[at + usize::from(a)];
                at += size;
            }
            let difference = log_prob - rows.old_log_probs[r];
            let ratio = libm::expf(difference);
            let advantage = rows.advantages[r];
            let plain = ratio * advantage;
            let clipped = ratio.clamp(1.0 - self.clip, 1.0 + self.clip) * advantage;
            // The minimum's gradient: through the ratio where the plain term is the smaller one, nothing otherwise.
            let d_log_prob = if plain <= clipped { -plain } else { 0.0 };
            let d = &mut gradient[r * width..(r + 1) * width];
            let mut entropy = 0.0;
            let mut at = 0;
            for (&a, &size) in action.iter().zip(self.heads.sizes()) {
                let (lp, d) = (&log_probs[at..at + size], &mut d[at..at + size]);
                let mut probabilities = [0.0f32; 16];
                let mut h = 0.0;
                for (p, l) in probabilities.iter_mut().zip(lp) {
                    *p = libm::expf(*l);
                    h -= *p * l;
                }
                for j in 0..size {
                    let p = probabilities[j];
                    let chosen = if j == usize::from(a) { 1.0 } else { 0.0 };
                    d[j] = self.scale * (d_log_prob * (chosen - p) + self.entropy * p * (lp[j] + h));
                }
                entropy += h;
                at += size;
            }
            let loss = -plain.min(clipped);
            total += f64::from(loss - self.entropy * entropy);
            stats.loss += f64::from(loss);
            stats.entropy += f64::from(entropy);
            stats.clipped += if (ratio - 1.0).abs() > self.clip { 1.0 } else { 0.0 };
            stats.divergence += f64::from(ratio - 1.0 - difference);
            stats.ratio_error = stats.ratio_error.max(f64::from((ratio - 1.0).abs()));
        }
        *self.saved.lock().unwrap_or_else(PoisonError::into_inner) = (gradient, stats);
        Ok((CpuStorage::F32(vec![(total * f64::from(self.scale)) as f32]), Shape::from(())))
    }

    fn bwd(&self, logits: &Tensor, _loss: &Tensor, upstream: &Tensor) -> Result<Option<Tensor>> {
        gradient(&self.saved.lock().unwrap_or_else(PoisonError::into_inner).0, logits, upstream)
    }
}

/// The saved gradient times the upstream scalar.
fn gradient(saved: &[f32], input: &Tensor, upstream: &Tensor) -> Result<Option<Tensor>> {
    let factor = upstream.to_scalar::<f32>()?;
    let numbers = saved.iter().map(|g| g * factor).collect();
    Ok(Some(Tensor::from_vec(numbers, input.shape(), input.device())?))
}

/// Data of the rows of a minibatch shard.
#[derive(Debug, Clone)]
pub struct ValueRows {
    /// `[R]` values under the old critic, in normalised units.
    pub old_values: Vec<f32>,
    /// `[R]` returns in normalised units (with the statistics of this minibatch).
    pub targets: Vec<f32>,
}

/// Scalar Σ_rows max( hub(y − V_c), hub(y − V) ) · scale with V_c = V_old + clip(V − V_old, ± ε) and
/// hub(e) = e²/2 for |e| ≤ δ, δ (|e| − δ/2) beyond. All in normalised units. Returns the loss and its unscaled sum.
pub fn value_loss(values: &Tensor, rows: ValueRows, clip: f32, delta: f32, scale: f32) -> Result<(Tensor, f64)> {
    let saved = Arc::new(Mutex::new((Vec::new(), 0.0)));
    let loss = values.apply_op1(ValueLoss { rows, clip, delta, scale, saved: saved.clone() })?;
    let sum = saved.lock().unwrap_or_else(PoisonError::into_inner).1;
    Ok((loss, sum))
}

struct ValueLoss {
    rows: ValueRows,
    clip: f32,
    delta: f32,
    scale: f32,
    saved: Arc<Mutex<(Vec<f32>, f64)>>,
}

impl ValueLoss {
    /// Huber loss and its derivative with respect to the error.
    fn huber(&self, e: f32) -> (f32, f32) {
        if e.abs() <= self.delta {
            (0.5 * e * e, e)
        } else {
            (self.delta * (e.abs() - 0.5 * self.delta), self.delta * e.signum())
        }
    }
}

impl CustomOp1 for ValueLoss {
    fn name(&self) -> &'static str {
        "ppo-value-loss"
    }

    fn cpu_fwd(&self, values: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let count = layout.shape().elem_count();
        let Some((start, end)) = layout.contiguous_offsets() else { bail!("value loss needs contiguous values") };
        let values = &values.as_slice::<f32>()?[start..end];
        if self.rows.old_values.len() != count || self.rows.targets.len() != count {
            bail!("value loss: {count} values do not fit the data");
        }
        let mut gradient = vec![0.0; count];
        let mut total = 0.0f64;
        for (((d, &v), &old), &y) in gradient.iter_mut().zip(values).zip(&self.rows.old_values).zip(&self.rows.targets)
        {
            let moved = v - old;
            let (plain, d_plain) = self.huber(y - v);
            let (clipped, d_clipped) = self.huber(y - (old + moved.clamp(-self.clip, self.clip)));
            let (loss, slope) = if clipped > plain {
                (clipped, if moved.abs() <= self.clip { d_clipped } else { 0.0 })
            } else {
                (plain, d_plain)
            };
            *d = -slope * self.scale;
            total += f64::from(loss);
        }
        *self.saved.lock().unwrap_or_else(PoisonError::into_inner) = (gradient, total);
        Ok((CpuStorage::F32(vec![(total * f64::from(self.scale)) as f32]), Shape::from(())))
    }

    fn bwd(&self, values: &Tensor, _loss: &Tensor, upstream: &Tensor) -> Result<Option<Tensor>> {
        gradient(&self.saved.lock().unwrap_or_else(PoisonError::into_inner).0, values, upstream)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};

    fn check(start: &[f32], shape: &[usize], f: &dyn Fn(&Tensor) -> Tensor) {
        let v = Var::from_tensor(&Tensor::from_slice(start, shape, &Device::Cpu).unwrap()).unwrap();
        let grads = f(v.as_tensor()).backward().unwrap();
        let grad = grads.get(&v).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        for i in 0..start.len() {
            let value = |delta: f32| {
                let mut moved = start.to_vec();
                moved[i] += delta;
                let x = Tensor::from_slice(&moved, shape, &Device::Cpu).unwrap();
                f64::from(f(&x).to_scalar::<f32>().unwrap())
            };
            let numeric = (value(2e-3) - value(-2e-3)) / 4e-3;
            assert!((numeric - f64::from(grad[i])).abs() < 2e-3, "entry {i}: {numeric} against {}", grad[i]);
        }
    }

    #[test]
    fn policy_gradient_matches_finite_differences_inside_and_outside_the_clip_range() {
        let heads = ActionHeads::new(vec![3, 2]).unwrap();
        let logits = [0.3, -0.2, 0.5, 0.1, 0.9, 1.0, 0.0, -1.0, 0.4, 0.2, 0.0, 0.7, 0.1, -0.3, 0.3];
        let rows = PolicyRows {
            actions: vec![0, 1, 2, 0, 1, 1],
            old_log_probs: vec![-1.5, -2.9, -1.2],
            advantages: vec![1.3, -0.7, -2.0],
        };
        check(&logits, &[3, 5], &|x| policy_loss(x, rows.clone(), &heads, 0.2, 0.05, 0.5).unwrap().0);
    }

    #[test]
    fn policy_loss_matches_a_hand_computed_value() {
        // Equal logits: π = 1/2; old log-probability ln(1/3): ρ = 1.5, A = 2 → min(3, 1.2·2) = 2.4.
        let heads = ActionHeads::new(vec![2]).unwrap();
        let rows = PolicyRows { actions: vec![1], old_log_probs: vec![(1.0f32 / 3.0).ln()], advantages: vec![2.0] };
        let x = Tensor::zeros((1, 2), candle_core::DType::F32, &Device::Cpu).unwrap();
        let (loss, stats) = policy_loss(&x, rows, &heads, 0.2, 0.0, 1.0).unwrap();
        assert!((loss.to_scalar::<f32>().unwrap() + 2.4).abs() < 1e-5);
        assert!((stats.entropy - std::f64::consts::LN_2).abs() < 1e-6);
        assert_eq!(stats.clipped, 1.0);
    }

    #[test]
    fn value_gradient_matches_finite_differences_and_is_huber_beyond_delta() {
        let rows = ValueRows { old_values: vec![0.0, 0.0, 1.0, 0.5], targets: vec![1.0, -1.0, 1.05, 30.0] };
        let values = [0.1, 0.5, 0.9, 0.4];
        check(&values, &[4, 1], &|x| value_loss(x, rows.clone(), 0.2, 10.0, 0.25).unwrap().0);
        let x = Tensor::from_slice(&values[3..], (1, 1), &Device::Cpu).unwrap();
        let rows = ValueRows { old_values: vec![0.4], targets: vec![30.4] };
        assert!((value_loss(&x, rows, 0.2, 10.0, 1.0).unwrap().1 - 250.0).abs() < 1e-3);
    }
}
