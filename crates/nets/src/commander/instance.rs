//! A team as a learned scheduler sees it, and decisions on it: picks, one after the other.

use super::Decision;
use crate::ops::{LANES, Mask, MaskedSoftmax, Pick, load};
use magex_core::rng::Stream;
use wide::f32x16;

/// What a learned scheduler sees of a team, computed once.
#[derive(Debug, Clone)]
pub struct Instance {
    pub(super) features: Vec<f32>,
    /// [rows, columns] what a pair costs more than the row's best (`pairwise` only); the scores are this, refined.
    pub(super) reduced_costs: Vec<f32>,
    /// Places in the score matrix that the network looks at (`pairwise` only), one per row of the features.
    pub(super) candidates: Vec<u32>,
    /// Rows of the score matrix (1 for `ranking`).
    pub(super) rows: usize,
    pub(super) columns: usize,
    /// Which row picks when.
    pub(super) order: PickOrder,
    /// Column → goal (or agent, when goals pick agents because there are fewer of them).
    pub(super) column_of: Vec<u32>,
    /// Goals pick agents.
    pub(super) swapped: bool,
    pub(super) agents: usize,
}

/// Which row picks when.
#[derive(Debug, Clone)]
pub(super) enum PickOrder {
    /// One score row for all; these pick in this order.
    Given(Vec<u32>),
    /// A score row each. The row of the largest regret picks next: the difference between its best and its second-best
    /// reduced cost among the columns that are still free, ties by index. The order does not depend on the weights, so the
    /// likelihood of a decision is that of its picks.
    LargestRegret,
}

impl Instance {
    /// Numbers of its score matrix.
    pub fn cells(&self) -> usize {
        self.rows * self.columns
    }

    /// Picks in turn: the best free column, or a sample. Returns the decision, its picks, and the log-probability of each.
    pub fn decide(&self, scores: &[f32], mut stream: Option<&mut Stream>) -> (Decision, Vec<Pick>, Vec<f32>) {
        let mut log_probs = Vec::with_capacity(self.rows);
        let mut decision =
            Decision { goals: vec![u32::MAX; self.agents], log_prob: 0.0, probabilities: vec![0.0; self.agents] };
        let picks = self.pick_in_turn(|row, picker, mask| {
            let scores = &scores[row * self.columns..(row + 1) * self.columns];
            let softmax = MaskedSoftmax::of(scores, mask);
            let free = || {
                scores.iter().zip(mask).enumerate().filter(|(_, (_, mask))| **mask == 0.0).map(|(j, (x, _))| (j, *x))
            };
            let best = free().find(|(_, x)| *x == softmax.max).map_or(0, |(j, _)| j);
            let column = match &mut stream {
                None => best,
                Some(stream) => {
                    let u = stream.uniform32();
                    let mut sum = 0.0;
                    free()
                        .find(|(_, x)| {
                            sum += libm::expf(softmax.log_prob(*x));
                            u < sum
                        })
                        .map_or(best, |(j, _)| j)
                }
            };
            let log_prob = softmax.log_prob(scores[column]);
            decision.log_prob += log_prob;
            log_probs.push(log_prob);
            let target = self.column_of[column];
            let (agent, goal) = if self.swapped { (target, picker) } else { (picker, target) };
            decision.goals[agent as usize] = goal;
            decision.probabilities[agent as usize] = libm::expf(log_prob);
            Some(column)
        });
        // Every turn finds a column: there are at least as many columns as turns.
        (decision, picks.unwrap_or_default(), log_probs)
    }

    /// The picks that lead to a given decision (`[N]` goals), in the order of the turns; `None` if it is not one-to-one.
    pub fn picks_of(&self, goals: &[u32]) -> Option<Vec<Pick>> {
        let mut column_with = vec![usize::MAX; self.columns];
        for (column, &target) in self.column_of.iter().enumerate() {
            *column_with.get_mut(target as usize)? = column;
        }
        let mut agent_of = vec![u32::MAX; if self.swapped { self.rows } else { 0 }];
        if self.swapped {
            for (agent, &goal) in goals.iter().enumerate().filter(|(_, goal)| **goal != u32::MAX) {
                *agent_of.get_mut(goal as usize)? = agent as u32;
            }
        }
        self.pick_in_turn(|_, picker, mask| {
            let target = if self.swapped { agent_of.get(picker as usize) } else { goals.get(picker as usize) };
            let column = *column_with.get(*target? as usize)?;
            (mask.get(column) == Some(&0.0)).then_some(column)
        })
    }

