//! Categorical action distributions, evaluated row by row. Actors (to act) and learner (to differentiate) share this
//! code, so equal logits give equal log-probabilities to the bit.

use crate::ops::{LANES, exp_of_negative};
use magex_core::rng::Stream;
use magex_core::task::CHOICES_MAX;
use wide::f32x16;

/// Components of an action. Each is an independent categorical over its own logits, which stand side by side in a row; or, where
/// there are no such components, a real number with a normal distribution: C means, then C logarithms of standard deviations.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ActionHeads {
    sizes: Vec<usize>,
    /// C.
    moves: usize,
}

impl ActionHeads {
    /// From the number of choices of each component (each between 1 and 256).
    pub fn new(sizes: Vec<usize>) -> Option<Self> {
        let fits = !sizes.is_empty() && sizes.iter().all(|s| (1..=CHOICES_MAX).contains(s));
        fits.then_some(Self { sizes, moves: 0 })
    }

    /// C real numbers.
    pub fn gaussian(moves: usize) -> Self {
        Self { sizes: Vec::new(), moves }
    }

    /// C: real numbers of an action.
    pub fn moves(&self) -> usize {
        self.moves
    }

    /// H: components.
    pub fn count(&self) -> usize {
        self.sizes.len()
    }

    /// A: logits of a row.
    pub fn logits(&self) -> usize {
        self.sizes.iter().sum::<usize>() + 2 * self.moves
    }

    /// Choices of each component.
    pub fn sizes(&self) -> &[usize] {
        &self.sizes
    }

    /// Sets the ones of an action `[H]` in a row of zeros `[A]`.
    pub fn mark(&self, action: &[u8], row: &mut [f32]) {
        let mut at = 0;
        for (&choice, &size) in action.iter().zip(&self.sizes) {
            row[at + usize::from(choice)] = 1.0;
            at += size;
        }
    }

    /// Log-probabilities of every choice, component by component.
    #[inline]
    pub fn log_softmax(&self, logits: &[f32], out: &mut [f32]) {
        let mut at = 0;
        for &size in &self.sizes {
            log_softmax(&logits[at..at + size], &mut out[at..at + size]);
            at += size;
        }
    }

    /// Chooses an action for one row; returns its log-probability. `stream` = None takes the most likely choices (the
    /// first of equals).
    pub fn choose(&self, logits: &[f32], mut stream: Option<&mut Stream>, action: &mut [u8]) -> f32 {
        let (mut few, mut many) = ([0.0f32; LANES], Vec::new());
        let (mut at, mut total) = (0, 0.0);
        for (&size, slot) in self.sizes.iter().zip(action) {
            let log_probs = if size <= LANES {
                &mut few[..size]
            } else {
                many.resize(size, 0.0);
                &mut many[..]
            };
            log_softmax(&logits[at..at + size], log_probs);
            let pick = match &mut stream {
                None => {
                    log_probs.iter().enumerate().fold(0, |best, (i, &x)| if x > log_probs[best] { i } else { best })
                }
                Some(stream) => {
                    let u = stream.uniform32();
                    let mut sum = 0.0;
                    let mut beyond = |x: &f32| {
                        sum += libm::expf(*x);
                        u < sum
                    };
                    log_probs.iter().position(&mut beyond).unwrap_or(size - 1)
                }
            };
            total += log_probs[pick];
            *slot = pick as u8;
            at += size;
        }
        total
    }
}

impl ActionHeads {
    /// Draws real numbers for one row of outputs `[2C]`, or takes their means; returns the logarithm of their density.
    pub fn draw(&self, outputs: &[f32], mut stream: Option<&mut Stream>, moves: &mut [f32]) -> f32 {
        let (means, log_deviations) = outputs.split_at(self.moves);
        for ((slot, mean), log_deviation) in moves.iter_mut().zip(means).zip(log_deviations) {
            *slot = match &mut stream {
                Some(stream) => mean + libm::expf(*log_deviation) * stream.normal() as f32,
                None => *mean,
            };
        }
        log_density(means, log_deviations, moves)
    }

    /// The best choice of each component by its values `[A]`, the first of equals.
    pub fn best(&self, values: &[f32], action: &mut [u8]) {
        let mut at = 0;
        for (&size, slot) in self.sizes.iter().zip(action) {
            let values = &values[at..at + size];
            *slot = values.iter().enumerate().fold(0, |best, (i, &x)| if x > values[best] { i } else { best }) as u8;
            at += size;
        }
    }

    /// The value of an action: the sum of the values of its choices.
    pub fn value(&self, values: &[f32], action: &[u8]) -> f32 {
        let (mut at, mut total) = (0, 0.0);
        for (&size, &choice) in self.sizes.iter().zip(action) {
            total += values[at + usize::from(choice)];
            at += size;
        }
        total
    }

    /// Joint choices of all components.
    pub fn joint(&self) -> usize {
        self.sizes.iter().product()
    }

    /// ε-greedy: with probability ε any action, all alike, otherwise the best one. Returns the log-probability of the action
    /// that it is. `stream` = None takes the best one.
    pub fn choose_epsilon_greedy(
        &self,
        values: &[f32],
        epsilon: f32,
        stream: Option<&mut Stream>,
        action: &mut [u8],
    ) -> f32 {
        self.best(values, action);
        let Some(stream) = stream else { return 0.0 };
        let mut greedy = true;
        // As many draws whatever happens: what comes later does not depend on it.
        let explore = stream.uniform32() < epsilon;
        for (&size, slot) in self.sizes.iter().zip(action) {
            let any = stream.below(size as u32) as u8;
            if explore {
                greedy &= *slot == any;
                *slot = any;
            }
        }
        let any = epsilon / self.joint() as f32;
        libm::logf(if greedy { any + (1.0 - epsilon) } else { any }).min(0.0)
    }
}

