//! The pairwise scorer: a small network that looks at one (agent, goal) pair at a time, so it serves any team size and
//! does not care about the order of agents and goals.

use super::{CommanderError, Instance, Team, constant, duals};
use crate::executor::{Layer, RELU_GAIN};
use crate::matmul::Activation;
use crate::params::{ParamError, Source, Start};
use candle_core::{Result as CandleResult, Tensor};

/// Features of a pair.
const FEATURES: usize = 6;

/// Reduced costs are magnified by this before they become scores: a difference of 3 % of the mean distance is then worth
/// one unit of log-probability at the start of learning.
const MAGNIFY: f32 = 30.0;

/// score_ij = −sharpness · 30 · reduced_ij + MLP(features_ij).
pub struct PairwiseNet {
    sharpness: Tensor,
    first: Layer,
    second: Layer,
    out: Layer,
}

impl PairwiseNet {
    /// 6 → hidden → hidden → 1.
    pub fn build(hidden: usize, source: &mut Source<'_>) -> Result<Self, ParamError> {
        Ok(Self {
            sharpness: source.get("sharpness", &[1], Start::Constant(1.0))?,
            first: Layer::build(source, "pair.0", (FEATURES, hidden), Activation::Relu, RELU_GAIN)?,
            second: Layer::build(source, "pair.1", (hidden, hidden), Activation::Relu, RELU_GAIN)?,
            out: Layer::build(source, "pair.2", (hidden, 1), Activation::Identity, 0.01)?,
        })
    }

    /// `[P]` scores from features [P, 6].
    pub(super) fn forward(&self, features: Vec<f32>) -> CandleResult<Tensor> {
        let x = constant(features, FEATURES)?;
        let reduced = x.narrow(1, 0, 1)?.flatten_all()?;
        let learned = self.out.forward(&self.second.forward(&self.first.forward_constant(&x)?)?)?.flatten_all()?;
        learned - reduced.broadcast_mul(&self.sharpness)?
    }
}

/// The side with fewer members picks; whoever has most to lose picks first (largest difference between the best and the
/// second-best reduced cost, ties by index).
pub(super) fn instance(team: &Team<'_>) -> Result<Instance, CommanderError> {
    let (n, g, d) = (team.agent_count(), team.goal_count(), team.dims);
    if n == 0 || g == 0 {
        return Err(CommanderError::Instance("agents and goals must not be empty".to_owned()));
    }
    let swapped = n > g;
    let (pickers, options) = if swapped { (team.goals, team.agents) } else { (team.agents, team.goals) };
    let (rows, columns) = (n.min(g), n.max(g));
    let mut cost = Vec::with_capacity(rows * columns);
    for p in pickers.chunks_exact(d) {
        for o in options.chunks_exact(d) {
            let square = p.iter().zip(o).fold(0.0f32, |s, (a, b)| (a - b).mul_add(a - b, s));
            cost.push(square.sqrt());
        }
    }
    if let Some(place) = cost.iter().position(|c| !c.is_finite()) {
        return Err(CommanderError::Instance(format!(
            "the distance of agent {} to goal {} is not finite",
            if swapped { place % columns } else { place / columns },
            if swapped { place / columns } else { place % columns }
        )));
    }
    let (u, v) = duals(&cost, rows, columns)?;
    let mean = (cost.iter().map(|&c| f64::from(c)).sum::<f64>() / cost.len() as f64).max(1e-12) as f32;
    let scale = 1.0 / mean;
    let mut row_min = vec![f32::INFINITY; rows];
    let mut column_min = vec![f32::INFINITY; columns];
    // Best and second-best reduced cost of each row.
    let mut regret = vec![(f32::INFINITY, f32::INFINITY); rows];
    for i in 0..rows {
        for j in 0..columns {
            let c = cost[i * columns + j];
            row_min[i] = row_min[i].min(c);
            column_min[j] = column_min[j].min(c);
            let r = (c - u[i] - v[j]) * scale;
            let (best, second) = &mut regret[i];
            if r < *best {
                *second = *best;
                *best = r;
            } else {
                *second = second.min(r);
            }
        }
    }
    let mut features = Vec::with_capacity(rows * columns * FEATURES);
    for i in 0..rows {
        for j in 0..columns {
            let c = cost[i * columns + j];
            let reduced = ((c - u[i] - v[j]) * scale - regret[i].0).clamp(0.0, 10.0);
            features.extend([
                MAGNIFY * reduced,
                (MAGNIFY * reduced).min(1.0),
                reduced.min(1.0),
                (c * scale).min(4.0),
                ((c - row_min[i]) * scale).min(4.0),
                ((c - column_min[j]) * scale).min(4.0),
            ]);
        }
    }
    let mut turns: Vec<(u32, u32)> = (0..rows as u32).map(|i| (i, i)).collect();
    turns.sort_by(|a, b| {
        let gap = |i: u32| regret[i as usize].1 - regret[i as usize].0;
        gap(b.0).total_cmp(&gap(a.0)).then(a.0.cmp(&b.0))
    });
    let column_of = (0..columns as u32).collect();
    Ok(Instance { features, rows, columns, turns, column_of, swapped, agents: n })
}
