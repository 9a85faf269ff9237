use super::operation::{Arg, Operation, apply1};
use super::simd::{LANES, load, store, sum};
use candle_core::{Result, Shape, Tensor, bail};
use std::sync::Arc;
use wide::f32x16;

/// One decision of an assignment: which row of the instance's score matrix chose which column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pick {
    /// Row of the score matrix.
    pub row: u32,
    /// Column taken; later picks of the same instance cannot take it again.
    pub column: u32,
}

/// Where an instance's scores stand in the flat score vector.
#[derive(Debug, Clone, PartialEq)]
pub struct PickTable {
    /// Index of the first score.
    pub start: usize,
    /// Columns of the score matrix.
    pub columns: usize,
    /// Decisions in the order in which they were made.
    pub picks: Vec<Pick>,
}

/// Sequential masked softmax: [2, P] log-probability of every pick's column among those still free, and entropy of that
/// choice, from flat `scores`. With one row for all picks this is the Plackett–Luce likelihood of a ranking.
pub fn pick_log_probs(scores: &Tensor, tables: Arc<Vec<PickTable>>) -> Result<Tensor> {
    apply1(PickLogProbs { tables }, &scores.flatten_all()?)
}

struct PickLogProbs {
    tables: Arc<Vec<PickTable>>,
}

/// Lowest exponent: e^−80 adds nothing to a sum of at least 1, and is a normal number.
const FLOOR: f32 = -80.0;

/// Which columns can still be taken: 0 for those, −∞ for the others, to be added to scores.
pub(crate) type Mask = [f32];

/// Log-softmax over the free columns of a row. The maximum is taken over the free columns at every pick: with the row's
/// maximum the sum could underflow late in a ranking.
#[derive(Debug, Clone, Copy)]
pub(crate) struct MaskedSoftmax {
    pub(crate) max: f32,
    log_sum: f32,
}

impl MaskedSoftmax {
    pub(crate) fn of(row: &[f32], mask: &Mask) -> Self {
        let lowest = f32x16::splat(f32::NEG_INFINITY);
        let highest = vectors(row, mask).fold(lowest, |max, (x, _)| max.fast_max(x)).to_array();
        let max = highest.into_iter().fold(f32::NEG_INFINITY, |a, b| if b > a { b } else { a });
        let (shift, floor) = (f32x16::splat(max), f32x16::splat(FLOOR));
        let total = vectors(row, mask).fold(f32x16::ZERO, |total, (x, _)| total + (x - shift).fast_max(floor).exp());
        Self { max, log_sum: libm::logf(sum(total)) }
    }

    /// Of a free column with this score.
    pub(crate) fn log_prob(&self, score: f32) -> f32 {
        (score - self.max) - self.log_sum
    }

    /// Fills the probabilities and log-probabilities (meaningless where a column is taken) and returns the entropy.
    fn fill(&self, row: &[f32], mask: &Mask, probs: &mut [f32], log_probs: &mut [f32]) -> f32 {
        let (shift, log_sum) = (f32x16::splat(self.max), f32x16::splat(self.log_sum));
        let mut entropy = f32x16::ZERO;
        let outs = probs.chunks_mut(LANES).zip(log_probs.chunks_mut(LANES));
        for ((x, is_free), (probs, log_probs)) in vectors(row, mask).zip(outs) {
            let log_prob = ((x - shift) - log_sum).fast_max(f32x16::splat(FLOOR));
            let prob = log_prob.exp() * is_free;
            entropy -= prob * log_prob;
            store(prob, probs);
            store(log_prob, log_probs);
        }
        sum(entropy)
    }
}

/// A row cut into vectors: scores, −∞ where a column is taken or there is none, and 1 or 0 for the same.
fn vectors<'a>(row: &'a [f32], mask: &'a Mask) -> impl Iterator<Item = (f32x16, f32x16)> + 'a {
    row.chunks(LANES).zip(mask.chunks(LANES)).map(|(row, mask)| {
        let mask = match mask.first_chunk::<LANES>() {
            Some(mask) => f32x16::new(*mask),
            None => {
                let mut lanes = [f32::NEG_INFINITY; LANES];
                lanes[..mask.len()].copy_from_slice(mask);
                f32x16::new(lanes)
            }
        };
        (load(row) + mask, (mask + f32x16::ONE).fast_max(f32x16::ZERO))
    })
}

impl Operation<1> for PickLogProbs {
    const NAME: &'static str = "pick-log-probs";

    fn forward(&self, [scores]: [Arg<'_>; 1]) -> Result<(Vec<f32>, Shape)> {
        let scores = scores.values;
        let count: usize = self.tables.iter().map(|t| t.picks.len()).sum();
        let mut out = vec![0.0; 2 * count];
        let mut at = 0;
        for table in self.tables.iter() {
            let mut mask = vec![0.0; table.columns];
            let (mut probs, mut log_probs) = (vec![0.0; table.columns], vec![0.0; table.columns]);
            for pick in &table.picks {
                let start = table.start + pick.row as usize * table.columns;
                let column = pick.column as usize;
                if start + table.columns > scores.len() || mask.get(column).is_none_or(|mask| *mask < 0.0) {
                    bail!("picks: row {} column {column} does not exist or is taken", pick.row);
                }
                let row = &scores[start..start + table.columns];
                let softmax = MaskedSoftmax::of(row, &mask);
                out[at] = softmax.log_prob(row[column]);
                out[count + at] = softmax.fill(row, &mask, &mut probs, &mut log_probs);
                mask[column] = f32::NEG_INFINITY;
                at += 1;
            }
        }
        Ok((out, Shape::from((2, count))))
    }

    fn backward(&self, [scores]: [Arg<'_>; 1], y: &[f32], upstream: &[f32]) -> Result<[Option<Vec<f32>>; 1]> {
        let (scores, count) = (scores.values, y.len() / 2);
        let mut gradient = vec![0.0; scores.len()];
        let mut at = 0;
        for table in self.tables.iter() {
            let mut mask = vec![0.0; table.columns];
            let (mut probs, mut log_probs) = (vec![0.0; table.columns], vec![0.0; table.columns]);
            for pick in &table.picks {
                let start = table.start + pick.row as usize * table.columns;
                let row = start..start + table.columns;
                let scores = &scores[row.clone()];
                let entropy = MaskedSoftmax::of(scores, &mask).fill(scores, &mask, &mut probs, &mut log_probs);
                let (d_log_prob, d_entropy) = (upstream[at], upstream[count + at]);
                for ((g, &p), &log_prob) in gradient[row].iter_mut().zip(&probs).zip(&log_probs) {
                    *g -= p * (d_log_prob + d_entropy * (log_prob + entropy));
                }
                gradient[start + pick.column as usize] += d_log_prob;
                mask[pick.column as usize] = f32::NEG_INFINITY;
                at += 1;
            }
        }
        Ok([Some(gradient)])
    }
}
