//! Costs of the pairs of a team: distances or what replaces them, and the terms of [`crate::terms`] on top.
//!
//! The solvers see one column per place: a goal that takes several agents has as many equal columns.

use crate::UNASSIGNED;
use crate::problem::Problem;
use crate::terms::Visit;
use magex_assign::{powered, powered_square};

/// A goal that no agent gets counts as served after this many of the longest ways of the team: the one that its agent makes now,
/// and the one to it. So a goal of twice the weight or more goes first, however far it is (power 1).
const UNSERVED: f64 = 2.0;

/// Squared distance of two points.
fn square(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum()
}

/// Distances `[N, G]` between agents `[N, dims]` and goals `[G, dims]`, raised to a power.
fn distances_into(agents: &[f64], goals: &[f64], dims: usize, power: f64, costs: &mut Vec<f64>) {
    costs.clear();
    costs.reserve((agents.len() / dims.max(1)) * (goals.len() / dims.max(1)));
    for agent in agents.chunks_exact(dims.max(1)) {
        if let &[x, y] = agent {
            costs.extend(goals.as_chunks::<2>().0.iter().map(|&[gx, gy]| {
                let (dx, dy) = (x - gx, y - gy);
                dx * dx + dy * dy
            }));
        } else {
            costs.extend(goals.chunks_exact(dims.max(1)).map(|goal| square(agent, goal)));
        }
    }
    if power == 1.0 {
        costs.iter_mut().for_each(|cost| *cost = cost.sqrt());
    } else if power != 2.0 {
        costs.iter_mut().for_each(|cost| *cost = powered_square(*cost, power));
    }
}

/// Why a pair is impossible.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Obstacle {
    /// Forbidden by itself, or by its cost.
    Forbidden,
    /// The agent comes after the due time.
    Late,
    /// The goal waits for another one.
    NotOpen,
}

impl Obstacle {
    /// What a member is told that has two pairs. First what would work at another time.
    pub(crate) fn worse(one: Option<Self>, other: Option<Self>) -> Option<Self> {
        match (one, other) {
            (None, _) | (_, None) => None,
            (Some(Self::Late), _) | (_, Some(Self::Late)) => Some(Self::Late),
            (Some(Self::NotOpen), _) | (_, Some(Self::NotOpen)) => Some(Self::NotOpen),
            (forbidden, _) => forbidden,
        }
    }
}

/// An assigned pair.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PairTerms {
    /// Its cost.
    pub cost: f64,
    /// When the agent begins.
    pub arrival: f64,
}

impl Problem {
    /// Columns that the solvers see: the goal of each place. `None` if every goal takes one agent.
    pub(crate) fn places(&self) -> Option<Vec<u32>> {
        let terms = &self.terms;
        let copies = |goal: usize| (terms.capacity(goal) as usize).min(self.agent_count);
        (!terms.capacities.is_empty())
            .then(|| (0..self.goal_count).flat_map(|goal| std::iter::repeat_n(goal as u32, copies(goal))).collect())
    }

    /// S: number of places.
    pub fn place_count(&self) -> usize {
        match self.terms.capacities.is_empty() {
            true => self.goal_count,
            false => self.terms.capacities.iter().map(|&k| (k as usize).min(self.agent_count)).sum(),
        }
    }

    /// N · S.
    pub fn cells(&self) -> usize {
        self.agent_count * self.place_count()
    }

    /// Costs are powers of distances: no words of time, no weights.
    pub(crate) fn untimed(&self) -> bool {
        !self.terms.timed() && self.terms.weights.is_empty()
    }

    /// What stands for the distance of each pair, `[N, G]`, raised to a power: +∞ for forbidden pairs.
    fn base_into(&self, power: f64, costs: &mut Vec<f64>) {
        match &self.matrix {
            _ if self.only_overrides => {
                costs.clear();
                costs.resize(self.agent_count * self.goal_count, f64::INFINITY);
            }
            Some(matrix) => {
                costs.clone_from(matrix);
                if power != 1.0 {
                    costs.iter_mut().for_each(|cost| *cost = powered(*cost, power));
                }
            }
            None => distances_into(&self.agents, &self.goals, self.dims, power, costs),
        }
        for &(agent, goal, cost) in &self.overrides {
            costs[agent as usize * self.goal_count + goal as usize] = powered(cost, power);
        }
        for &(agent, goal) in &self.forbidden {
            costs[agent as usize * self.goal_count + goal as usize] = f64::INFINITY;
        }
    }

