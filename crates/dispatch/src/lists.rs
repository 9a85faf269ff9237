//! Teams without a matrix: which need none, what their pairs cost, and what stands in their way.

use crate::UNASSIGNED;
use crate::costs::Obstacle;
use crate::problem::Problem;
use magex_assign::powered;
use magex_proto::convert::ConvertError;
use magex_proto::goals::AssignmentMethod;
use std::collections::HashSet;

/// Pairs from which on a team is solved without a matrix, if it needs none.
pub(crate) const LARGE_CELLS: usize = 300_000;

/// Largest matrix, in pairs: 10,000 × 10,000.
const MATRIX_CELLS: usize = 100_000_000;

/// What a member or a listed pair takes in memory, in entries of a matrix.
const ENTRIES: usize = 16;

/// Pairs (agent, goal, cost); all others are forbidden.
pub(crate) struct Listed {
    pub(crate) pairs: Vec<(u32, u32, f64)>,
    /// Taken off all costs per unit of weight, as [`Problem::costs_into`] says.
    pub(crate) unserved: f64,
}

impl Problem {
    /// Whether a method answers this team without a matrix: exact and makespan positions with a power only, exact also sparse
    /// costs without capacities. A makespan with a switching cost needs one.
    fn needs_no_matrix(&self) -> bool {
        let exact = matches!(self.scheduler, AssignmentMethod::Exact | AssignmentMethod::Learned);
        let listed = self.only_overrides && self.terms.capacities.is_empty();
        let switches = self.switching_cost > 0.0 && self.current.iter().any(|&goal| goal != UNASSIGNED);
        let makespan = self.scheduler == AssignmentMethod::Makespan && !switches;
        self.cells() > LARGE_CELLS && ((exact && listed) || ((exact || makespan) && self.positions_only()))
    }

    /// Entries of a matrix that take as much memory as an answer: N · S, or what grows with members and listed pairs.
    pub fn memory(&self) -> usize {
        match self.needs_no_matrix() {
            true => ENTRIES * (self.agent_count + self.goal_count + self.overrides.len() + self.forbidden.len()),
            false => self.cells(),
        }
    }

    /// Refuses a team whose matrix is too large.
    pub(crate) fn check_memory(&self) -> Result<(), ConvertError> {
        ConvertError::ensure(self.memory() <= MATRIX_CELLS, || {
            let problem = format!(
                "{} agents and {} places at goals need a matrix of more than {MATRIX_CELLS} pairs; \
                 exact and makespan of positions with a power alone, and exact of sparse_costs without capacities, need none",
                self.agent_count,
                self.place_count()
            );
            ("agents", problem)
        })
    }

    /// The costs of the listed pairs, if only these are allowed and every goal takes one agent: as [`Problem::costs_into`].
    pub(crate) fn listed(&self) -> Option<Listed> {
        let terms = &self.terms;
        if !self.only_overrides || !terms.capacities.is_empty() {
            return None;
        }
        let mut pairs = self.allowed_pairs();
        let mut unserved = 0.0;
        if self.untimed() {
            pairs.retain(|&(_, goal, _)| terms.open(goal as usize));
            pairs.iter_mut().for_each(|(.., cost)| *cost = powered(*cost, terms.power));
        } else {
            let mut longest = 0.0f64;
            pairs.retain_mut(|(agent, goal, cost)| {
                let visit = terms.visit(*agent as usize, *goal as usize, *cost);
                *cost = visit.time;
                let possible = !visit.late && terms.open(*goal as usize);
                longest = if possible { longest.max(*cost) } else { longest };
                possible
            });
            unserved = if terms.weighted() { self.unserved_at(longest) } else { 0.0 };
            for (_, goal, cost) in &mut pairs {
                *cost = powered(*cost, terms.power) - unserved;
                if !terms.weights.is_empty() {
                    *cost *= terms.weight(*goal as usize);
                }
            }
        }
        let agents: HashSet<u32> = terms.pinned.iter().map(|pair| pair.0).collect();
        let goals: HashSet<u32> = terms.pinned.iter().map(|pair| pair.1).collect();
        let pinned: HashSet<&(u32, u32)> = terms.pinned.iter().collect();
        if !pinned.is_empty() {
            let free = |agent: u32, goal: u32| !agents.contains(&agent) && !goals.contains(&goal);
            pairs.retain(|&(agent, goal, _)| free(agent, goal) || pinned.contains(&(agent, goal)));
        }
        Some(Listed { pairs, unserved })
    }

