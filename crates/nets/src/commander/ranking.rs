//! The paper's Goal Scheduler: all positions in, one score per goal out, goals ranked by score and handed to agents
//! 1..N (paper, eq. 3), with the Plackett–Luce likelihood of the ranking.
//!
//! Rank r means "agent r", so the order of the indices decides whether there is anything to learn: with shuffled indices
//! it learns nothing. Agents and goals are therefore put into a canonical spatial order first.

use super::instance::PickOrder;
use super::{CommanderError, Instance, Team};
use crate::executor::Layer;
use crate::ops::{self, Activation, constant};
use crate::params::{ParamBuilder, ParamError};
use candle_core::{Result as CandleResult, Tensor};
use candle_nn::Module;
use magex_core::config::CanonicalOrder;

/// Scores are bounded to ± this, so that no goal's probability vanishes.
const BOUND: f64 = 10.0;

/// positions → hidden → hidden → N scores.
pub struct RankingNet {
    layers: [Layer; 3],
    agents: usize,
    dims: usize,
    order: CanonicalOrder,
}

impl RankingNet {
    /// For teams of exactly `agents` agents and as many goals in `dims` dimensions.
    pub fn build(
        hidden: usize,
        agents: usize,
        dims: usize,
        order: CanonicalOrder,
        params: &mut ParamBuilder,
    ) -> Result<Self, ParamError> {
        let gain = 5.0 / 3.0;
        let tanh = Activation::Tanh;
        Ok(Self {
            layers: [
                Layer::build(params, "rank.0", (2 * dims * agents, hidden), tanh, gain)?.on_features(),
                Layer::build(params, "rank.1", (hidden, hidden), tanh, gain)?,
                Layer::build(params, "rank.2", (hidden, agents), Activation::Identity, 0.1)?,
            ],
            agents,
            dims,
            order,
        })
    }

    /// [B·N] scores of B instances.
    pub(super) fn forward(&self, instances: &[&Instance]) -> CandleResult<Tensor> {
        let features: Vec<f32> = instances.iter().flat_map(|instance| instance.features.iter().copied()).collect();
        let x = constant(features, 2 * self.dims * self.agents)?;
        let hidden = self.layers[1].forward(&self.layers[0].forward(&x)?)?;
        let raw = self.layers[2].forward(&hidden)?;
        ops::tanh(&(raw * (1.0 / BOUND))?)?.affine(BOUND, 0.0)?.flatten_all()
    }

    /// Positions relative to their centre, divided by their largest extent, in canonical order.
    pub(super) fn instance(&self, team: &Team<'_>) -> Result<Instance, CommanderError> {
        let n = self.agents;
        if team.agent_count() != n || team.goal_count() != n || team.dims != self.dims {
            return Err(CommanderError::Instance(format!(
                "agents: the ranking scheduler was built for {n} agents and {n} goals in {} dimensions, got {} and {} in {}; use the pairwise scheduler for other sizes",
                self.dims,
                team.agent_count(),
                team.goal_count(),
                team.dims
            )));
        }
        let (d, all) = (self.dims, || team.agents.iter().chain(team.goals));
        if all().any(|x| !x.is_finite()) {
            return Err(CommanderError::Instance("positions must be finite".to_owned()));
        }
        let mut centre = vec![0.0f64; d];
        for (k, x) in all().enumerate() {
            centre[k % d] += f64::from(*x) / (2 * n) as f64;
        }
        let extent = all().enumerate().map(|(k, x)| (f64::from(*x) - centre[k % d]).abs()).fold(1e-9, f64::max);
        let place = |points: &[f32], i: usize, k: usize| ((f64::from(points[i * d + k]) - centre[k]) / extent) as f32;
        let agents = canonical(self.order, n, |i, k| place(team.agents, i, k));
        let goals = canonical(self.order, n, |i, k| place(team.goals, i, k));
        let mut features = Vec::with_capacity(2 * d * n);
        agents.iter().for_each(|&i| features.extend((0..d).map(|k| place(team.agents, i as usize, k))));
        goals.iter().for_each(|&i| features.extend((0..d).map(|k| place(team.goals, i as usize, k))));
        let (reduced_costs, candidates) = (Vec::new(), Vec::new());
        let order = PickOrder::Given(agents);
        Ok(Instance {
            features,
            reduced_costs,
            candidates,
            rows: 1,
            columns: n,
            order,
            column_of: goals,
            swapped: false,
            agents: n,
        })
    }
}

/// Indices in canonical order, ties by index. Coordinates are in [−1, 1].
fn canonical(order: CanonicalOrder, n: usize, at: impl Fn(usize, usize) -> f32) -> Vec<u32> {
    let key = |i: usize| -> f64 {
        let (x, y) = (at(i, 0), at(i, 1));
        match order {
            CanonicalOrder::X => f64::from(x),
            CanonicalOrder::Angle => libm::atan2(f64::from(y), f64::from(x)),
            CanonicalOrder::Hilbert => hilbert(x, y),
        }
    };
    let mut indices: Vec<u32> = (0..n as u32).collect();
    let keys: Vec<f64> = (0..n).map(key).collect();
    indices.sort_by(|&a, &b| keys[a as usize].total_cmp(&keys[b as usize]).then(a.cmp(&b)));
    indices
}

/// Place of a point of [−1, 1]² along a Hilbert curve of order 12.
fn hilbert(x: f32, y: f32) -> f64 {
    let cell = |v: f32| (((v.clamp(-1.0, 1.0) + 1.0) * 2047.5) as u32).min(4095);
    let (mut x, mut y) = (cell(x), cell(y));
    let mut index = 0u64;
    let mut s = 2048;
    while s > 0 {
        let (rx, ry) = (u32::from(x & s > 0), u32::from(y & s > 0));
        index += u64::from(s) * u64::from(s) * u64::from((3 * rx) ^ ry);
        if ry == 0 {
            if rx == 1 {
                x = 4095 - x;
                y = 4095 - y;
            }
            std::mem::swap(&mut x, &mut y);
        }
        s /= 2;
    }
    index as f64
}
