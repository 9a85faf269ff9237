//! The lowest of equally cheap matchings: the first agent takes the lowest goal it can, then the second one, and so on.
//!
//! Agents are the rows of the problem (or the columns, [`Exact::by_columns`]). Agent after agent looks at its lower goals: it may
//! have one if its holder finds another one, whose holder finds another one …, until the agent's own goal is taken or may stay
//! alone. Agents that have chosen are not asked again.

use super::components::Components;
use super::{Exact, Graph, NONE, Solution};
use crate::{AssignError, GoOn, Result};
use std::borrow::Cow;

/// Searches look at this many times the pairs there are, before the graph is cleared up.
const LOOKS: usize = 4;

/// Makes the solution the lowest matching of tight pairs; `spare` `[cols]` are the columns that may stay alone at no cost.
pub(super) fn lowest(
    tight: &Graph,
    spare: &[bool],
    solution: &mut Solution<'_>,
    exact: &impl Exact,
    go_on: GoOn<'_>,
) -> Result<()> {
    let mut graph = Cow::Borrowed(tight);
    let mut first = 0;
    while let Some(next) = choose(&graph, spare, first, solution, exact, go_on)? {
        // Agents that have chosen break cycles: what can lead nowhere any more is taken out.
        let left = without_chosen(&graph, next, solution, exact);
        let may_idle =
            |row: &u32| !left.of(*row as usize).is_empty() && spare[solution.col_of_row[*row as usize] as usize];
        let pooled: Vec<u32> = (0..left.rows() as u32).filter(may_idle).collect();
        graph = Cow::Owned(Components::of(&left, solution.row_of_col, &pooled).inner(&left));
        first = next;
    }
    Ok(())
}

/// Lets the agents choose from `first` on. Returns the next one where searches have become long.
fn choose(
    graph: &Graph,
    spare: &[bool],
    first: usize,
    solution: &mut Solution<'_>,
    exact: &impl Exact,
    go_on: GoOn<'_>,
) -> Result<Option<usize>> {
    if exact.by_columns() {
        let goals = transposed(graph, solution.col_price.len());
        let mut choice = Choice::new(&goals, solution.row_of_col, solution.col_of_row);
        choice.idle = Some(spare);
        return choice.run(first, &|agent, goal| exact.forbidden(goal, agent), go_on);
    }
    let mut choice = Choice::new(graph, solution.col_of_row, solution.row_of_col);
    choice.spare = Some(spare);
    choice.run(first, &|agent, goal| exact.forbidden(agent, goal), go_on)
}

/// The pairs without those of the agents before `next`, which have chosen, and of their goals. One that has none may still
/// change what stands for none.
fn without_chosen(graph: &Graph, next: usize, solution: &Solution<'_>, exact: &impl Exact) -> Graph {
    let by_columns = exact.by_columns();
    let chosen = |row: u32, col: u32| {
        let agent = if by_columns { col } else { row };
        row != NONE && col != NONE && (agent as usize) < next && !exact.forbidden(row as usize, col as usize)
    };
    let mut left = Graph::default();
    left.clear();
    for row in 0..graph.rows() as u32 {
        let own = solution.col_of_row[row as usize];
        if !chosen(row, own) {
            let open = |col: &&u32| {
                let agent = if by_columns { **col } else { row };
                let free = (agent as usize) >= next || exact.forbidden(row as usize, **col as usize);
                free && !chosen(solution.row_of_col[**col as usize], **col)
            };
            left.cols.extend(graph.of(row as usize).iter().filter(open));
        }
        left.end_row();
    }
    left
}

/// The rows of every column.
fn transposed(graph: &Graph, cols: usize) -> Graph {
    let mut start = vec![0; cols + 1];
    graph.cols.iter().for_each(|&col| start[col as usize + 1] += 1);
    for col in 0..cols {
        start[col + 1] += start[col];
    }
    let (mut next, mut rows) = (start.clone(), vec![0; graph.cols.len()]);
    for row in 0..graph.rows() {
        for &col in graph.of(row) {
            rows[next[col as usize]] = row as u32;
            next[col as usize] += 1;
        }
    }
    Graph { start, cols: rows }
}

struct Choice<'a> {
    goals: &'a Graph,
    goal_of: &'a mut [u32],
    agent_of: &'a mut [u32],
    /// Agents that may stay without a goal, if some do.
    idle: Option<&'a [bool]>,
    /// Goals that may stay without an agent, if some do.
    spare: Option<&'a [bool]>,
    /// Agents that have chosen: one with a goal keeps it, one without may only change what stands for none.
    settled: Vec<bool>,
    /// Those with a goal.
    closed: Vec<bool>,
    /// Round in which each agent was asked last, and the one in whose place it would have to go.
    asked: Vec<u32>,
    asked_by: Vec<u32>,
    /// The goal that each agent would take: NONE to stay without.
    takes: Vec<u32>,
    queue: Vec<u32>,
    /// Rounds in which the goals without agents, and the agents without goals, were reached last.
    spare_reached: u32,
    idle_reached: u32,
    /// Pairs that searches looked at.
    looked: usize,
}

