//! A team as a learned scheduler sees it, and decisions on it: picks, one after the other.

use super::Decision;
use crate::ops::{MaskedSoftmax, Open, Pick};
use crate::simd::{LANES, load};
use magex_core::rng::Stream;
use wide::f32x16;

/// What a learned scheduler sees of a team, computed once.
#[derive(Debug, Clone)]
pub struct Instance {
    /// Network input.
    pub(super) features: Vec<f32>,
    /// [rows, columns] what a pair costs more than the row's best (`pairwise` only); the scores are this, refined.
    pub(super) reduced: Vec<f32>,
    /// Places in the score matrix that the network looks at (`pairwise` only), one per row of the features.
    pub(super) looked_at: Vec<u32>,
    /// Rows of the score matrix (1 for `ranking`).
    pub(super) rows: usize,
    /// Columns of the score matrix.
    pub(super) columns: usize,
    /// Who picks when.
    pub(super) turns: Turns,
    /// Column → goal (or agent, when goals pick agents because there are fewer of them).
    pub(super) column_of: Vec<u32>,
    /// Goals pick agents.
    pub(super) swapped: bool,
    pub(super) agents: usize,
}

/// Who picks when.
#[derive(Debug, Clone)]
pub(super) enum Turns {
    /// One score row for all; these pick in this order.
    Given(Vec<u32>),
    /// A score row each; the next is whoever has most to lose: the largest difference between the best and the second-best
    /// reduced cost among the columns that are still free, ties by index. It does not depend on the weights, so the
    /// likelihood of a decision is that of its picks.
    MostToLose,
}

impl Instance {
    /// Places of the score matrix.
    pub(super) fn cells(&self) -> usize {
        self.rows * self.columns
    }

    /// Picks in turn: the best free column, or a sample. Returns the decision and its picks.
    pub fn decide(&self, scores: &[f32], mut stream: Option<&mut Stream>) -> (Decision, Vec<Pick>) {
        let mut decision =
            Decision { goals: vec![u32::MAX; self.agents], log_prob: 0.0, probabilities: vec![0.0; self.agents] };
        let picks = self.pick_in_turn(|row, who, open| {
            let scores = &scores[row * self.columns..(row + 1) * self.columns];
            let softmax = MaskedSoftmax::of(scores, open);
            let free = || {
                scores.iter().zip(open).enumerate().filter(|(_, (_, open))| **open == 0.0).map(|(j, (x, _))| (j, *x))
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
            let target = self.column_of[column];
            let (agent, goal) = if self.swapped { (target, who) } else { (who, target) };
            decision.goals[agent as usize] = goal;
            decision.probabilities[agent as usize] = libm::expf(log_prob);
            Some(column)
        });
        // Every turn finds a column: there are at least as many as turns.
        (decision, picks.unwrap_or_default())
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
        self.pick_in_turn(|_, who, open| {
            let target = if self.swapped { agent_of.get(who as usize) } else { goals.get(who as usize) };
            let column = *column_with.get(*target? as usize)?;
            (open.get(column) == Some(&0.0)).then_some(column)
        })
    }

    /// Lets everybody pick: `pick` is told the score row, whose turn it is, and what is free.
    fn pick_in_turn(&self, mut pick: impl FnMut(usize, u32, &Open) -> Option<usize>) -> Option<Vec<Pick>> {
        let mut open = vec![0.0; self.columns];
        let mut picks = Vec::with_capacity(self.rows);
        let mut step = |row: usize, who: u32, open: &mut Vec<f32>| {
            let column = pick(row, who, open)?;
            open[column] = f32::NEG_INFINITY;
            picks.push(Pick { row: row as u32, column: column as u32 });
            Some(column)
        };
        match &self.turns {
            Turns::Given(order) => {
                for &who in order {
                    step(0, who, &mut open)?;
                }
            }
            Turns::MostToLose => {
                let mut losses = Losses::new(&self.reduced, self.columns);
                while let Some(row) = losses.largest() {
                    let column = step(row, row as u32, &mut open)?;
                    losses.taken(row, column, &open);
                }
            }
        }
        Some(picks)
    }
}

/// What every row that has not picked yet loses if it has to do with its second-best free column.
struct Losses<'a> {
    reduced: &'a [f32],
    columns: usize,
    /// `[rows]` second-best reduced cost; −∞ for rows that have picked.
    second: Vec<f32>,
    /// `[rows]` second best − best; −∞ for rows that have picked.
    loss: Vec<f32>,
}

impl<'a> Losses<'a> {
    fn new(reduced: &'a [f32], columns: usize) -> Self {
        let open = vec![0.0; columns];
        let (second, loss) = reduced.chunks_exact(columns).map(|row| Self::of(row, &open)).unzip();
        Self { reduced, columns, second, loss }
    }

    fn of(row: &[f32], open: &Open) -> (f32, f32) {
        let (best, second) = two_least(row, open);
        (second, second - best)
    }

    fn largest(&self) -> Option<usize> {
        let mut largest = (None, f32::NEG_INFINITY);
        for (row, &loss) in self.loss.iter().enumerate() {
            if loss > largest.1 {
                largest = (Some(row), loss);
            }
        }
        largest.0
    }