    /// What stands for the distance of each agent's pair, `[N]`, whether it is forbidden or not; +∞ without a goal. `given`: it is
    /// a cost in place of the distance.
    fn base_given(&self, goal_of: &[u32]) -> Vec<(f64, bool)> {
        let own = |(agent, &goal): (usize, &u32)| match &self.matrix {
            _ if goal == UNASSIGNED || self.only_overrides => (f64::INFINITY, true),
            Some(matrix) => (matrix[agent * self.goal_count + goal as usize], true),
            None => (self.distance(agent, goal as usize), false),
        };
        let mut base: Vec<(f64, bool)> = goal_of.iter().enumerate().map(own).collect();
        for &(agent, goal, cost) in &self.overrides {
            if goal_of[agent as usize] == goal {
                base[agent as usize] = (cost, true);
            }
        }
        base
    }

    /// The same without the origin.
    pub(crate) fn base_of(&self, goal_of: &[u32]) -> Vec<f64> {
        self.base_given(goal_of).into_iter().map(|(base, _)| base).collect()
    }

    /// Costs `[N, S]`, +∞ for impossible pairs. Returns what a place without an agent costs per unit of weight; it is taken off all
    /// costs of the place. 0 unless weights differ.
    pub fn costs_into(&self, costs: &mut Vec<f64>) -> f64 {
        self.priced_into(costs, true)
    }

    /// The same without weights.
    pub(crate) fn unweighted_into(&self, costs: &mut Vec<f64>) {
        self.priced_into(costs, false);
    }

    fn priced_into(&self, costs: &mut Vec<f64>, weighted: bool) -> f64 {
        let (terms, untimed) = (&self.terms, self.untimed());
        self.base_into(if untimed { terms.power } else { 1.0 }, costs);
        if terms.plain() || costs.is_empty() {
            return 0.0;
        }
        let unserved = if untimed { self.close(costs) } else { self.time_and_weigh(costs, weighted) };
        if let Some(places) = self.places() {
            let rows = costs.chunks_exact(self.goal_count);
            *costs = rows.flat_map(|row| places.iter().map(|&goal| row[goal as usize])).collect();
        }
        self.pin(costs);
        unserved
    }

    /// Forbids the pairs of goals that are not open.
    fn close(&self, costs: &mut [f64]) -> f64 {
        for goal in (0..self.goal_count).filter(|&goal| !self.terms.open(goal)) {
            costs.iter_mut().skip(goal).step_by(self.goal_count).for_each(|cost| *cost = f64::INFINITY);
        }
        0.0
    }

    /// Makes costs of distances, `[N, G]`.
    fn time_and_weigh(&self, costs: &mut [f64], weighted: bool) -> f64 {
        let terms = &self.terms;
        let weighted = weighted && !terms.weights.is_empty();
        let mut longest = 0.0f64;
        for (agent, row) in costs.chunks_exact_mut(self.goal_count).enumerate() {
            for (goal, cost) in row.iter_mut().enumerate() {
                let Visit { time, late, .. } = terms.visit(agent, goal, *cost);
                *cost = if late || !terms.open(goal) { f64::INFINITY } else { time };
                longest = if *cost < f64::INFINITY { longest.max(*cost) } else { longest };
            }
        }
        let unserved = if weighted && terms.weighted() { self.unserved_at(longest) } else { 0.0 };
        for row in costs.chunks_exact_mut(self.goal_count) {
            for (goal, cost) in row.iter_mut().enumerate().filter(|(_, cost)| **cost < f64::INFINITY) {
                *cost = powered(*cost, terms.power) - unserved;
                if weighted {
                    *cost *= terms.weight(goal);
                }
            }
        }
        unserved
    }

    /// What a place without an agent costs per unit of weight where the longest way takes this time.
    pub(crate) fn unserved_at(&self, longest: f64) -> f64 {
        powered(UNSERVED * longest, self.terms.power)
    }

    /// First place of every goal, `[G + 1]`.
    fn first_places(&self) -> Vec<usize> {
        let copies = |goal: usize| match self.terms.capacities.is_empty() {
            true => 1,
            false => (self.terms.capacity(goal) as usize).min(self.agent_count),
        };
        let mut next = 0;
        let after = (0..self.goal_count).map(|goal| {
            next += copies(goal);
            next
        });
        std::iter::once(0).chain(after).collect()
    }

    /// Place of each agent's current goal, `[N]`, or [`UNASSIGNED`]: pinned agents have the first places of their goal.
    pub(crate) fn current_places(&self) -> Vec<u32> {
        if self.terms.capacities.is_empty() || self.current.is_empty() {
            return self.current.clone();
        }
        let first = self.first_places();
        let mut next = first.clone();
        let mut place_of = vec![UNASSIGNED; self.agent_count];
        let mut decided = vec![false; self.agent_count];
        for &(agent, goal) in &self.terms.pinned {
            decided[agent as usize] = true;
            if self.current[agent as usize] == goal {
                place_of[agent as usize] = next[goal as usize] as u32;
            }
            next[goal as usize] += 1;
        }
        for (agent, &goal) in
            self.current.iter().enumerate().filter(|&(agent, &goal)| !decided[agent] && goal != UNASSIGNED)
        {
            let goal = goal as usize;
            if next[goal] < first[goal + 1] {
                place_of[agent] = next[goal] as u32;
                next[goal] += 1;
            }
        }
        place_of
    }

