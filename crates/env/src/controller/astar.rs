//! Multi-agent A* (MA A*, the paper's planning baseline): plans all ways on a grid when the episodes start, and follows them.
//!
//! The paper says that the space becomes a grid, that the cost of a cell is its distance to the agent plus its distance to the
//! goal, and that collisions among agents are considered. Everything else here is ours: docs/baselines/planners.md.

mod grid;
mod plan;

use super::{Controller, check, drones, one_state_each, spread};
use grid::Grid;
use magex_core::error::FieldError;
use magex_core::joint_state::JointState;
use magex_core::task::{ActionCode, TaskConfig};
use plan::{Limits, Plan, plan};

/// Nodes that one search may open.
const NODES: usize = 100_000;
/// Orders of priority that are tried.
const ROUNDS: usize = 16;

/// Pace and look-ahead of the tracking, joint steps.
struct Pace {
    /// κ: steps per cell.
    per_cell: u32,
    /// The agent steers to where its path is this many steps later, because it needs as long to follow.
    ahead: u32,
}

impl Pace {
    fn of(task: &TaskConfig) -> Self {
        match task.action_code() {
            // 2 units/s, full speed; the velocity lags by 0.1 / (1 - 0.75) - 0.1 = 0.3 s.
            ActionCode::Thrust | ActionCode::Own => Self { per_cell: 1, ahead: 3 },
            // 1.5 m/s of at most 2; 1 / APPROACH + 0.28 s = 23 commands.
            ActionCode::PerAxis => Self { per_cell: 4, ahead: 23 },
        }
    }
}

/// One episode.
#[derive(Debug)]
struct Course {
    grid: Grid,
    plan: Plan,
    /// κ.
    per_cell: u32,
}

impl Course {
    fn new(task: &TaskConfig, starts: &[[f64; 2]], goals: &[[f64; 2]]) -> Result<Self, FieldError> {
        let grid = Grid::around(&[starts, goals].concat())?;
        let trips: Vec<(u32, u32)> = grid.distinct_cells(starts).into_iter().zip(grid.distinct_cells(goals)).collect();
        let longest = trips.iter().map(|&(start, goal)| grid.manhattan(start, goal)).max().unwrap_or(0);
        let per_cell = Pace::of(task).per_cell;
        // A way that is longer than the episode may still be begun.
        let ticks = (task.horizon / per_cell).max(longest.saturating_mul(2));
        let plan = plan(&grid, &trips, Limits { ticks, nodes: NODES, rounds: ROUNDS });
        Ok(Self { grid, plan, per_cell })
    }

    /// Where the path of an agent is after `step` joint steps, linear between centres; `None` once it has ended.
    fn target(&self, agent: usize, step: u32) -> Option<[f64; 2]> {
        let (tick, rest) = ((step / self.per_cell) as usize, step % self.per_cell);
        let path = &self.plan.paths[agent];
        let [from, to] = [path.get(tick)?, path.get(tick + 1)?].map(|&cell| self.grid.centre(cell));
        let part = f64::from(rest) / f64::from(self.per_cell);
        Some([0, 1].map(|d| from[d] + part * (to[d] - from[d])))
    }
}

/// Plans in [`Controller::begin`] and steers each agent along its path as the scripted controller would steer to a landmark;
/// after the path's end, to the landmark. Drones are planned for in the plane and fly at the height of their landmarks.
#[derive(Debug)]
pub struct Astar {
    task: TaskConfig,
    courses: Vec<Course>,
    /// Joint steps since the start.
    step: u32,
}

impl Astar {
    /// For teams whose agents themselves go to landmarks; Push Ball is refused.
    pub fn new(task: &TaskConfig) -> Self {
        Self { task: task.clone(), courses: Vec::new(), step: 0 }
    }
}

impl Controller for Astar {
    fn begin(&mut self, start: &JointState<'_>) -> Result<(), FieldError> {
        let (n, dims) = (self.task.agents, self.task.dims());
        let landmarks = start.landmarks();
        let flat = |points: &[f32], k: usize| [0, 1].map(|d| f64::from(points[k * dims + d]));
        self.step = 0;
        self.courses.clear();
        for episode in 0..start.goals.len() / n.max(1) {
            let agents = episode * n..(episode + 1) * n;
            let starts: Vec<[f64; 2]> = agents.clone().map(|k| flat(start.positions, k)).collect();
            let goals: Vec<[f64; 2]> = agents.map(|k| flat(landmarks, episode * n + start.goals[k] as usize)).collect();
            self.courses.push(Course::new(&self.task, &starts, &goals)?);
        }
        Ok(())
    }

    fn act(&mut self, state: &JointState<'_>, actions: &mut [u8]) -> Result<(), FieldError> {
        let episodes = check(&self.task, state, actions)?;
        let (n, dims, heads) = (self.task.agents, self.task.dims(), self.task.action_heads().len());
        one_state_each(self.courses.len(), episodes, actions.len(), n * heads)?;
        let (landmarks, ahead) = (state.landmarks(), self.step + Pace::of(&self.task).ahead);
        for (k, actions) in actions.chunks_exact_mut(heads).enumerate() {
            let (episode, agent) = (k / n, k % n);
            let landmark = dims * (episode * n + state.goals[k] as usize);
            let target = self.courses[episode].target(agent, ahead);
            let towards = |d: usize| match target {
                Some(target) if d < 2 => target[d] as f32,
                _ => landmarks[landmark + d],
            };
            match self.task.action_code() {
                ActionCode::Thrust | ActionCode::Own => actions[0] = spread::steer(state, k, [0, 1].map(towards)),
                ActionCode::PerAxis => drones::steer(state, k, [0, 1, 2].map(towards), actions),
            }
        }
        self.step += 1;
        Ok(())
    }
}

#[cfg(test)]
mod tests;