impl<'a> Choice<'a> {
    fn new(goals: &'a Graph, goal_of: &'a mut [u32], agent_of: &'a mut [u32]) -> Self {
        let agents = goals.rows();
        Self {
            goals,
            goal_of,
            agent_of,
            idle: None,
            spare: None,
            settled: vec![false; agents],
            closed: vec![false; agents],
            asked: vec![0; agents],
            asked_by: vec![NONE; agents],
            takes: vec![NONE; agents],
            queue: Vec::new(),
            spare_reached: 0,
            idle_reached: 0,
            looked: 0,
        }
    }

    fn run(mut self, first: usize, forbidden: &dyn Fn(usize, usize) -> bool, go_on: GoOn<'_>) -> Result<Option<usize>> {
        let mut round = 0;
        (0..first).for_each(|agent| self.settle(agent, forbidden));
        for agent in first..self.goals.rows() {
            if self.goals.of(agent).is_empty() {
                continue;
            }
            if !go_on() {
                return Err(AssignError::Interrupted);
            }
            round += 1;
            let now = self.goal_of[agent];
            let none = now == NONE || forbidden(agent, now as usize);
            let goals = self.goals;
            let lower = goals.of(agent).iter().take_while(|&&goal| none || goal < now);
            for &goal in lower {
                let holder = self.agent_of[goal as usize];
                let kept = holder != NONE && self.closed[holder as usize];
                if !kept && !forbidden(agent, goal as usize) && self.can_have(agent as u32, goal, round, forbidden) {
                    self.exchange(agent as u32, goal);
                    break;
                }
            }
            self.settle(agent, forbidden);
            if self.looked > LOOKS * self.goals.cols.len() + 10_000 {
                return Ok(Some(agent + 1));
            }
        }
        Ok(None)
    }

    fn settle(&mut self, agent: usize, forbidden: &dyn Fn(usize, usize) -> bool) {
        let goal = self.goal_of[agent];
        self.settled[agent] = true;
        self.closed[agent] = goal != NONE && !forbidden(agent, goal as usize);
    }

    /// Whether every agent that has to make room for `agent` at `goal` finds another place; `asked_by` and `takes` then lead there.
    fn can_have(&mut self, agent: u32, goal: u32, round: u32, forbidden: &dyn Fn(usize, usize) -> bool) -> bool {
        self.queue.clear();
        if self.ask(self.agent_of[goal as usize], agent, NONE, goal, round) {
            return true;
        }
        let mut head = 0;
        while head < self.queue.len() {
            let asked = self.queue[head];
            head += 1;
            let goals = self.goals;
            self.looked += goals.of(asked as usize).len();
            let own = self.goal_of[asked as usize];
            let restricted = self.settled[asked as usize];
            let target = self.goal_of[agent as usize];
            if target != NONE && goals.of(asked as usize).binary_search(&target).is_ok() {
                // The shortest way first: it ends most searches at once.
                let allowed = !restricted || forbidden(asked as usize, target as usize);
                if allowed && self.ask(agent, agent, asked, target, round) {
                    return true;
                }
            }
            for &goal in goals.of(asked as usize) {
                if goal == own || (restricted && !forbidden(asked as usize, goal as usize)) {
                    continue;
                }
                if self.ask(self.agent_of[goal as usize], agent, asked, goal, round) {
                    return true;
                }
            }
            let may_idle = self.idle.is_some_and(|idle| idle[asked as usize]);
            if may_idle && own != NONE && self.idle_reached != round {
                self.idle_reached = round;
                for other in 0..self.goal_of.len() as u32 {
                    let without = self.goal_of[other as usize] == NONE && !self.goals.of(other as usize).is_empty();
                    if without && self.ask(other, agent, asked, NONE, round) {
                        return true;
                    }
                }
            }
        }
        false
    }

    /// Puts the holder of a goal that `by` would take into the queue; true if it is the agent that began.
    fn ask(&mut self, holder: u32, first: u32, by: u32, goal: u32, round: u32) -> bool {
        if holder == NONE {
            // A goal without an agent: instead, a goal that may stay alone loses its agent.
            let Some(spare) = self.spare.filter(|_| self.spare_reached != round) else {
                return false;
            };
            self.spare_reached = round;
            for other in 0..self.goal_of.len() as u32 {
                let own = self.goal_of[other as usize];
                if own != NONE && spare[own as usize] && self.ask(other, first, by, goal, round) {
                    return true;
                }
            }
            return false;
        }
        let at = holder as usize;
        if holder != first && (self.asked[at] == round || self.closed[at]) {
            return false;
        }
        (self.asked[at], self.asked_by[at]) = (round, by);
        if by != NONE {
            self.takes[at] = goal;
        }
        self.queue.push(holder);
        holder == first
    }

    /// Gives `agent` the goal and everyone on the way back its new place.
    fn exchange(&mut self, agent: u32, goal: u32) {
        let mut moves = vec![(agent, goal)];
        let mut at = agent;
        loop {
            let by = self.asked_by[at as usize];
            if by == NONE {
                break;
            }
            moves.push((by, self.takes[at as usize]));
            at = by;
        }
        for &(agent, _) in &moves {
            let old = self.goal_of[agent as usize];
            if old != NONE {
                self.agent_of[old as usize] = NONE;
            }
        }
        for (agent, goal) in moves {
            self.goal_of[agent as usize] = goal;
            if goal != NONE {
                self.agent_of[goal as usize] = agent;
            }
        }
    }
}