/// ln √(2π).
const HALF_LOG_TAU: f32 = 0.918_938_5;

/// The logarithm of the density of real numbers: Σ −z²/2 − ln σ − ln √(2π) with z = (u − μ) / σ.
pub(crate) fn log_density(means: &[f32], log_deviations: &[f32], moves: &[f32]) -> f32 {
    let rows = means.iter().zip(log_deviations).zip(moves);
    rows.fold(0.0, |sum, ((mean, log_deviation), u)| {
        let z = (u - mean) * libm::expf(-log_deviation);
        sum - (0.5 * z * z + log_deviation + HALF_LOG_TAU)
    })
}

/// The entropy of real numbers: Σ ln σ + 1/2 + ln √(2π).
pub(crate) fn entropy(log_deviations: &[f32]) -> f32 {
    log_deviations.iter().fold(0.0, |sum, log_deviation| sum + (log_deviation + 0.5 + HALF_LOG_TAU))
}

/// x − max − ln Σ exp(x − max): as if these numbers were those of sixteen rows that are alike.
#[inline]
fn log_softmax(logits: &[f32], out: &mut [f32]) {
    let (mut few, mut many) = ([f32x16::ZERO; LANES], Vec::new());
    let columns = if logits.len() <= LANES {
        &mut few[..logits.len()]
    } else {
        many.resize(logits.len(), f32x16::ZERO);
        &mut many[..]
    };
    columns.iter_mut().zip(logits).for_each(|(column, x)| *column = f32x16::splat(*x));
    log_softmax_of_rows(columns);
    out.iter_mut().zip(columns).for_each(|(out, column)| *out = column.to_array()[0]);
}

/// The same for sixteen rows at once, one vector for each choice; in place.
#[inline(always)]
pub(crate) fn log_softmax_of_rows(columns: &mut [f32x16]) {
    let max = columns.iter().fold(f32x16::splat(f32::NEG_INFINITY), |max, x| max.fast_max(*x));
    let mut sum = f32x16::ZERO;
    for x in columns.iter_mut() {
        *x -= max;
        sum += exp_of_negative(*x);
    }
    let log_sum = sum.ln();
    columns.iter_mut().for_each(|x| *x -= log_sum);
}

#[cfg(test)]
mod tests {
    use super::*;
    use magex_core::rng::{Key, Purpose};

    #[test]
    fn probabilities_sum_to_one_and_large_logits_are_safe() {
        let heads = ActionHeads::new(vec![5]).unwrap();
        for logits in [[0.0, 1.0, 2.0, 3.0, 4.0], [1000.0, 0.0, 0.0, 0.0, -1000.0], [-50.0; 5]] {
            let mut out = [0.0; 5];
            heads.log_softmax(&logits, &mut out);
            let sum: f32 = out.iter().map(|x| x.exp()).sum();
            assert!((sum - 1.0).abs() < 1e-5, "{sum}");
        }
    }

    #[test]
    fn epsilon_greedy_takes_the_best_choices_or_any_with_the_probability_that_it_tells() {
        let heads = ActionHeads::new(vec![3, 2]).unwrap();
        // The first of equals.
        let values = [1.0, 5.0, 5.0, 2.0, -1.0];
        let mut action = [9u8; 2];
        assert_eq!((heads.choose_epsilon_greedy(&values, 0.7, None, &mut action), action), (0.0, [1, 0]));
        assert_eq!((heads.value(&values, &[2, 1]), heads.joint()), (4.0, 6));
        let mut stream = Key::new(1, Purpose::Action, &[]).stream();
        let mut seen = [0u32; 6];
        for _ in 0..12_000 {
            let log_prob = heads.choose_epsilon_greedy(&values, 0.3, Some(&mut stream), &mut action);
            let expected: f32 = if action == [1, 0] { 0.75 } else { 0.05 };
            assert!((log_prob - expected.ln()).abs() < 1e-6);
            seen[usize::from(action[0] * 2 + action[1])] += 1;
        }
        assert!((8800..9200).contains(&seen[2]), "{seen:?}");
        assert!(seen.iter().enumerate().all(|(k, n)| k == 2 || (500..700).contains(n)), "{seen:?}");
        assert_eq!(heads.choose_epsilon_greedy(&values, 0.0, Some(&mut stream), &mut action), 0.0);
    }

    #[test]
    fn samples_follow_the_distribution_and_greedy_takes_the_mode() {
        let heads = ActionHeads::new(vec![3, 2]).unwrap();
        let logits = [0.0, (3.0f32).ln(), 0.0, 0.0, (4.0f32).ln()];
        let mut stream = Key::new(1, Purpose::Action, &[]).stream();
        let (mut action, mut seen) = ([0u8; 2], [0u32; 2]);
        for _ in 0..10_000 {
            heads.choose(&logits, Some(&mut stream), &mut action);
            seen[0] += u32::from(action[0] == 1);
            seen[1] += u32::from(action[1] == 1);
        }
        assert!((5800..6200).contains(&seen[0]) && (7800..8200).contains(&seen[1]), "{seen:?}");
        let log_prob = heads.choose(&logits, None, &mut action);
        assert_eq!(action, [1, 1]);
        assert!((log_prob - (0.6f32 * 0.8).ln()).abs() < 1e-5);
    }
}
