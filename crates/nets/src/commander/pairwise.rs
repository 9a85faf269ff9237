//! The pairwise scorer: a small network that looks at one (agent, goal) pair at a time, so it serves any team size in any
//! order. Entropic transport prices say how much worse than a global compromise each pair is; the network refines the pairs
//! that are among the best of their row, and leaves the others as they are.

use super::instance::PickOrder;
use super::{CommanderError, Instance, Team};
use crate::executor::{Layer, RELU_GAIN};
use crate::ops::{Activation, constant};
use crate::params::{Init, ParamBuilder, ParamError};
use candle_core::{Device, Result as CandleResult, Tensor};
use candle_nn::Module;
use magex_assign::duals::sinkhorn_duals;
use magex_assign::powered;

const FEATURES: usize = 10;

/// Pairs of each row that the network looks at: those with the least reduced cost.
const CANDIDATES: usize = 4;

/// Reduced costs become scores in units of the typical distance between neighbours, mean distance / √rows: a quarter of it is
/// worth one unit of log-probability at the start of learning.
const MAGNIFY: f32 = 4.0;

/// score_ij = −sharpness · reduced_ij + MLP(features_ij), the second for the pairs that the network looks at.
pub struct PairwiseNet {
    sharpness: Tensor,
    first: Layer,
    second: Layer,
    out: Layer,
}

impl PairwiseNet {
    /// 10 → hidden → hidden → 1.
    pub fn build(hidden: usize, params: &mut ParamBuilder) -> Result<Self, ParamError> {
        Ok(Self {
            sharpness: params.tensor("sharpness", &[1], Init::Constant(1.0))?,
            first: Layer::build(params, "pair.0", (FEATURES, hidden), Activation::Relu, RELU_GAIN)?.on_features(),
            second: Layer::build(params, "pair.1", (hidden, hidden), Activation::Relu, RELU_GAIN)?,
            out: Layer::build(params, "pair.2", (hidden, 1), Activation::Identity, 0.01)?,
        })
    }

    pub(super) fn forward(&self, instances: &[&Instance]) -> CandleResult<Tensor> {
        let cells = instances.iter().map(|instance| instance.cells()).sum();
        let mut reduced_costs = Vec::with_capacity(cells);
        let (mut features, mut places) = (Vec::new(), Vec::new());
        for instance in instances {
            places.extend(instance.candidates.iter().map(|place| reduced_costs.len() as u32 + place));
            reduced_costs.extend_from_slice(&instance.reduced_costs);
            features.extend_from_slice(&instance.features);
        }
        let x = constant(features, FEATURES)?;
        let refined = self.out.forward(&self.second.forward(&self.first.forward(&x)?)?)?.flatten_all()?;
        let scores = Tensor::from_vec(reduced_costs, cells, &Device::Cpu)?.broadcast_mul(&self.sharpness.neg()?)?;
        let places = Tensor::from_vec(places, refined.elem_count(), &Device::Cpu)?;
        scores.index_add(&places, &refined, 0)
    }
}

/// The side with fewer members picks; `power` is the exponent of the distances.
pub(super) fn instance(team: &Team<'_>, power: f64) -> Result<Instance, CommanderError> {
    let (n, g) = (team.agent_count(), team.goal_count());
    if n == 0 || g == 0 {
        return Err(CommanderError::Instance("agents and goals must not be empty".to_owned()));
    }
    let swapped = n > g;
    let (rows, columns) = (n.min(g), n.max(g));
    let mut cost = distances(team, swapped)?;
    if power != 1.0 {
        // In units of the mean distance, so that no power leaves the range of single precision where the distances do not.
        let unit = mean(&cost);
        cost.iter_mut().for_each(|cost| *cost = (unit * powered(f64::from(*cost) / unit, power)) as f32);
    }
    // Options that stay free need a price, too: imaginary pickers take them at no cost. Without these the pickers would have
    // to spread over all options.
    let mut filled = cost.clone();
    filled.resize(columns * columns, 0.0);
    let duals = sinkhorn_duals(&filled, columns, columns)?;
    let spacing = mean(&cost) as f32 / (rows as f32).sqrt();
    let unit = MAGNIFY / spacing;
    let mut reduced_costs = cost;
    let mut row_base = Vec::with_capacity(rows);
    for (row, u) in reduced_costs.chunks_exact_mut(columns).zip(&duals.rows) {
        for (cost, v) in row.iter_mut().zip(&duals.cols) {
            *cost = (*cost - u - v) * unit;
        }
        let least = row.iter().fold(f32::MAX, |least, &value| if value < least { value } else { least });
        row.iter_mut().for_each(|value| *value = (*value - least).min(LARGEST));
        row_base.push(least);
    }
    let (features, candidates) = features(&reduced_costs, &row_base, columns);
    let column_of = (0..columns as u32).collect();
    Ok(Instance {
        features,
        reduced_costs,
        candidates,
        rows,
        columns,
        order: PickOrder::LargestRegret,
        column_of,
        swapped,
        agents: n,
    })
}

