//! The lowest of equally cheap flows: agent after agent takes the lowest goal that its place can have.
//!
//! A place of agents can have a goal of another place if it has flow there, or if a cycle of tight arcs brings some: its agents
//! take from those that have flow there, which take from others …, until one takes what the first place gives up. All agents of
//! a place are alike until they choose, and choices leave less and less, so what one of them cannot have, the later ones cannot
//! have either.

use crate::strongly_connected::strongly_connected;
use crate::ties::NONE;
use crate::{AssignError, GoOn, Result, UNASSIGNED};
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Searches look at this many times the arcs there are, before those that are in no cycle any more are taken out.
const LOOKS: usize = 4;

/// A tight arc from a place of agents to a place of goals.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tight {
    pub(super) agents: u32,
    pub(super) goals: u32,
    pub(super) flow: u64,
}

/// Arcs by one of their ends.
struct Side {
    start: Vec<usize>,
    arcs: Vec<u32>,
}

impl Side {
    fn new(arcs: &[Tight], count: usize, end: impl Fn(&Tight) -> u32, alive: &[bool]) -> Self {
        let mut start = vec![0; count + 1];
        let kept = || (0u32..).zip(arcs).filter(|(arc, _)| alive[*arc as usize]);
        kept().for_each(|(_, arc)| start[end(arc) as usize + 1] += 1);
        (0..count).for_each(|place| start[place + 1] += start[place]);
        let (mut next, mut by_end) = (start.clone(), vec![0; start[count]]);
        for (arc, tight) in kept() {
            let slot = &mut next[end(tight) as usize];
            by_end[*slot] = arc;
            *slot += 1;
        }
        Self { start, arcs: by_end }
    }

    fn of(&self, place: u32) -> &[u32] {
        &self.arcs[self.start[place as usize]..self.start[place as usize + 1]]
    }
}

/// Chooses. `agents` are the places of the agents, one after the other; `goals` the goals of every place, ascending. One more
/// place of agents stands for none, and one more place of goals.
pub(super) fn lowest(
    arcs: Vec<Tight>,
    agents: &[u32],
    goals: &[&[u32]],
    places: [usize; 2],
    go_on: GoOn<'_>,
) -> Result<Option<Vec<u32>>> {
    let mut choice = Choice::new(arcs, goals, places);
    choice.prune();
    let mut goal_of = Vec::with_capacity(agents.len());
    for &place in agents {
        if !go_on() {
            return Err(AssignError::Interrupted);
        }
        let Some(goal) = choice.choose(place) else {
            debug_assert!(false, "every agent has flow");
            return Ok(None);
        };
        goal_of.push(goal);
        if choice.looked > LOOKS * choice.from.arcs.len() + 10_000 {
            choice.prune();
        }
    }
    Ok(Some(goal_of))
}

struct Choice<'a> {
    arcs: Vec<Tight>,
    alive: Vec<bool>,
    from: Side,
    to: Side,
    goals: &'a [&'a [u32]],
    /// How many goals of each place are taken.
    taken: Vec<usize>,
    /// Of every place of agents its arcs, by the lowest goal that they led to when they were put here.
    heaps: Vec<BinaryHeap<Reverse<(u32, u32)>>>,
    round: u32,
    /// The round in which a place was met last, and over which arc.
    met_agents: Vec<u32>,
    met_goals: Vec<u32>,
    over_agents: Vec<u32>,
    over_goals: Vec<u32>,
    /// The round in which a place of goals has flow of the place that chooses, and over which arc.
    target: Vec<u32>,
    target_arc: Vec<u32>,
    queue: Vec<u32>,
    /// Arcs that searches looked at since the last clearing.
    looked: usize,
}

