//! Solves a team's problem by every method but the learned one, and checks the answer of the learned one.
//!
//! Switching cost: exact and makespan minimise (summed cost) + s · (number of agents that leave their pair), then that number: pairs
//! are not exchanged for equally cheap ones, even with s = 0. For greedy the current pair of an agent is cheaper by s.
//! The learned method ignores current pairs: of its answer, only changes that save more than their switching costs are applied.

mod sticky;

use crate::UNASSIGNED;
use crate::costs::{Obstacle, PairTerms};
use crate::lists::{LARGE_CELLS, Listed};
use crate::problem::Problem;
use magex_assign::random::random_allowed;
use magex_assign::{
    AllowedPairs, AssignError, BottleneckSolver, GoOn, PointProblem, Solver, Switching, bottleneck_points,
    compensated_sum, greedy, pairs, solve_pairs, solve_points,
};
use magex_core::rng::{Key, Purpose};
use magex_proto::goals::AssignmentMethod;
use std::cell::RefCell;

/// Largest problem, in pairs, for which the exact cost is computed beside an answer that is not exact.
pub const GAP_CELLS: usize = 1_000_000;

/// Buffers of larger problems are freed at once.
const KEPT_CELLS: usize = LARGE_CELLS;

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
    /// The part of the cost that is of goals without an agent; 0 unless weights differ.
    pub unserved_cost: f64,
    /// `[N]` cost and arrival of each agent's pair; 0 without one.
    pub pairs: Vec<PairTerms>,
    /// What stands in the way of every agent, and of every goal; empty if nothing does.
    pub obstacles: [Vec<Option<Obstacle>>; 2],
}

