//! Solves a team's problem by every method but the learned one, and checks the answer of the learned one.
//!
//! Switching cost: the current pair of an agent is cheaper by s. The exact solution of these costs minimises
//! (summed cost) + s · (number of agents that leave their pair). Pairs are not exchanged for equally cheap ones, even with s = 0.
//! The learned method ignores current pairs: of its answer, only changes that save more than their switching costs are applied.

mod sticky;

use crate::UNASSIGNED;
use crate::problem::Problem;
use magex_assign::random::random_allowed;
use magex_assign::{AssignError, BottleneckSolver, Solver, cost_of, greedy, pairs};
use magex_core::rng::{Key, Purpose};
use magex_proto::goals::AssignmentMethod;
use std::cell::RefCell;

/// Largest problem, in pairs, for which the exact cost is computed beside an answer that is not exact.
pub const GAP_CELLS: usize = 1_000_000;

/// Buffers of larger problems are freed at once.
const KEPT_CELLS: usize = 300_000;

/// An answer: a valid matching.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Plan {
    /// `[N]` goal of each agent, or [`UNASSIGNED`].
    pub goal_of: Vec<u32>,
    /// `[N]` probability of each choice (learned only); `None` for a current pair that replaced the choice.
    pub probabilities: Option<Vec<Option<f32>>>,
    /// Method that answered.
    pub scheduler: AssignmentMethod,
    /// Summed cost.
    pub cost: f64,
    /// Smallest possible summed cost, if it was computed in time and the answer has as many pairs.
    pub exact_cost: Option<f64>,
    /// `[N]` cost of each agent's pair; 0 without one.
    pub pair_costs: Vec<f64>,
    /// Agents, and goals, whose pairs are all forbidden, ascending.
    pub isolated: [Vec<u32>; 2],
}

/// Buffers that are reused from problem to problem.
#[derive(Debug, Default)]
struct Workspace {
    solver: Solver,
    makespan: BottleneckSolver,
    costs: Vec<f64>,
    adjusted: Vec<f64>,
}

thread_local! {
    static WORKSPACE: RefCell<Workspace> = RefCell::default();
}

/// Calls `work` with the buffers of this thread.
fn with_workspace<T>(problem: &Problem, work: impl FnOnce(&mut Workspace) -> T) -> T {
    WORKSPACE.with_borrow_mut(|workspace| {
        let done = work(workspace);
        if problem.cells() > KEPT_CELLS {
            *workspace = Workspace::default();
        }
        done
    })
}

/// Solves by a method; the exact one answers in place of the learned one. `should_continue` is called from time to time.
/// When that returns false, the answer is [`AssignError::Interrupted`].
pub fn solve(
    problem: &Problem,
    kind: AssignmentMethod,
    should_continue: &dyn Fn() -> bool,
) -> Result<Plan, AssignError> {
    if problem.cells() == 0 {
        return Ok(nothing(problem, kind));
    }
    with_workspace(problem, |workspace| {
        let (rows, cols) = (problem.agent_count, problem.goal_count);
        problem.costs_into(&mut workspace.costs)?;
        let sticky = workspace.adjust(problem);
        let Workspace { solver, makespan, costs, adjusted } = workspace;
        let target: &[f64] = if sticky { adjusted } else { costs };
        let mut exact_cost = None;
        let (goal_of, scheduler) = match kind {
            AssignmentMethod::Exact | AssignmentMethod::Learned => {
                let answer = solver.solve_allowed(target, rows, cols, should_continue)?;
                exact_cost = (!sticky).then_some(answer.cost);
                (answer.col_of_row, AssignmentMethod::Exact)
            }
            AssignmentMethod::Makespan => {
                (makespan.solve_allowed(target, rows, cols, should_continue)?.col_of_row, kind)
            }
            AssignmentMethod::Greedy => (greedy(target, rows, cols, should_continue)?.col_of_row, kind),
            AssignmentMethod::Random => {
                let mut stream = Key::new(problem.seed, Purpose::Request, &[]).stream();
                (random_allowed(costs, rows, cols, &mut stream, should_continue)?, kind)
            }
        };
        workspace.finish(problem, Plan { goal_of, scheduler, exact_cost, ..Plan::default() }, should_continue)
    })
}

/// The plan of a team without agents or without goals: all others are left over, at no cost, whatever the method.
fn nothing(problem: &Problem, kind: AssignmentMethod) -> Plan {
    let scheduler = if kind == AssignmentMethod::Learned { AssignmentMethod::Exact } else { kind };
    let (goal_of, pair_costs) = (vec![UNASSIGNED; problem.agent_count], vec![0.0; problem.agent_count]);
    Plan { goal_of, scheduler, exact_cost: Some(0.0), pair_costs, ..Plan::default() }
}