impl<'a> Choice<'a> {
    fn new(arcs: Vec<Tight>, goals: &'a [&'a [u32]], [agents, places]: [usize; 2]) -> Self {
        let alive = vec![true; arcs.len()];
        let mut heaps = vec![Vec::new(); agents];
        for (arc, tight) in (0u32..).zip(&arcs) {
            // Where goals stand for none, they come last.
            let first = goals.get(tight.goals as usize).and_then(|goals| goals.first()).copied();
            heaps[tight.agents as usize].push(Reverse((first.unwrap_or(UNASSIGNED), arc)));
        }
        Self {
            from: Side::new(&arcs, agents, |arc| arc.agents, &alive),
            to: Side::new(&arcs, places, |arc| arc.goals, &alive),
            arcs,
            alive,
            goals,
            taken: vec![0; places],
            heaps: heaps.into_iter().map(BinaryHeap::from).collect(),
            round: 0,
            met_agents: vec![0; agents],
            met_goals: vec![0; places],
            over_agents: vec![NONE; agents],
            over_goals: vec![NONE; places],
            target: vec![0; places],
            target_arc: vec![NONE; places],
            queue: Vec::new(),
            looked: 0,
        }
    }

    /// The lowest goal that the next agent of a place can have.
    fn choose(&mut self, place: u32) -> Option<u32> {
        while let Some(Reverse((goal, arc))) = self.heaps[place as usize].pop() {
            let at = arc as usize;
            let to = self.arcs[at].goals as usize;
            if !self.alive[at] {
                continue;
            }
            let now = match self.goals.get(to) {
                None => UNASSIGNED,
                Some(goals) => match goals.get(self.taken[to]) {
                    Some(&now) => now,
                    None => continue,
                },
            };
            if now != goal {
                self.heaps[place as usize].push(Reverse((now, arc)));
                continue;
            }
            if self.arcs[at].flow == 0 && !self.bring(arc) {
                self.alive[at] = false;
                continue;
            }
            self.arcs[at].flow -= 1;
            self.taken[to] += 1;
            self.heaps[place as usize].push(Reverse((now, arc)));
            return Some(now);
        }
        None
    }

    /// Moves one unit of flow to an arc, along a cycle; whether there is one.
    fn bring(&mut self, arc: u32) -> bool {
        let Tight { agents: place, goals: first, .. } = self.arcs[arc as usize];
        self.round += 1;
        for &own in self.from.of(place) {
            if self.arcs[own as usize].flow > 0 {
                let at = self.arcs[own as usize].goals as usize;
                (self.target[at], self.target_arc[at]) = (self.round, own);
            }
        }
        self.looked += self.from.of(place).len();
        self.queue.clear();
        self.queue.push(first);
        self.met_goals[first as usize] = self.round;
        self.met_agents[place as usize] = self.round;
        let mut head = 0;
        while head < self.queue.len() {
            let goals = self.queue[head];
            head += 1;
            if self.target[goals as usize] == self.round {
                self.exchange(arc, goals);
                return true;
            }
            self.looked += self.to.of(goals).len();
            for &held in self.to.of(goals) {
                let holder = self.arcs[held as usize].agents;
                if self.arcs[held as usize].flow == 0 || self.met_agents[holder as usize] == self.round {
                    continue;
                }
                self.met_agents[holder as usize] = self.round;
                self.over_agents[holder as usize] = held;
                self.looked += self.from.of(holder).len();
                for &next in self.from.of(holder) {
                    let to = self.arcs[next as usize].goals;
                    if self.met_goals[to as usize] == self.round || !self.alive[next as usize] {
                        continue;
                    }
                    self.met_goals[to as usize] = self.round;
                    self.over_goals[to as usize] = next;
                    if self.target[to as usize] == self.round {
                        self.exchange(arc, to);
                        return true;
                    }
                    self.queue.push(to);
                }
            }
        }
        false
    }

    /// Moves one unit of flow along the cycle that a search has found, whose last place of goals is `last`.
    fn exchange(&mut self, arc: u32, last: u32) {
        let first = self.arcs[arc as usize].goals;
        self.arcs[self.target_arc[last as usize] as usize].flow -= 1;
        let mut goals = last;
        while goals != first {
            let gains = self.over_goals[goals as usize] as usize;
            self.arcs[gains].flow += 1;
            let loses = self.over_agents[self.arcs[gains].agents as usize] as usize;
            self.arcs[loses].flow -= 1;
            goals = self.arcs[loses].goals;
        }
        self.arcs[arc as usize].flow += 1;
    }

    /// Takes out the arcs without flow that are in no cycle.
    fn prune(&mut self) {
        let of = self.components();
        let agents = self.met_agents.len();
        for (arc, tight) in self.arcs.iter().enumerate() {
            let inside = of[tight.agents as usize] == of[agents + tight.goals as usize];
            self.alive[arc] &= tight.flow > 0 || inside;
        }
        self.from = Side::new(&self.arcs, agents, |arc| arc.agents, &self.alive);
        self.to = Side::new(&self.arcs, self.met_goals.len(), |arc| arc.goals, &self.alive);
        self.looked = 0;
    }

    /// The strongly connected component of every place of agents and, behind them, of goals. Agents lead to goals over every arc,
    /// goals back over those with flow.
    fn components(&self) -> Vec<u32> {
        let agents = self.met_agents.len() as u32;
        let out = |node: u32, at: usize| {
            let forward = node < agents;
            let arcs = if forward { self.from.of(node) } else { self.to.of(node - agents) };
            let &arc = arcs.get(at)?;
            let tight = &self.arcs[arc as usize];
            let counts = self.alive[arc as usize] && (forward || tight.flow > 0);
            Some(counts.then_some(if forward { agents + tight.goals } else { tight.agents }))
        };
        strongly_connected(self.met_agents.len() + self.met_goals.len(), out).0
    }
}
