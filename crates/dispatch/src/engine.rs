//! Solving a team's problem: every scheduler but the learned one, and the check of what that one says.
//!
//! Stickiness: a pair that an agent has now is cheaper by the switching cost s. The exact answer on these costs minimises
//! (summed cost) + s · (agents that leave the pair they have). Also with s = 0, pairs are not exchanged for equal ones.
//! The learned scheduler knows nothing of what was before: of its answer only what is worth the switches is taken.

mod sticky;

use crate::problem::Problem;
use crate::{DispatchError, UNASSIGNED};
use magex_assign::random::random_allowed;
use magex_assign::{AssignError, BottleneckSolver, Solver, cost_of, greedy_allowed};
use magex_core::rng::{Key, Purpose};
use magex_proto::goals::SchedulerKind;
use std::cell::RefCell;

/// Up to so many pairs the least possible cost is computed beside an answer that is not exact.
pub const GAP_CELLS: usize = 1_000_000;

/// Memory of larger problems is given back at once.
const KEPT_CELLS: usize = 300_000;

/// An answer: a valid matching.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// `[N]` goal of each agent, or [`UNASSIGNED`].
    pub goal_of: Vec<u32>,
    /// `[N]` probability of each choice (learned only); none for a pair that was kept against it.
    pub probabilities: Option<Vec<Option<f32>>>,
    /// What answered.
    pub scheduler: SchedulerKind,
    /// Summed cost.
    pub cost: f64,
    /// Least summed cost possible, if there was time to find it and the answer has as many pairs.
    pub exact_cost: Option<f64>,
    /// `[N]` cost of each agent's pair; 0 without one.
    pub pair_costs: Vec<f64>,
    /// Which members without a partner have only forbidden pairs.
    pub hopeless: Hopeless,
}

/// Members all of whose pairs are forbidden.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Hopeless {
    /// Agents, ascending.
    pub agents: Vec<u32>,
    /// Goals, ascending.
    pub goals: Vec<u32>,
}

/// Memory that is reused from problem to problem.
#[derive(Debug, Default)]
pub struct Workspace {
    solver: Solver,
    makespan: BottleneckSolver,
    costs: Vec<f64>,
    adjusted: Vec<f64>,
}

thread_local! {
    static WORKSPACE: RefCell<Workspace> = RefCell::default();
}

/// Solves with the memory of this thread. `go_on` is asked now and then.
///
/// # Errors
/// [`DispatchError::Interrupted`] when `go_on` says no.
pub fn solve(problem: &Problem, kind: SchedulerKind, go_on: &dyn Fn() -> bool) -> Result<Plan, DispatchError> {
    WORKSPACE.with_borrow_mut(|workspace| {
        let plan = workspace.solve(problem, kind, go_on);
        workspace.forget();
        plan
    })
}

/// What the learned scheduler said, made into a plan.
///
/// # Errors
/// Why it is not a valid matching, in words for a fallback's reason.
pub fn adopt(
    problem: &Problem,
    goals: Vec<Option<u32>>,
    probabilities: Option<Vec<f32>>,
    go_on: &dyn Fn() -> bool,
) -> Result<Plan, String> {
    check(problem, &goals, probabilities.as_deref())?;
    WORKSPACE.with_borrow_mut(|workspace| {
        let plan = workspace.adopt(problem, goals, probabilities, go_on);
        workspace.forget();
        plan
    })
}

/// Why the learned scheduler need not be asked.
pub fn not_for_learned(problem: &Problem) -> Option<&'static str> {
    if problem.matrix.is_some() || !problem.overrides.is_empty() {
        return Some("the learned scheduler knows positions, not costs");
    }
    (learned_cells(problem) > GAP_CELLS).then_some("more than the learned scheduler's 1,000 agents or goals")
}

/// Pairs that the learned scheduler looks at: it fills the smaller side up.
pub fn learned_cells(problem: &Problem) -> usize {
    problem.agent_count.max(problem.goal_count).pow(2)
}

impl Workspace {
    fn forget(&mut self) {
        self.solver.forget_beyond(KEPT_CELLS);
        self.makespan.forget_beyond(KEPT_CELLS);
        for buffer in [&mut self.costs, &mut self.adjusted] {
            if buffer.capacity() > KEPT_CELLS {
                *buffer = Vec::new();
            }
        }
    }

    fn solve(
        &mut self,
        problem: &Problem,
        kind: SchedulerKind,
        go_on: &dyn Fn() -> bool,
    ) -> Result<Plan, DispatchError> {
        let (rows, cols) = (problem.agent_count, problem.goal_count);
        problem.costs_into(&mut self.costs)?;
        let sticky = self.adjust(problem);
        let Self { solver, makespan, costs, adjusted } = self;
        let target: &[f64] = if sticky { adjusted } else { costs };
        let mut exact_cost = None;
        let goal_of = match kind {
            // Learned counts as exact: it is what stands in for it.
            SchedulerKind::Exact | SchedulerKind::Learned => {
                let answer = solver.solve_allowed(target, rows, cols, go_on).map_err(refused)?;
                exact_cost = (!sticky).then_some(answer.cost);
                answer.col_of_row
            }
            SchedulerKind::Makespan => {
                makespan.solve_allowed(target, rows, cols, go_on).map_err(refused)?.assignment.col_of_row
            }
            SchedulerKind::Greedy => greedy_allowed(target, rows, cols, go_on).map_err(refused)?.col_of_row,
            SchedulerKind::Random => {
                let mut stream = Key::new(problem.seed, Purpose::Request, &[]).stream();
                random_allowed(costs, rows, cols, &mut stream, go_on).map_err(refused)?
            }
        };
        let kind = if kind == SchedulerKind::Learned { SchedulerKind::Exact } else { kind };
        self.finish(problem, goal_of, None, kind, exact_cost, go_on)
    }