/// Buffers that are reused from problem to problem.
#[derive(Debug, Default)]
struct Workspace {
    solver: Solver,
    makespan: BottleneckSolver,
    costs: Vec<f64>,
    adjusted: Vec<f64>,
    /// Costs without weights.
    unweighted: Vec<f64>,
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

/// Solves by a method; the exact one answers in place of the learned one. `go_on` is called from time to time.
/// When that returns false, the answer is [`AssignError::Interrupted`].
pub fn solve(problem: &Problem, kind: AssignmentMethod, go_on: GoOn<'_>) -> Result<Plan, AssignError> {
    if problem.cells() == 0 {
        return Ok(nothing(problem, kind));
    }
    if problem.cells() > LARGE_CELLS {
        let exact = matches!(kind, AssignmentMethod::Exact | AssignmentMethod::Learned);
        if exact && let Some(listed) = problem.listed() {
            return solve_listed(problem, &listed, go_on);
        }
        if (exact || kind == AssignmentMethod::Makespan)
            && let Some(costs) = problem.without_matrix()
        {
            return solve_large(problem, kind, &costs, go_on);
        }
    }
    with_workspace(problem, |workspace| {
        let (rows, cols) = (problem.agent_count, problem.place_count());
        problem.costs_into(&mut workspace.costs);
        let current = problem.current_places();
        let switching = Switching { current: &current, cost: problem.switching_cost };
        let sticky = sticky(problem);
        let (place_of, scheduler) = match kind {
            AssignmentMethod::Exact | AssignmentMethod::Learned => {
                let Workspace { solver, costs, .. } = workspace;
                let answer = solver.solve_switching(costs, rows, cols, &switching, go_on)?;
                (answer.col_of_row, AssignmentMethod::Exact)
            }
            AssignmentMethod::Makespan if problem.terms.weighted() => {
                let Workspace { solver, makespan, costs, unweighted, .. } = workspace;
                problem.unweighted_into(unweighted);
                let first = makespan.solve_switching(unweighted, rows, cols, &switching, go_on)?;
                let leaves = |row: usize, col: usize| {
                    let left = current.get(row).is_some_and(|&own| own != UNASSIGNED && own as usize != col);
                    if left { problem.switching_cost } else { 0.0 }
                };
                let key = |row: usize, col: usize| unweighted[row * cols + col] + leaves(row, col);
                let largest = first.pairs().map(|(row, col)| key(row, col)).fold(f64::NEG_INFINITY, f64::max);
                for (place, cost) in costs.iter_mut().enumerate() {
                    if key(place / cols, place % cols) > largest {
                        *cost = f64::INFINITY;
                    }
                }
                (solver.solve_switching(costs, rows, cols, &switching, go_on)?.col_of_row, kind)
            }
            AssignmentMethod::Makespan => {
                let Workspace { makespan, costs, .. } = workspace;
                (makespan.solve_switching(costs, rows, cols, &switching, go_on)?.col_of_row, kind)
            }
            AssignmentMethod::Greedy => {
                let adjusted = workspace.adjust(problem);
                let target = if adjusted { &workspace.adjusted } else { &workspace.costs };
                (greedy(target, rows, cols, go_on)?.col_of_row, kind)
            }
            AssignmentMethod::Random => {
                let mut stream = Key::new(problem.seed, Purpose::Request, &[]).stream();
                (random_allowed(&workspace.costs, rows, cols, &mut stream, go_on)?, kind)
            }
        };
        let proven = scheduler == AssignmentMethod::Exact && !sticky;
        let plan = Plan { goal_of: goals_of(problem, place_of), scheduler, ..Plan::default() };
        workspace.finish(problem, plan, proven, go_on)
    })
}

/// Whether agents have current goals.
fn sticky(problem: &Problem) -> bool {
    problem.current.iter().any(|&goal| goal != UNASSIGNED)
}

/// Solves a large team of positions without a matrix. `costs` are pairs that cost something else.
fn solve_large(
    problem: &Problem,
    kind: AssignmentMethod,
    costs: &[(u32, u32, f64)],
    go_on: GoOn<'_>,
) -> Result<Plan, AssignError> {
    let Problem { agents, goals, dims, .. } = problem;
    let switching = Switching { current: &problem.current, cost: problem.switching_cost };
    let own = PointProblem { power: problem.terms.power, costs, ..PointProblem::new(agents, goals, *dims) };
    let with_current = PointProblem { switching, ..own };
    let (answer, scheduler) = match kind {
        AssignmentMethod::Makespan => (bottleneck_points(&with_current, go_on)?, kind),
        _ => (solve_points(&with_current, go_on)?, AssignmentMethod::Exact),
    };
    let proven = scheduler == AssignmentMethod::Exact && !sticky(problem);
    let pairs_of = answer.pairs().count();
    let mut plan = Plan { goal_of: answer.col_of_row, scheduler, ..Plan::default() };
    plan.pairs = problem.pair_terms(&plan.goal_of);
    plan.cost = total(&plan.pairs, 0.0);
    if proven {
        plan.exact_cost = Some(plan.cost);
    } else if problem.cells() <= GAP_CELLS {
        match solve_points(&own, go_on) {
            Ok(exact) if exact.pairs().count() == pairs_of => {
                plan.exact_cost = Some(total(&problem.pair_terms(&exact.col_of_row), 0.0));
            }
            Ok(_) | Err(AssignError::Interrupted) => {}
            Err(other) => return Err(other),
        }
    }
    if problem.forbids() && pairs_of < problem.agent_count.max(problem.goal_count) {
        plan.obstacles = problem.obstacles_without_matrix();
    }
    Ok(plan)
}

/// Solves a large team of listed pairs exactly, without a matrix.
fn solve_listed(problem: &Problem, listed: &Listed, go_on: GoOn<'_>) -> Result<Plan, AssignError> {
    let (rows, cols) = (problem.agent_count, problem.goal_count);
    let switching = Switching { current: &problem.current, cost: problem.switching_cost };
    let own = AllowedPairs { rows, cols, pairs: &listed.pairs, switching: Switching::default() };
    let answer = solve_pairs(&AllowedPairs { switching, ..own }, go_on)?;
    let pairs_of = answer.pairs().count();
    let cost_of = |goal_of: &[u32], pairs: &[PairTerms]| total(pairs, unserved(problem, listed.unserved, goal_of));
    let mut plan = Plan { goal_of: answer.col_of_row, scheduler: AssignmentMethod::Exact, ..Plan::default() };
    plan.pairs = problem.pair_terms(&plan.goal_of);
    plan.unserved_cost = unserved(problem, listed.unserved, &plan.goal_of);
    plan.cost = cost_of(&plan.goal_of, &plan.pairs);
    if !sticky(problem) {
        plan.exact_cost = Some(plan.cost);
    } else if problem.cells() <= GAP_CELLS {
        match solve_pairs(&own, go_on) {
            Ok(exact) if exact.pairs().count() == pairs_of => {
                plan.exact_cost = Some(cost_of(&exact.col_of_row, &problem.pair_terms(&exact.col_of_row)));
            }
            Ok(_) | Err(AssignError::Interrupted) => {}
            Err(other) => return Err(other),
        }
    }
    if pairs_of < rows.max(cols) {
        plan.obstacles = problem.obstacles_without_matrix();
    }
    Ok(plan)
}

/// The plan of a team without agents or without goals: all others are left over, at no cost, whatever the method.
fn nothing(problem: &Problem, kind: AssignmentMethod) -> Plan {
    let scheduler = if kind == AssignmentMethod::Learned { AssignmentMethod::Exact } else { kind };
    let (goal_of, pairs) = (vec![UNASSIGNED; problem.agent_count], vec![PairTerms::default(); problem.agent_count]);
    Plan { goal_of, scheduler, exact_cost: Some(0.0), pairs, ..Plan::default() }
}

/// Makes a plan of the answer of the learned method. An error is the reason of a fallback.
pub fn adopt(
    problem: &Problem,
    goals: Vec<Option<u32>>,
    probabilities: Option<Vec<f32>>,
    go_on: GoOn<'_>,
) -> Result<Plan, String> {
    check(problem, &goals, probabilities.as_deref())?;
    let wish: Vec<u32> = goals.into_iter().map(|goal| goal.unwrap_or(UNASSIGNED)).collect();
    with_workspace(problem, |workspace| {
        let cols = problem.goal_count;
        problem.costs_into(&mut workspace.costs);
        let costs = &workspace.costs;
        if let Some((agent, goal)) = pairs(&wish).find(|(agent, goal)| costs[agent * cols + goal] == f64::INFINITY) {
            return Err(format!("the model assigned the forbidden pair of agent {agent} and goal {goal}"));
        }
        let planned = workspace.follow(problem, &wish, probabilities, go_on);
        planned.map_err(|error| error.to_string())
    })
}

/// Why the learned method does not support a problem.
pub fn not_for_learned(problem: &Problem) -> Option<&'static str> {
    if problem.matrix.is_some() || problem.only_overrides || !problem.overrides.is_empty() {
        return Some("the learned scheduler supports positions only, not costs");
    }
    if !problem.terms.plain() {
        return Some(
            "the learned scheduler knows distances only: no power, speeds, offsets, weights, capacities or times",
        );
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
        go_on: GoOn<'_>,
    ) -> Result<Plan, AssignError> {
        let goal_of = match self.adjust(problem) {
            true => {
                let Self { solver, adjusted, .. } = self;
                sticky::follow(wish, adjusted, problem.goal_count, &problem.current, solver, go_on)?
            }
            false => wish.to_vec(),
        };
        let own = |(agent, p): (usize, f32)| (goal_of[agent] == wish[agent]).then_some(p);
        let probabilities = probabilities.map(|all| all.into_iter().enumerate().map(own).collect());
        let scheduler = AssignmentMethod::Learned;
        self.finish(problem, Plan { goal_of, probabilities, scheduler, ..Plan::default() }, false, go_on)
    }