    /// The pairs with a finite cost of their own, ascending; the last entry of a pair counts.
    fn allowed_pairs(&self) -> Vec<(u32, u32, f64)> {
        let mut pairs = self.overrides.clone();
        pairs.reverse();
        pairs.sort_by_key(|&(agent, goal, _)| (agent, goal));
        pairs.dedup_by_key(|&mut (agent, goal, _)| (agent, goal));
        let forbidden: HashSet<&(u32, u32)> = self.forbidden.iter().collect();
        pairs.retain(|&(agent, goal, cost)| cost < f64::INFINITY && !forbidden.contains(&(agent, goal)));
        pairs
    }

    /// [`Problem::obstacles`] of a team that needs no matrix.
    pub(crate) fn obstacles_without_matrix(&self) -> [Vec<Option<Obstacle>>; 2] {
        if self.only_overrides {
            let mut found =
                [vec![Some(Obstacle::Forbidden); self.agent_count], vec![Some(Obstacle::Forbidden); self.goal_count]];
            let mut pinned = vec![None; self.agent_count];
            self.terms.pinned.iter().for_each(|&(agent, goal)| pinned[agent as usize] = Some(goal));
            for (agent, goal, cost) in self.allowed_pairs() {
                let obstacle = self.obstacle(agent as usize, goal as usize, cost);
                // An agent that is pinned waits for its goal.
                match pinned[agent as usize] {
                    Some(own) if own == goal => found[0][agent as usize] = obstacle,
                    Some(_) => {}
                    None => found[0][agent as usize] = Obstacle::worse(found[0][agent as usize], obstacle),
                }
                found[1][goal as usize] = Obstacle::worse(found[1][goal as usize], obstacle);
            }
            return found;
        }
        // Of positions, a member is left over only where all its pairs are forbidden one by one.
        let mut forbidden: HashSet<(u32, u32)> = self.forbidden.iter().copied().collect();
        let mut last = std::collections::HashMap::new();
        self.overrides.iter().for_each(|&(agent, goal, cost)| _ = last.insert((agent, goal), cost));
        forbidden.extend(last.into_iter().filter(|(_, cost)| *cost == f64::INFINITY).map(|(pair, _)| pair));
        let (mut agents, mut goals) = (vec![0; self.agent_count], vec![0; self.goal_count]);
        for (agent, goal) in forbidden {
            agents[agent as usize] += 1;
            goals[goal as usize] += 1;
        }
        let all = |counts: Vec<usize>, of: usize| -> Vec<Option<Obstacle>> {
            counts.into_iter().map(|count| (count == of).then_some(Obstacle::Forbidden)).collect()
        };
        [all(agents, self.goal_count), all(goals, self.agent_count)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::problem::Limits;
    use crate::terms::Terms;
    use magex_core::rng::{Key, Purpose, Stream};
    use magex_proto::v1;

    /// A small team of listed pairs with some of the words.
    fn draw(chance: &mut Stream) -> Problem {
        let (n, g) = (2 + chance.below(5) as usize, 2 + chance.below(5) as usize);
        let mut terms = Terms { power: [1.0, 2.0, 1.5][chance.below(3) as usize], ..Terms::default() };
        let mut some = |count: usize, low: u32| -> Vec<f64> {
            let given = chance.below(2) == 0;
            (0..if given { count } else { 0 }).map(|_| f64::from(low + chance.below(4))).collect()
        };
        (terms.speeds, terms.offsets, terms.weights) = (some(n, 1), some(n, 0), some(g, 1));
        (terms.earliest, terms.due) = (some(g, 0), some(g, 5));
        if chance.below(3) == 0 {
            terms.closed = (0..g).map(|_| chance.below(4) == 0).collect();
        }
        let pair = |chance: &mut Stream| (chance.below(n as u32), chance.below(g as u32));
        let overrides = (0..chance.below((2 * n * g) as u32))
            .map(|_| {
                let ((agent, goal), cost) = (pair(chance), f64::from(chance.below(7)));
                (agent, goal, if cost == 6.0 { f64::INFINITY } else { cost })
            })
            .collect();
        let forbidden = (0..chance.below(3)).map(|_| pair(chance)).collect();
        if chance.below(3) == 0 {
            terms.pinned.push(pair(chance));
        }
        Problem {
            agent_count: n,
            goal_count: g,
            overrides,
            only_overrides: true,
            terms,
            forbidden,
            ..Problem::default()
        }
    }

    #[test]
    fn listed_pairs_cost_and_stand_as_in_the_matrix() {
        let mut costs = Vec::new();
        for index in 0..3000 {
            let problem = draw(&mut Key::new(27, Purpose::Bench, &[index]).stream());
            let unserved = problem.costs_into(&mut costs);
            let listed = problem.listed().unwrap();
            let mut matrix = vec![f64::INFINITY; problem.cells()];
            for (agent, goal, cost) in listed.pairs {
                matrix[agent as usize * problem.goal_count + goal as usize] = cost;
            }
            assert_eq!((matrix, listed.unserved), (costs.clone(), unserved), "{index}: {problem:?}");
            assert_eq!(problem.obstacles_without_matrix(), problem.obstacles(), "{index}: {problem:?}");
        }
    }

    #[test]
    fn members_of_positions_whose_pairs_are_all_forbidden_are_named_without_a_matrix() {
        let mut problem = Problem::of_points(vec![0.0; 6], vec![1.0; 4], 2);
        problem.forbidden = vec![(0, 0), (0, 1), (1, 0), (2, 0), (1, 0)];
        problem.overrides = vec![(2, 1, f64::INFINITY), (2, 1, 4.0)];
        assert_eq!(problem.obstacles_without_matrix(), problem.obstacles());
        problem.overrides.push((2, 1, f64::INFINITY));
        let found = problem.obstacles_without_matrix();
        assert_eq!(found, problem.obstacles());
        assert_eq!(found[0], [Some(Obstacle::Forbidden), None, Some(Obstacle::Forbidden)]);
    }

    #[test]
    fn a_large_list_is_solved_without_a_matrix() {
        let n = 1000u32;
        let overrides = (0..n).flat_map(|k| [(k, k, 2.0), (k, (k + 1) % n, 1.0)]).collect();
        let (agent_count, goal_count) = (n as usize, n as usize);
        let mut problem = Problem { agent_count, goal_count, overrides, only_overrides: true, ..Problem::default() };
        problem.terms.power = 1.0;
        assert!(problem.memory() < problem.cells() / 10);
        let plan = crate::engine::solve(&problem, AssignmentMethod::Exact, &|| true).unwrap();
        assert!((0..n).all(|k| plan.goal_of[k as usize] == (k + 1) % n));
        assert_eq!((plan.cost, plan.exact_cost), (1000.0, Some(1000.0)));
        problem.forbidden = vec![(7, 8), (7, 7)];
        let plan = crate::engine::solve(&problem, AssignmentMethod::Exact, &|| true).unwrap();
        assert_eq!((plan.goal_of[7], plan.obstacles[0][7]), (UNASSIGNED, Some(Obstacle::Forbidden)));
    }

    #[test]
    fn positions_of_twenty_thousand_need_no_matrix_and_a_matrix_that_is_too_large_is_refused() {
        let limits = Limits { members: 100_000, ..Limits::default() };
        let side = || v1::Positions { coordinates: vec![1.0; 40_000], dims: 2, ..v1::Positions::default() };
        let team = v1::AssignRequest { agents: Some(side()), goals: Some(side()), ..v1::AssignRequest::default() };
        let problem = Problem::read(team.clone(), 0, &limits).unwrap();
        assert_eq!(problem.memory(), 16 * 40_000);
        let timed = v1::AssignRequest { agent_speeds: vec![2.0; 20_000], ..team };
        let refused = Problem::read(timed, 0, &limits).unwrap_err().to_string();
        assert!(refused.contains("need a matrix of more than 100000000 pairs"), "{refused}");
    }
}
