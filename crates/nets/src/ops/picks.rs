use super::{slice, with_numbers};
use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor, bail};
use std::sync::Arc;

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

/// Sequential masked softmax: for every pick the log-probability of its column among the columns still free, and the
/// entropy of that choice. `scores` is flat; the result [2, P] stacks log-probabilities and entropies of all picks of all
/// instances. With one row for all picks this is the Plackett–Luce likelihood of a ranking.
pub fn pick_log_probs(scores: &Tensor, tables: Arc<Vec<PickTable>>) -> Result<Tensor> {
    scores.flatten_all()?.contiguous()?.apply_op1(PickLogProbs { tables })
}

struct PickLogProbs {
    tables: Arc<Vec<PickTable>>,
}

/// Log-softmax over the free columns of a row: fills `log_probs` (free columns only) and returns the entropy. The maximum
/// is taken over the free columns at every pick: with the row's maximum the sum could underflow late in a ranking.
pub(crate) fn masked_log_softmax(row: &[f32], free: &[bool], log_probs: &mut [f32]) -> f32 {
    let open = || row.iter().zip(free).filter(|(_, free)| **free).map(|(x, _)| *x);
    let max = open().fold(f32::NEG_INFINITY, f32::max);
    let sum: f32 = open().map(|x| libm::expf(x - max)).sum();
    let log_sum = libm::logf(sum);
    let mut entropy = 0.0;
    for ((out, &x), &free) in log_probs.iter_mut().zip(row).zip(free) {
        if free {
            *out = (x - max) - log_sum;
            entropy -= libm::expf(*out) * *out;
        }
    }
    entropy
}

impl CustomOp1 for PickLogProbs {
    fn name(&self) -> &'static str {
        "pick-log-probs"
    }

    fn cpu_fwd(&self, scores: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let scores = slice(scores, layout)?;
        let count: usize = self.tables.iter().map(|t| t.picks.len()).sum();
        let mut out = vec![0.0; 2 * count];
        let mut at = 0;
        for table in self.tables.iter() {
            let mut free = vec![true; table.columns];
            let mut log_probs = vec![0.0; table.columns];
            for pick in &table.picks {
                let start = table.start + pick.row as usize * table.columns;
                let column = pick.column as usize;
                if start + table.columns > scores.len() || !free.get(column).copied().unwrap_or(false) {
                    bail!("picks: row {} column {column} does not exist or is taken", pick.row);
                }
                out[count + at] = masked_log_softmax(&scores[start..start + table.columns], &free, &mut log_probs);
                out[at] = log_probs[column];
                free[column] = false;
                at += 1;
            }
        }
        Ok((CpuStorage::F32(out), Shape::from((2, count))))
    }

    fn bwd(&self, scores: &Tensor, out: &Tensor, upstream: &Tensor) -> Result<Option<Tensor>> {
        let (_, count) = out.dims2()?;
        let upstream = upstream.contiguous()?.flatten_all()?.to_vec1::<f32>()?;
        let gradient = with_numbers(scores, |scores| {
            let mut gradient = vec![0.0; scores.len()];
            let mut at = 0;
            for table in self.tables.iter() {
                let mut free = vec![true; table.columns];
                let mut log_probs = vec![0.0; table.columns];
                for pick in &table.picks {
                    let start = table.start + pick.row as usize * table.columns;
                    let row = start..start + table.columns;
                    let entropy = masked_log_softmax(&scores[row.clone()], &free, &mut log_probs);
                    let (d_log_prob, d_entropy) = (upstream[at], upstream[count + at]);
                    for (j, g) in gradient[row].iter_mut().enumerate() {
                        if free[j] {
                            let p = libm::expf(log_probs[j]);
                            let chosen = if j == pick.column as usize { 1.0 } else { 0.0 };
                            *g += d_log_prob * (chosen - p) - d_entropy * p * (log_probs[j] + entropy);
                        }
                    }
                    free[pick.column as usize] = false;
                    at += 1;
                }
            }
            gradient
        })?;
        Ok(Some(Tensor::from_vec(gradient, scores.shape(), scores.device())?))
    }
}
