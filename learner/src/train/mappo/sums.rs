//! What an update tells about itself: sums over the rows of a slice, and over minibatches.

use super::{Result, sum, worse};
use crate::train::stats::UpdateStats;
use candle_core::Tensor;
use magex_nets::executor::Part;

/// Sums over rows, in order and in double precision.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct PolicySums {
    pub(super) loss: f64,
    pub(super) entropy: f64,
    /// Rows whose ratio is outside 1 ± ε.
    pub(super) clipped: f64,
    /// Σ (ρ − 1 − ln ρ), the estimator of the KL divergence from the old policy (Schulman's k3).
    pub(super) kl: f64,
    /// max |ρ − 1|.
    pub(super) ratio_error: f64,
    /// max |ln ρ|, and its row.
    pub(super) worst: (f64, usize),
}

impl PolicySums {
    pub(super) fn of(
        surrogate: &Tensor,
        entropies: &Tensor,
        ratio: &Tensor,
        log_ratio: &Tensor,
        clip: f32,
    ) -> Result<Self> {
        let mut sums = Self { loss: -sum(surrogate)?, entropy: sum(entropies)?, ..Self::default() };
        for (row, (ratio, log_ratio)) in
            ratio.to_vec1::<f32>()?.into_iter().zip(log_ratio.to_vec1::<f32>()?).enumerate()
        {
            let error = worse(sums.worst.0, log_ratio);
            if error > sums.worst.0 {
                sums.worst = (error, row);
            }
            sums.clipped += f64::from(u8::from((ratio - 1.0).abs() > clip));
            sums.kl += f64::from(ratio - 1.0 - log_ratio);
            sums.ratio_error = sums.ratio_error.max(f64::from((ratio - 1.0).abs()));
        }
        Ok(sums)
    }

    /// Of rows that stand for several samples each.
    pub(super) fn times(self, weight: f64) -> Self {
        let Self { loss, entropy, clipped, kl, ratio_error, worst } = self;
        let [loss, entropy, clipped, kl] = [loss, entropy, clipped, kl].map(|sum| sum * weight);
        Self { loss, entropy, clipped, kl, ratio_error, worst }
    }

    pub(super) fn add(&mut self, other: &Self) {
        self.loss += other.loss;
        self.entropy += other.entropy;
        self.clipped += other.clipped;
        self.kl += other.kl;
        self.ratio_error = self.ratio_error.max(other.ratio_error);
    }
}

/// Sums over the minibatches of an update.
#[derive(Default)]
pub(super) struct Totals {
    pub(super) minibatches: f64,
    /// Policy loss, value loss, entropy, clip fraction, KL divergence.
    pub(super) means: [f64; 5],
    /// Norm of each network's gradient before clipping.
    pub(super) grad_norms: Vec<f64>,
    pub(super) first_ratio_error: f64,
    pub(super) skipped: f64,
}

impl Totals {
    pub(super) fn minibatch(&mut self, policy: &PolicySums, value: f64, norms: &[f64], samples: f64) {
        self.minibatches += 1.0;
        let sums = [policy.loss, value, policy.entropy, policy.clipped, policy.kl];
        self.means.iter_mut().zip(sums).for_each(|(mean, sum)| *mean += sum / samples);
        self.grad_norms.iter_mut().zip(norms).for_each(|(total, norm)| *total += norm);
    }

    pub(super) fn stats(self, parts: &[Part]) -> UpdateStats {
        let count = self.minibatches.max(1.0);
        let mut stats = UpdateStats::default();
        let names = ["policy_loss", "value_loss", "entropy", "clip_fraction", "approx_kl"];
        names.into_iter().zip(self.means).for_each(|(name, sum)| stats.push(name, sum / count));
        stats.push("first_ratio_error", self.first_ratio_error);
        let norms = parts.iter().zip(&self.grad_norms);
        norms.for_each(|(part, sum)| stats.push(format!("{}_grad_norm", part.name), sum / count));
        stats.push("skipped_minibatches", self.skipped);
        stats
    }
}