    /// Calls `pick` once for every picker, with its score row, its index and the mask of free columns.
    fn pick_in_turn(&self, mut pick: impl FnMut(usize, u32, &Mask) -> Option<usize>) -> Option<Vec<Pick>> {
        let mut mask = vec![0.0; self.columns];
        let mut picks = Vec::with_capacity(self.rows);
        let mut step = |row: usize, picker: u32, mask: &mut Vec<f32>| {
            let column = pick(row, picker, mask)?;
            mask[column] = f32::NEG_INFINITY;
            picks.push(Pick { row: row as u32, column: column as u32 });
            Some(column)
        };
        match &self.order {
            PickOrder::Given(order) => {
                for &picker in order {
                    step(0, picker, &mut mask)?;
                }
            }
            PickOrder::LargestRegret => {
                let mut regrets = Regrets::new(&self.reduced_costs, self.columns);
                while let Some(row) = regrets.largest() {
                    let column = step(row, row as u32, &mut mask)?;
                    regrets.taken(row, column, &mask);
                }
            }
        }
        Some(picks)
    }
}

/// The regret of every row that has not picked yet: what its second-best free column costs more than its best.
struct Regrets<'a> {
    reduced_costs: &'a [f32],
    columns: usize,
    /// `[rows]` second-best reduced cost; −∞ for rows that have picked.
    second: Vec<f32>,
    /// `[rows]` second best − best; −∞ for rows that have picked.
    regret: Vec<f32>,
}

impl<'a> Regrets<'a> {
    fn new(reduced_costs: &'a [f32], columns: usize) -> Self {
        let mask = vec![0.0; columns];
        let (second, regret) = reduced_costs.chunks_exact(columns).map(|row| Self::of(row, &mask)).unzip();
        Self { reduced_costs, columns, second, regret }
    }

    fn of(row: &[f32], mask: &Mask) -> (f32, f32) {
        let (best, second) = two_least(row, mask);
        (second, second - best)
    }

    fn largest(&self) -> Option<usize> {
        let mut largest = (None, f32::NEG_INFINITY);
        for (row, &regret) in self.regret.iter().enumerate() {
            if regret > largest.1 {
                largest = (Some(row), regret);
            }
        }
        largest.0
    }

    /// A row has taken a column: the regret of rows for which it was among the best two is computed anew.
    fn taken(&mut self, row: usize, column: usize, mask: &Mask) {
        (self.second[row], self.regret[row]) = (f32::NEG_INFINITY, f32::NEG_INFINITY);
        let rows = self.reduced_costs.chunks_exact(self.columns);
        for ((costs, second), regret) in rows.zip(&mut self.second).zip(&mut self.regret) {
            if costs[column] <= *second {
                (*second, *regret) = Self::of(costs, mask);
            }
        }
    }
}