    /// Fills the adjusted costs if there are current pairs.
    fn adjust(&mut self, problem: &Problem) -> bool {
        let Self { costs, adjusted, .. } = self;
        if !sticky(problem) {
            return false;
        }
        adjusted.clear();
        adjusted.extend_from_slice(costs);
        favour(adjusted, problem.place_count(), problem);
        true
    }

    /// Fills in the costs of a matching. `proven`: no other costs less.
    fn finish(
        &mut self,
        problem: &Problem,
        mut plan: Plan,
        proven: bool,
        go_on: GoOn<'_>,
    ) -> Result<Plan, AssignError> {
        let (rows, cols) = (problem.agent_count, problem.place_count());
        let Self { solver, costs, .. } = self;
        let longest = if problem.terms.weighted() { problem.costs_into(costs) } else { 0.0 };
        plan.pairs = problem.pair_terms(&plan.goal_of);
        plan.unserved_cost = unserved(problem, longest, &plan.goal_of);
        plan.cost = total(&plan.pairs, plan.unserved_cost);
        if proven {
            plan.exact_cost = Some(plan.cost);
        } else if rows * cols <= GAP_CELLS {
            match solver.solve_allowed(costs, rows, cols, go_on) {
                Ok(exact) if exact.pairs().count() == pairs(&plan.goal_of).count() => {
                    let goal_of = goals_of(problem, exact.col_of_row);
                    let cost = total(&problem.pair_terms(&goal_of), unserved(problem, longest, &goal_of));
                    plan.exact_cost = Some(cost);
                }
                // The answer is complete; only its gap is missing.
                Ok(_) | Err(AssignError::Interrupted) => {}
                Err(other) => return Err(other),
            }
        }
        if problem.forbids() && pairs(&plan.goal_of).count() < rows.max(problem.goal_count) {
            plan.obstacles = problem.obstacles();
        }
        Ok(plan)
    }
}

/// Makes the current pairs cheaper.
fn favour(costs: &mut [f64], cols: usize, problem: &Problem) {
    sticky::favour(costs, cols, &problem.current_places(), problem.switching_cost);
}

/// The goal of each agent's place.
fn goals_of(problem: &Problem, mut place_of: Vec<u32>) -> Vec<u32> {
    if let Some(places) = problem.places() {
        for place in place_of.iter_mut().filter(|place| **place != UNASSIGNED) {
            *place = places[*place as usize];
        }
    }
    place_of
}

fn total(pairs: &[PairTerms], unserved: f64) -> f64 {
    compensated_sum(pairs.iter().map(|pair| pair.cost).chain([unserved]))
}

/// What the places cost that no agent gets, at `longest` per unit of weight.
fn unserved(problem: &Problem, longest: f64, goal_of: &[u32]) -> f64 {
    if longest == 0.0 {
        return 0.0;
    }
    let terms = &problem.terms;
    let mut free: Vec<u32> =
        (0..problem.goal_count).map(|goal| terms.capacity(goal).min(problem.agent_count as u32)).collect();
    pairs(goal_of).for_each(|(_, goal)| free[goal] -= 1);
    compensated_sum((0..problem.goal_count).map(|goal| f64::from(free[goal]) * terms.weight(goal) * longest))
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