/// Mean cost, not 0.
fn mean(cost: &[f32]) -> f64 {
    (cost.iter().map(|&c| f64::from(c)).sum::<f64>() / cost.len() as f64).max(1e-12)
}

/// Reduced costs are kept below this: beyond it a pair is hopeless anyway.
const LARGEST: f32 = 1e4;

/// Distances [rows, columns] between pickers and options.
fn distances(team: &Team<'_>, swapped: bool) -> Result<Vec<f32>, CommanderError> {
    let d = team.dims;
    let (pickers, options) = if swapped { (team.goals, team.agents) } else { (team.agents, team.goals) };
    let columns = options.len() / d;
    let mut cost = vec![0.0f32; pickers.len() / d * columns];
    // One coordinate of all options side by side, so that the loop over them is one of vectors.
    let coordinate = |k: usize| options.iter().skip(k).step_by(d).copied().collect::<Vec<f32>>();
    let options: Vec<Vec<f32>> = (0..d).map(coordinate).collect();
    for (row, picker) in cost.chunks_exact_mut(columns).zip(pickers.chunks_exact(d)) {
        for (options, &own) in options.iter().zip(picker) {
            for (square, &other) in row.iter_mut().zip(options) {
                *square = (own - other).mul_add(own - other, *square);
            }
        }
        row.iter_mut().for_each(|square| *square = square.sqrt());
    }
    if let Some(place) = cost.iter().position(|c| !c.is_finite()) {
        return Err(CommanderError::Instance(format!(
            "the distance of agent {} to goal {} is not finite",
            if swapped { place % columns } else { place / columns },
            if swapped { place / columns } else { place % columns }
        )));
    }
    Ok(cost)
}

/// Features of the candidate pairs, and their places in the score matrix. `reduced_costs` [rows, columns] is relative to the
/// best of each row, which is `row_base`.
fn features(reduced_costs: &[f32], row_base: &[f32], columns: usize) -> (Vec<f32>, Vec<u32>) {
    let rows = row_base.len();
    // Of every column: the best and second-best among the rows, and how many rows like it best.
    let mut column_best = vec![f32::MAX; columns];
    let mut column_second = vec![f32::MAX; columns];
    let mut wanted = vec![0.0f32; columns];
    for (row, base) in reduced_costs.chunks_exact(columns).zip(row_base) {
        for ((best, second), value) in column_best.iter_mut().zip(&mut column_second).zip(row) {
            let value = value + base;
            let larger = if value < *best { *best } else { value };
            *second = if larger < *second { larger } else { *second };
            *best = if value < *best { value } else { *best };
        }
        for (wanted, &value) in wanted.iter_mut().zip(row) {
            *wanted += if value == 0.0 { 1.0 } else { 0.0 };
        }
    }
    let size = libm::logf(rows as f32) / 6.0;
    let crowd = libm::logf(columns as f32 / rows as f32);
    let count = CANDIDATES.min(columns);
    let mut features = Vec::with_capacity(rows * count * FEATURES);
    let mut candidates = Vec::with_capacity(rows * count);
    for (i, (row, base)) in reduced_costs.chunks_exact(columns).zip(row_base).enumerate() {
        let best = least(row);
        let regret = best[1].0.min(LARGEST);
        for (rank, &(value, j)) in best[..count].iter().enumerate() {
            let over_column = value + base - column_best[j];
            let column_regret = (column_second[j] - column_best[j]).min(LARGEST);
            features.extend([
                squash(value),
                squash(0.1 * value),
                squash(over_column),
                squash(0.1 * over_column),
                squash(regret),
                squash(column_regret),
                (wanted[j] - 1.0).clamp(-1.0, 3.0),
                rank as f32 / CANDIDATES as f32,
                size,
                crowd.min(2.0),
            ]);
            candidates.push((i * columns + j) as u32);
        }
    }
    (features, candidates)
}

/// [0, ∞) → [0, 1), steepest at 0.
fn squash(x: f32) -> f32 {
    x / (1.0 + x)
}

/// The smallest of a row with their columns, ascending, ties by column; f32::MAX where the row has no more.
fn least(row: &[f32]) -> [(f32, usize); CANDIDATES] {
    let mut found = [(f32::MAX, 0); CANDIDATES];
    for (column, &value) in row.iter().enumerate() {
        if value < found[CANDIDATES - 1].0 {
            let mut place = CANDIDATES - 1;
            while place > 0 && value < found[place - 1].0 {
                found[place] = found[place - 1];
                place -= 1;
            }
            found[place] = (value, column);
        }
    }
    found
}