/// The two smallest numbers of a row at free columns; f32::MAX where there is none.
fn two_least(row: &[f32], mask: &Mask) -> (f32, f32) {
    let (mut least, mut second) = (f32x16::splat(f32::MAX), f32x16::splat(f32::MAX));
    let mut look = |value: f32x16| {
        second = second.fast_min(least.fast_max(value));
        least = least.fast_min(value);
    };
    for (row, mask) in row.as_chunks::<LANES>().0.iter().zip(mask.as_chunks::<LANES>().0) {
        // Taken columns become +∞.
        look(f32x16::new(*row) - f32x16::new(*mask));
    }
    let (row, mask) = (row.as_chunks::<LANES>().1, mask.as_chunks::<LANES>().1);
    if !row.is_empty() {
        let mut rest = [f32::MAX; LANES];
        for ((slot, value), mask) in rest.iter_mut().zip(row).zip(mask) {
            *slot = value - mask;
        }
        look(load(&rest));
    }
    let (least, second) = (least.to_array(), second.to_array());
    least.into_iter().zip(second).fold((f32::MAX, f32::MAX), |(a, b), (least, second)| {
        if least < a { (least, if second < a { second } else { a }) } else { (a, if least < b { least } else { b }) }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use magex_core::rng::{Key, Purpose};

    /// The regret of every row is computed anew before every pick.
    fn order_by_recomputation(
        reduced_costs: &[f32],
        columns: usize,
        mut pick: impl FnMut(usize, &Mask) -> usize,
    ) -> Vec<Pick> {
        let (rows, mut mask, mut picks) = (reduced_costs.len() / columns, vec![0.0; columns], Vec::new());
        while picks.len() < rows {
            let (mut next, mut most) = (usize::MAX, f32::NEG_INFINITY);
            for row in (0..rows).filter(|&row| picks.iter().all(|p: &Pick| p.row as usize != row)) {
                let mut free: Vec<f32> =
                    (0..columns).filter(|&j| mask[j] == 0.0).map(|j| reduced_costs[row * columns + j]).collect();
                free.sort_by(f32::total_cmp);
                let regret = free.get(1).copied().unwrap_or(f32::MAX) - free[0];
                if regret > most {
                    (next, most) = (row, regret);
                }
            }
            let column = pick(next, &mask);
            mask[column] = f32::NEG_INFINITY;
            picks.push(Pick { row: next as u32, column: column as u32 });
        }
        picks
    }

    #[test]
    fn the_agent_with_the_largest_regret_picks_next() {
        for (case, (rows, columns)) in [(1, 1), (2, 2), (5, 9), (16, 16), (17, 33), (40, 40)].into_iter().enumerate() {
            // Few values, so that there are ties; and many.
            for values in [3, 1000] {
                let mut stream = Key::new(4, Purpose::Instances, &[case as u32, values]).stream();
                let reduced_costs: Vec<f32> = (0..rows * columns).map(|_| stream.below(values) as f32).collect();
                let instance = Instance {
                    features: Vec::new(),
                    reduced_costs: reduced_costs.clone(),
                    candidates: Vec::new(),
                    rows,
                    columns,
                    order: PickOrder::LargestRegret,
                    column_of: (0..columns as u32).collect(),
                    swapped: false,
                    agents: rows,
                };
                // Not always the best: the order must follow what was really taken.
                let pick =
                    |row: usize, mask: &Mask| (0..columns).map(|j| (j + 3 * row) % columns).find(|&j| mask[j] == 0.0);
                let expected = order_by_recomputation(&reduced_costs, columns, |row, mask| pick(row, mask).unwrap());
                let found = instance.pick_in_turn(|row, _, mask| pick(row, mask)).unwrap();
                assert_eq!(found, expected, "{rows} x {columns}, {values} values");
            }
        }
    }

    #[test]
    fn greedy_decisions_are_close_to_the_exact_ones_before_any_learning() {
        use super::super::{Commander, Team};
        use magex_core::config::{CommanderConfig, CommanderPolicy};
        use magex_core::ids::Mode;
        let nothing = || Key::new(0, Purpose::Commander, &[]).stream();
        for power in [1.0, 2.0] {
            let config = CommanderConfig { power, ..CommanderConfig::default() };
            let params = Commander::init(&config, 50, 2, 1).unwrap();
            let commander = Commander::of(&config, 50, 2, &params).unwrap();
            let exact = Commander::classical(CommanderPolicy::Exact).unwrap().with_power(power);
            for (n, g) in [(2, 2), (5, 5), (50, 50), (30, 60), (60, 30), (200, 200)] {
                let mut stream = Key::new(5, Purpose::Instances, &[n as u32, g as u32]).stream();
                let mut draw = |count: usize| (0..2 * count).map(|_| stream.uniform32()).collect::<Vec<f32>>();
                let (agents, goals) = (draw(n), draw(g));
                let team = Team { agents: &agents, goals: &goals, dims: 2 };
                let cost = |commander: &Commander| -> f64 {
                    let decision = commander.assign(&team, Mode::Greedy, &mut nothing()).unwrap();
                    let chosen = decision.goals.iter().enumerate().filter(|(_, goal)| **goal != u32::MAX);
                    let distance = |(i, &j): (usize, &u32)| {
                        let gap = |k: usize| f64::from(agents[2 * i + k]) - f64::from(goals[2 * j as usize + k]);
                        magex_assign::powered((gap(0).powi(2) + gap(1).powi(2)).sqrt(), power)
                    };
                    chosen.map(distance).sum()
                };
                let ratio = cost(&commander) / cost(&exact);
                assert!(ratio < 1.0 + 0.02 * power, "power {power}, {n} agents, {g} goals: {ratio}");
            }
        }
    }
}
