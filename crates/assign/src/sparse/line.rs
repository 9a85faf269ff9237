//! Points on a line along an axis, as many agents as goals, costs that are their distances: nearly all pairs may be tight there.
//!
//! Through each gap between neighbouring points flow as many pairs as there are agents without a goal on one side: all cross it
//! in one direction in every best matching, and matchings in which no pair runs against the flow are best (Werman, Peleg &
//! Rosenfeld 1985). So the best matchings are known without one search: agent after agent takes the lowest goal that is left up
//! to the next gaps without flow, and the flow on its way becomes one less. n log n steps and no rounding.

use crate::fixed::Scale;
use crate::{AssignError, GoOn, Result};

/// The lowest best matching, `[rows]`, if the points are on a line along an axis and all differences of their coordinates are
/// doubles; as many agents as goals.
pub(super) fn solve<const D: usize>(
    agents: &[[f64; D]],
    goals: &[[f64; D]],
    go_on: GoOn<'_>,
) -> Option<Result<Vec<u32>>> {
    let axis = axis_of(agents, goals)?;
    let along = |point: &[f64; D]| point[axis];
    let mut places: Vec<f64> = agents.iter().chain(goals).map(along).collect();
    places.sort_unstable_by(f64::total_cmp);
    // −0 equals 0, and stands before it.
    places.dedup();
    let place = |point: &[f64; D]| places.partition_point(|x| *x < point[axis]);
    let mut goals_at = vec![Vec::new(); places.len()];
    let mut surplus = vec![0i64; places.len()];
    for (goal, point) in goals.iter().enumerate().rev() {
        goals_at[place(point)].push(goal as u32);
        surplus[place(point)] -= 1;
    }
    agents.iter().for_each(|agent| surplus[place(agent)] += 1);
    let mut sum = 0;
    let flow: Vec<i64> = surplus.iter().map(|surplus| (sum += surplus, sum).1).collect();
    let (mut flow, mut lowest) = (Flow::new(&flow), Lowest::new(&goals_at));
    let mut goal_of = Vec::with_capacity(agents.len());
    for agent in agents {
        if goal_of.len() % 1024 == 0 && !go_on() {
            return Some(Err(AssignError::Interrupted));
        }
        let own = place(agent);
        let (from, to) = flow.reach(own);
        let goal = lowest.in_range(from, to);
        let Some(point) = goals.get(goal as usize) else {
            debug_assert!(false, "the flow leads to a goal");
            return None;
        };
        let at = place(point);
        goals_at[at].pop();
        lowest.set(at, goals_at[at].last().copied().unwrap_or(u32::MAX));
        if own < at {
            flow.add(own, at, -1)
        } else {
            flow.add(at, own, 1)
        }
        goal_of.push(goal);
    }
    Some(Ok(goal_of))
}

/// The axis along which all points are, if differences along it are not rounded and neither are roots of their squares.
fn axis_of<const D: usize>(agents: &[[f64; D]], goals: &[[f64; D]]) -> Option<usize> {
    let all = || agents.iter().chain(goals);
    let first = agents.first()?;
    let varies = |axis: &usize| all().any(|point| point[*axis] != first[*axis]);
    let mut axes = (0..D).filter(varies);
    let axis = axes.next().unwrap_or(0);
    if axes.next().is_some() || agents.len() != goals.len() {
        return None;
    }
    let mut scale = Scale::default();
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for point in all() {
        scale.include(point[axis]);
        (low, high) = (low.min(point[axis]), high.max(point[axis]));
    }
    // The square of a difference of 2^-450 is no subnormal number.
    if !(-450..=400).contains(&scale.unit()) {
        return None;
    }
    let unit = f64::from_bits(((scale.unit() + 1023) as u64) << 52);
    // A range of more units than a double counts is rounded to that at least; a root of a square is the number itself.
    (high - low < unit * (1u64 << 53) as f64).then_some(axis)
}

/// The flow to the right in the gap after every place: a tree of sums with the least and the largest below each node.
struct Flow {
    size: usize,
    /// Per node: the least, the largest, and what both were changed by for all below it.
    nodes: Vec<[i64; 3]>,
}