    /// A row has taken a column: rows for which it was among the best two look again.
    fn taken(&mut self, row: usize, column: usize, open: &Open) {
        (self.second[row], self.loss[row]) = (f32::NEG_INFINITY, f32::NEG_INFINITY);
        let rows = self.reduced.chunks_exact(self.columns);
        for ((costs, second), loss) in rows.zip(&mut self.second).zip(&mut self.loss) {
            if costs[column] <= *second {
                (*second, *loss) = Self::of(costs, open);
            }
        }
    }
}

/// The two smallest numbers of a row at free columns; f32::MAX where there is none.
fn two_least(row: &[f32], open: &Open) -> (f32, f32) {
    let (mut least, mut second) = (f32x16::splat(f32::MAX), f32x16::splat(f32::MAX));
    let mut look = |value: f32x16| {
        second = second.fast_min(least.fast_max(value));
        least = least.fast_min(value);
    };
    for (row, open) in row.as_chunks::<LANES>().0.iter().zip(open.as_chunks::<LANES>().0) {
        // Taken columns become +∞.
        look(f32x16::new(*row) - f32x16::new(*open));
    }
    let (row, open) = (row.as_chunks::<LANES>().1, open.as_chunks::<LANES>().1);
    if !row.is_empty() {
        let mut rest = [f32::MAX; LANES];
        for ((slot, value), open) in rest.iter_mut().zip(row).zip(open) {
            *slot = value - open;
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

    /// Everybody looks at everything before every pick.
    fn order_by_looking_again(
        reduced: &[f32],
        columns: usize,
        mut pick: impl FnMut(usize, &Open) -> usize,
    ) -> Vec<Pick> {
        let (rows, mut open, mut picks) = (reduced.len() / columns, vec![0.0; columns], Vec::new());
        while picks.len() < rows {
            let (mut next, mut most) = (usize::MAX, f32::NEG_INFINITY);
            for row in (0..rows).filter(|&row| picks.iter().all(|p: &Pick| p.row as usize != row)) {
                let mut free: Vec<f32> =
                    (0..columns).filter(|&j| open[j] == 0.0).map(|j| reduced[row * columns + j]).collect();
                free.sort_by(f32::total_cmp);
                let loss = free.get(1).copied().unwrap_or(f32::MAX) - free[0];
                if loss > most {
                    (next, most) = (row, loss);
                }
            }
            let column = pick(next, &open);
            open[column] = f32::NEG_INFINITY;
            picks.push(Pick { row: next as u32, column: column as u32 });
        }
        picks
    }

    #[test]
    fn whoever_has_most_to_lose_picks_next() {
        for (case, (rows, columns)) in [(1, 1), (2, 2), (5, 9), (16, 16), (17, 33), (40, 40)].into_iter().enumerate() {
            // Few values, so that there are ties; and many.
            for values in [3, 1000] {
                let mut stream = Key::new(4, Purpose::Instances, &[case as u32, values]).stream();
                let reduced: Vec<f32> = (0..rows * columns).map(|_| stream.below(values) as f32).collect();
                let instance = Instance {
                    features: Vec::new(),
                    reduced: reduced.clone(),
                    looked_at: Vec::new(),
                    rows,
                    columns,
                    turns: Turns::MostToLose,
                    column_of: (0..columns as u32).collect(),
                    swapped: false,
                    agents: rows,
                };
                // Not always the best: the order must follow what was really taken.
                let pick =
                    |row: usize, open: &Open| (0..columns).map(|j| (j + 3 * row) % columns).find(|&j| open[j] == 0.0);
                let expected = order_by_looking_again(&reduced, columns, |row, open| pick(row, open).unwrap());
                let found = instance.pick_in_turn(|row, _, open| pick(row, open)).unwrap();
                assert_eq!(found, expected, "{rows} x {columns}, {values} values");
            }
        }
    }

    #[test]
    fn greedy_decisions_are_close_to_the_exact_ones_before_any_learning() {
        use super::super::{Commander, Team};
        use magex_core::config::CommanderConfig;
        use magex_core::ids::Mode;
        let config = CommanderConfig::default();
        let params = Commander::start(&config, 50, 2, 1).unwrap();
        let commander = Commander::build(&config, 50, 2, &mut params.source(params.plain().unwrap())).unwrap();
        for (n, g) in [(2, 2), (5, 5), (50, 50), (30, 60), (60, 30), (200, 200)] {
            let mut stream = Key::new(5, Purpose::Instances, &[n as u32, g as u32]).stream();
            let mut draw = |count: usize| (0..2 * count).map(|_| stream.uniform32()).collect::<Vec<f32>>();
            let (agents, goals) = (draw(n), draw(g));
            let decision = commander
                .assign(
                    &Team { agents: &agents, goals: &goals, dims: 2 },
                    Mode::Greedy,
                    &mut Key::new(0, Purpose::Commander, &[]).stream(),
                )
                .unwrap();
            let distance = |(i, &j): (usize, &u32)| {
                let gap = |k: usize| f64::from(agents[2 * i + k]) - f64::from(goals[2 * j as usize + k]);
                gap(0).hypot(gap(1))
            };
            let cost: f64 = decision.goals.iter().enumerate().filter(|(_, j)| **j != u32::MAX).map(distance).sum();
            let exact = magex_assign::exact_points(&agents, &goals, 2).unwrap().1;
            assert!(cost / exact < 1.02, "{n} agents, {g} goals: {}", cost / exact);
        }
    }
}