    /// Leaves the pinned pairs as the only ones of their agents and places.
    fn pin(&self, costs: &mut [f64]) {
        let places = self.place_count();
        let mut next = self.first_places();
        for &(agent, goal) in &self.terms.pinned {
            let (own, place) = (agent as usize, next[goal as usize]);
            next[goal as usize] += 1;
            let kept = costs[own * places + place];
            costs[own * places..(own + 1) * places].fill(f64::INFINITY);
            costs.iter_mut().skip(place).step_by(places).for_each(|cost| *cost = f64::INFINITY);
            costs[own * places + place] = kept;
        }
    }

    /// Cost and arrival of each agent's pair, `[N]`; nothing without a goal.
    pub fn pair_terms(&self, goal_of: &[u32]) -> Vec<PairTerms> {
        let (terms, untimed) = (&self.terms, self.untimed());
        let of = |(agent, (&goal, (base, given))): (usize, (&u32, (f64, bool)))| match goal {
            UNASSIGNED => PairTerms::default(),
            // As the solvers see it: the square of a distance is not that of its rounded root.
            _ if untimed && !given => {
                let square = self.square(agent, goal as usize);
                PairTerms { cost: powered_square(square, terms.power), arrival: base }
            }
            _ => {
                let Visit { arrival, time, .. } = terms.visit(agent, goal as usize, base);
                let cost = powered(time, terms.power);
                let cost = if terms.weights.is_empty() { cost } else { terms.weight(goal as usize) * cost };
                PairTerms { cost, arrival }
            }
        };
        goal_of.iter().zip(self.base_given(goal_of)).enumerate().map(of).collect()
    }

    /// The team for solvers that need no matrix: powers of distances, with (agent, goal, cost) of pairs that cost something else.
    /// `None` if there is more to say.
    pub(crate) fn without_matrix(&self) -> Option<Vec<(u32, u32, f64)>> {
        let terms = &self.terms;
        self.positions_only().then(|| {
            let priced = self.overrides.iter().map(|&(agent, goal, cost)| (agent, goal, powered(cost, terms.power)));
            priced.chain(self.forbidden.iter().map(|&(agent, goal)| (agent, goal, f64::INFINITY))).collect()
        })
    }

    /// Whether pairs cost powers of distances, but for those with a cost of their own.
    pub(crate) fn positions_only(&self) -> bool {
        let plain = self.terms.capacities.is_empty() && !self.terms.forbids() && self.untimed();
        plain && self.matrix.is_none() && !self.only_overrides && self.dims > 0
    }

    /// Why a pair is impossible; `base` stands for its distance.
    pub(crate) fn obstacle(&self, agent: usize, goal: usize, base: f64) -> Option<Obstacle> {
        if base == f64::INFINITY {
            Some(Obstacle::Forbidden)
        } else if !self.terms.open(goal) {
            Some(Obstacle::NotOpen)
        } else {
            self.terms.visit(agent, goal, base).late.then_some(Obstacle::Late)
        }
    }

    /// What stands in the way of every agent, and of every goal, before pins: `None` where a pair is possible.
    pub(crate) fn obstacles(&self) -> [Vec<Option<Obstacle>>; 2] {
        let mut base = Vec::new();
        self.base_into(1.0, &mut base);
        let mut agents = vec![Some(Obstacle::Forbidden); self.agent_count];
        let mut goals = vec![Some(Obstacle::Forbidden); self.goal_count];
        for (agent, row) in base.chunks_exact(self.goal_count.max(1)).enumerate() {
            for (goal, &d) in row.iter().enumerate() {
                let found = self.obstacle(agent, goal, d);
                agents[agent] = Obstacle::worse(agents[agent], found);
                goals[goal] = Obstacle::worse(goals[goal], found);
            }
        }
        // An agent that is pinned waits for its goal.
        let mut pinned = vec![UNASSIGNED; self.agent_count];
        self.terms.pinned.iter().for_each(|&(agent, goal)| pinned[agent as usize] = goal);
        for (agent, goal) in pinned.into_iter().enumerate().filter(|(_, goal)| *goal != UNASSIGNED) {
            agents[agent] = self.obstacle(agent, goal as usize, base[agent * self.goal_count + goal as usize]);
        }
        [agents, goals]
    }

    /// Distance of a pair, in the unit of the positions; 0 without positions.
    pub fn distance(&self, agent: usize, goal: usize) -> f64 {
        self.square(agent, goal).sqrt()
    }

    fn square(&self, agent: usize, goal: usize) -> f64 {
        let d = self.dims;
        let (a, g) = (self.agents.get(agent * d..(agent + 1) * d), self.goals.get(goal * d..(goal + 1) * d));
        square(a.unwrap_or_default(), g.unwrap_or_default())
    }
}