impl Flow {
    fn new(flow: &[i64]) -> Self {
        let size = flow.len().next_power_of_two();
        let mut nodes = vec![[0; 3]; 2 * size];
        for (place, &flow) in flow.iter().enumerate() {
            nodes[size + place] = [flow, flow, 0];
        }
        let mut new = Self { size, nodes };
        (1..size).rev().for_each(|node| new.join(node));
        new
    }

    fn join(&mut self, node: usize) {
        let (one, other, change) = (self.nodes[2 * node], self.nodes[2 * node + 1], self.nodes[node][2]);
        self.nodes[node] = [one[0].min(other[0]) + change, one[1].max(other[1]) + change, change];
    }

    /// The first and the last place that pairs with the flow lead to.
    fn reach(&self, place: usize) -> (usize, usize) {
        let to = self.first(1, 0, self.size, place, 0).unwrap_or(place);
        let from = self.last(1, 0, self.size, place, 0).map_or(0, |gap| gap + 1);
        (from, to)
    }

    /// The first gap from `from` on without a flow to the right; the node has the gaps `low` to before `high`.
    fn first(&self, node: usize, low: usize, high: usize, from: usize, change: i64) -> Option<usize> {
        if high <= from || self.nodes[node][0] + change > 0 {
            return None;
        }
        if high - low == 1 {
            return Some(low);
        }
        let (middle, change) = (low + (high - low) / 2, change + self.nodes[node][2]);
        let left = self.first(2 * node, low, middle, from, change);
        left.or_else(|| self.first(2 * node + 1, middle, high, from, change))
    }

    /// The last gap before `to` without a flow to the left.
    fn last(&self, node: usize, low: usize, high: usize, to: usize, change: i64) -> Option<usize> {
        if low >= to || self.nodes[node][1] + change < 0 {
            return None;
        }
        if high - low == 1 {
            return Some(low);
        }
        let (middle, change) = (low + (high - low) / 2, change + self.nodes[node][2]);
        let right = self.last(2 * node + 1, middle, high, to, change);
        right.or_else(|| self.last(2 * node, low, middle, to, change))
    }

    /// Changes the flow of the gaps `from` to before `to`.
    fn add(&mut self, from: usize, to: usize, change: i64) {
        self.add_below(1, [0, self.size], [from, to], change);
    }

    fn add_below(&mut self, node: usize, [low, high]: [usize; 2], [from, to]: [usize; 2], change: i64) {
        if to <= low || high <= from {
            return;
        }
        if from <= low && high <= to {
            self.nodes[node].iter_mut().for_each(|value| *value += change);
            return;
        }
        let middle = low + (high - low) / 2;
        self.add_below(2 * node, [low, middle], [from, to], change);
        self.add_below(2 * node + 1, [middle, high], [from, to], change);
        self.join(node);
    }
}

/// The lowest goal that is left at every place: a tree of minima.
struct Lowest {
    size: usize,
    nodes: Vec<u32>,
}

impl Lowest {
    /// Of the goals at every place, the lowest last.
    fn new(goals_at: &[Vec<u32>]) -> Self {
        let size = goals_at.len().next_power_of_two();
        let mut new = Self { size, nodes: vec![u32::MAX; 2 * size] };
        for (place, goals) in goals_at.iter().enumerate() {
            new.nodes[size + place] = goals.last().copied().unwrap_or(u32::MAX);
        }
        (1..size).rev().for_each(|node| new.join(node));
        new
    }

    fn join(&mut self, node: usize) {
        self.nodes[node] = self.nodes[2 * node].min(self.nodes[2 * node + 1]);
    }

    fn set(&mut self, place: usize, goal: u32) {
        let mut node = self.size + place;
        self.nodes[node] = goal;
        while node > 1 {
            node /= 2;
            self.join(node);
        }
    }

    /// The lowest one from one place to another.
    fn in_range(&self, from: usize, to: usize) -> u32 {
        let (mut low, mut high, mut lowest) = (self.size + from, self.size + to + 1, u32::MAX);
        while low < high {
            if low % 2 == 1 {
                lowest = lowest.min(self.nodes[low]);
                low += 1;
            }
            if high % 2 == 1 {
                high -= 1;
                lowest = lowest.min(self.nodes[high]);
            }
            (low, high) = (low / 2, high / 2);
        }
        lowest
    }
}