/// Makes a plan of the answer of the learned method. An error is the reason of a fallback.
pub fn adopt(
    problem: &Problem,
    goals: Vec<Option<u32>>,
    probabilities: Option<Vec<f32>>,
    should_continue: &dyn Fn() -> bool,
) -> Result<Plan, String> {
    check(problem, &goals, probabilities.as_deref())?;
    let wish: Vec<u32> = goals.into_iter().map(|goal| goal.unwrap_or(UNASSIGNED)).collect();
    with_workspace(problem, |workspace| {
        let cols = problem.goal_count;
        problem.costs_into(&mut workspace.costs).map_err(|error| error.to_string())?;
        let costs = &workspace.costs;
        if let Some((agent, goal)) = pairs(&wish).find(|(agent, goal)| costs[agent * cols + goal] == f64::INFINITY) {
            return Err(format!("the model assigned the forbidden pair of agent {agent} and goal {goal}"));
        }
        let planned = workspace.follow(problem, &wish, probabilities, should_continue);
        planned.map_err(|error| error.to_string())
    })
}

/// Why the learned method does not support a problem.
pub fn not_for_learned(problem: &Problem) -> Option<&'static str> {
    if problem.matrix.is_some() || !problem.overrides.is_empty() {
        return Some("the learned scheduler supports positions only, not costs");
    }
    if problem.cells() == 0 {
        return Some("without agents or without goals there is nothing to choose");
    }
    (learned_cells(problem) > GAP_CELLS)
        .then_some("the learned scheduler supports at most 1,000 agents and 1,000 goals")
}

/// Pairs that the learned method scores: it pads the smaller side.
pub fn learned_cells(problem: &Problem) -> usize {
    problem.agent_count.max(problem.goal_count).pow(2)
}

impl Workspace {
    /// Follows an allowed matching, except where leaving current pairs costs more than it saves.
    fn follow(
        &mut self,
        problem: &Problem,
        wish: &[u32],
        probabilities: Option<Vec<f32>>,
        should_continue: &dyn Fn() -> bool,
    ) -> Result<Plan, AssignError> {
        let goal_of = match self.adjust(problem) {
            true => {
                let Self { solver, adjusted, .. } = self;
                sticky::follow(wish, adjusted, problem.goal_count, &problem.current, solver, should_continue)?
            }
            false => wish.to_vec(),
        };
        let own = |(agent, p): (usize, f32)| (goal_of[agent] == wish[agent]).then_some(p);
        let probabilities = probabilities.map(|all| all.into_iter().enumerate().map(own).collect());
        let scheduler = AssignmentMethod::Learned;
        self.finish(problem, Plan { goal_of, probabilities, scheduler, ..Plan::default() }, should_continue)
    }

    /// Fills the adjusted costs if there are current pairs.
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

    /// Fills in the costs of a matching.
    fn finish(
        &mut self,
        problem: &Problem,
        mut plan: Plan,
        should_continue: &dyn Fn() -> bool,
    ) -> Result<Plan, AssignError> {
        let (rows, cols) = (problem.agent_count, problem.goal_count);
        let Self { solver, costs, .. } = self;
        plan.cost = cost_of(costs, cols, &plan.goal_of);
        if plan.exact_cost.is_none() && rows * cols <= GAP_CELLS {
            match solver.solve_allowed(costs, rows, cols, should_continue) {
                Ok(exact) if exact.pairs().count() == pairs(&plan.goal_of).count() => {
                    plan.exact_cost = Some(exact.cost)
                }
                // The answer is complete; only its gap is missing.
                Ok(_) | Err(AssignError::Interrupted) => {}
                Err(other) => return Err(other),
            }
        }
        plan.pair_costs = vec![0.0; rows];
        pairs(&plan.goal_of).for_each(|(agent, goal)| plan.pair_costs[agent] = costs[agent * cols + goal]);
        if !problem.forbidden.is_empty() {
            plan.isolated = isolated(costs, cols);
        }
        Ok(plan)
    }
}

/// Agents, and goals, whose pairs are all forbidden.
fn isolated(costs: &[f64], cols: usize) -> [Vec<u32>; 2] {
    let (mut agents, mut lonely) = (Vec::new(), vec![true; cols]);
    for (agent, row) in (0u32..).zip(costs.chunks_exact(cols)) {
        let mut allowed = false;
        for (cost, lonely) in row.iter().zip(&mut lonely) {
            if *cost < f64::INFINITY {
                (allowed, *lonely) = (true, false);
            }
        }
        if !allowed {
            agents.push(agent);
        }
    }
    [agents, (0u32..).zip(lonely).filter_map(|(goal, lonely)| lonely.then_some(goal)).collect()]
}

/// Checks that the answer is a matching of min(N, G) pairs.
fn check(problem: &Problem, goals: &[Option<u32>], probabilities: Option<&[f32]>) -> Result<(), String> {
    let (n, g) = (problem.agent_count, problem.goal_count);
    if goals.len() != n || probabilities.is_some_and(|p| p.len() != n) {
        return Err(format!("the model returned goals for {} agents of {n}", goals.len()));
    }
    if let Some(p) = probabilities.into_iter().flatten().find(|p| !(0.0..=1.0).contains(*p)) {
        return Err(format!("the model returned the probability {p}, outside 0..1"));
    }
    let mut taken = vec![false; g];
    for goal in goals.iter().flatten() {
        match taken.get_mut(*goal as usize) {
            Some(taken) if !*taken => *taken = true,
            _ => return Err(format!("the model assigned goal {goal} twice, or there is no such goal")),
        }
    }
    let given = taken.iter().filter(|taken| **taken).count();
    if given != n.min(g) {
        return Err(format!("the model assigned {given} goals of {} possible", n.min(g)));
    }
    Ok(())
}