    fn adopt(
        &mut self,
        problem: &Problem,
        goals: Vec<Option<u32>>,
        probabilities: Option<Vec<f32>>,
        go_on: &dyn Fn() -> bool,
    ) -> Result<Plan, String> {
        let cols = problem.goal_count;
        problem.costs_into(&mut self.costs).map_err(|error| error.to_string())?;
        let wish: Vec<u32> = goals.into_iter().map(|goal| goal.unwrap_or(UNASSIGNED)).collect();
        let forbidden = pairs(&wish).find(|&(agent, goal)| self.costs[agent * cols + goal] == f64::INFINITY);
        if let Some((agent, goal)) = forbidden {
            return Err(format!("the model chose the forbidden pair of agent {agent} and goal {goal}"));
        }
        let mut goal_of = wish.clone();
        if self.adjust(problem) {
            goal_of = sticky::follow(&wish, &self.adjusted, cols, &problem.current, &mut self.solver, go_on)
                .map_err(|error| refused(error).to_string())?;
        }
        let own = |(agent, p): (usize, f32)| (goal_of[agent] == wish[agent]).then_some(p);
        let probabilities = probabilities.map(|all| all.into_iter().enumerate().map(own).collect());
        self.finish(problem, goal_of, probabilities, SchedulerKind::Learned, None, go_on)
            .map_err(|error| error.to_string())
    }

    /// Fills the adjusted costs if there is anything to stick to.
    fn adjust(&mut self, problem: &Problem) -> bool {
        let Self { costs, adjusted, .. } = self;
        let cols = problem.goal_count;
        if problem.current.iter().all(|&goal| goal == UNASSIGNED) {
            return false;
        }
        adjusted.clear();
        adjusted.extend_from_slice(costs);
        sticky::favour(adjusted, cols, &problem.current, problem.switching_cost);
        true
    }

    fn finish(
        &mut self,
        problem: &Problem,
        goal_of: Vec<u32>,
        probabilities: Option<Vec<Option<f32>>>,
        scheduler: SchedulerKind,
        exact_cost: Option<f64>,
        go_on: &dyn Fn() -> bool,
    ) -> Result<Plan, DispatchError> {
        let (rows, cols) = (problem.agent_count, problem.goal_count);
        let Self { solver, costs, .. } = self;
        let cost = cost_of(costs, cols, &goal_of);
        let exact_cost = match exact_cost {
            Some(exact) => Some(exact),
            None if rows * cols <= GAP_CELLS => {
                match solver.solve_allowed(costs, rows, cols, go_on) {
                    Ok(exact) => (exact.pairs().count() == pairs(&goal_of).count()).then_some(exact.cost),
                    // The answer is there; how far it is from the best is not worth losing it.
                    Err(AssignError::Interrupted) => None,
                    Err(other) => return Err(refused(other)),
                }
            }
            None => None,
        };
        let cost_of_pair = |(agent, &goal): (usize, &u32)| match goal {
            UNASSIGNED => 0.0,
            goal => costs[agent * cols + goal as usize],
        };
        let pair_costs = goal_of.iter().enumerate().map(cost_of_pair).collect();
        let hopeless = if problem.forbidden.is_empty() { Hopeless::default() } else { hopeless(costs, rows, cols) };
        Ok(Plan { goal_of, probabilities, scheduler, cost, exact_cost, pair_costs, hopeless })
    }
}

fn hopeless(costs: &[f64], rows: usize, cols: usize) -> Hopeless {
    let mut goals = vec![true; cols];
    let mut found = Hopeless::default();
    for (agent, row) in costs.chunks_exact(cols).take(rows).enumerate() {
        let mut none = true;
        for (cost, goal) in row.iter().zip(&mut goals) {
            if *cost < f64::INFINITY {
                (none, *goal) = (false, false);
            }
        }
        if none {
            found.agents.push(agent as u32);
        }
    }
    found.goals = (0..cols as u32).filter(|&goal| goals[goal as usize]).collect();
    found
}

/// (agent, goal) of every pair, agents ascending.
pub(crate) fn pairs(goal_of: &[u32]) -> impl Iterator<Item = (usize, usize)> + '_ {
    goal_of.iter().enumerate().filter(|(_, goal)| **goal != UNASSIGNED).map(|(agent, &goal)| (agent, goal as usize))
}

fn refused(error: AssignError) -> DispatchError {
    match error {
        AssignError::Interrupted => DispatchError::Interrupted,
        // Cannot happen with a problem that was read; said rather than hidden.
        other => DispatchError::invalid("costs", other.to_string()),
    }
}

/// One goal for every agent, or every goal an agent, and none twice.
fn check(problem: &Problem, goals: &[Option<u32>], probabilities: Option<&[f32]>) -> Result<(), String> {
    let (n, g) = (problem.agent_count, problem.goal_count);
    if goals.len() != n || probabilities.is_some_and(|p| p.len() != n) {
        return Err(format!("the model answered for {} agents of {n}", goals.len()));
    }
    if let Some(p) = probabilities.into_iter().flatten().find(|p| !(0.0..=1.0).contains(*p)) {
        return Err(format!("the model gave the probability {p}"));
    }
    let mut taken = vec![false; g];
    for goal in goals.iter().flatten() {
        match taken.get_mut(*goal as usize) {
            Some(taken) if !*taken => *taken = true,
            _ => return Err(format!("the model gave goal {goal} twice, or it does not exist")),
        }
    }
    let given = taken.iter().filter(|taken| **taken).count();
    if given != n.min(g) {
        return Err(format!("the model gave {given} goals where {} can be given", n.min(g)));
    }
    Ok(())
}
