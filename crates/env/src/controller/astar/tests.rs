use super::*;
use crate::{Env, new_env};
use magex_core::rng::{Key, Purpose, Stream};
use magex_core::task::Spawn;
use std::collections::VecDeque;

const LIMITS: Limits = Limits { ticks: 200, nodes: NODES, rounds: ROUNDS };

/// An independent look at a plan: everything that is wrong with it, in words.
fn faults(grid: &Grid, trips: &[(u32, u32)], plan: &Plan) -> Vec<String> {
    let mut faults = Vec::new();
    let end = plan.paths.iter().map(Vec::len).max().unwrap_or(0);
    // Parked agents stay in their last cell.
    let at = |agent: usize, tick: usize| plan.paths[agent][tick.min(plan.paths[agent].len() - 1)];
    for (agent, path) in plan.paths.iter().enumerate() {
        if (path.first(), path.last()) != (Some(&trips[agent].0), Some(&trips[agent].1)) {
            faults.push(format!("agent {agent}: {path:?} is not the way {:?}", trips[agent]));
        }
        for step in path.windows(2) {
            if step[0] != step[1] && !grid.neighbours(step[0]).contains(&Some(step[1])) {
                faults.push(format!("agent {agent}: jumps {step:?}"));
            }
        }
    }
    for tick in 0..=end {
        for a in 0..trips.len() {
            for b in a + 1..trips.len() {
                if at(a, tick) == at(b, tick) {
                    faults.push(format!("vertex: {a} and {b} at {tick}"));
                }
                if at(a, tick) == at(b, tick + 1) && at(b, tick) == at(a, tick + 1) && at(a, tick) != at(b, tick) {
                    faults.push(format!("swap: {a} and {b} at {tick}"));
                }
            }
        }
    }
    faults
}

fn solved(grid: &Grid, trips: &[(u32, u32)]) -> Plan {
    let plan = plan(grid, trips, LIMITS);
    assert_eq!((&plan.unresolved, faults(grid, trips, &plan)), (&Vec::new(), Vec::new()));
    plan
}

fn stream(index: u32) -> Stream {
    Key::new(5, Purpose::Instances, &[index]).stream()
}

#[test]
fn the_checker_sees_vertex_swap_and_parked_conflicts() {
    let grid = Grid::drawn(&["....."]);
    let faults = |trips: &[(u32, u32)], paths: &[&[u32]]| {
        let paths = paths.iter().map(|path| path.to_vec()).collect();
        faults(&grid, trips, &Plan { paths, unresolved: Vec::new() })
    };
    assert_eq!(faults(&[(0, 1), (2, 3)], &[&[0, 1], &[2, 3]]), [""; 0]);
    assert!(faults(&[(0, 1), (2, 1)], &[&[0, 1], &[2, 1]])[0].contains("vertex"));
    assert!(faults(&[(0, 1), (1, 0)], &[&[0, 1], &[1, 0]])[0].contains("swap"));
    assert!(faults(&[(0, 3), (2, 2)], &[&[0, 1, 2, 3], &[2]])[0].contains("vertex: 0 and 1 at 2"));
    assert!(faults(&[(0, 2)], &[&[0, 2]])[0].contains("jumps"));
}

#[test]
fn alone_the_path_is_as_long_as_breadth_first_search_says() {
    let mut stream = stream(1);
    for _ in 0..200 {
        let (width, height) = (2 + stream.below(12), 2 + stream.below(12));
        let drawing: Vec<String> =
            (0..height).map(|_| (0..width).map(|_| if stream.below(5) == 0 { '#' } else { '.' }).collect()).collect();
        let grid = Grid::drawn(&drawing.iter().map(String::as_str).collect::<Vec<_>>());
        let open: Vec<u32> = (0..width * height)
            .filter(|&cell| drawing.concat().as_bytes()[place(cell, width, height)] == b'.')
            .collect();
        if open.len() < 2 {
            continue;
        }
        let [start, goal] = [(); 2].map(|()| open[stream.below(open.len() as u32) as usize]);
        let mut distance = vec![u32::MAX; grid.cells()];
        let mut queue = VecDeque::from([start]);
        distance[start as usize] = 0;
        while let Some(cell) = queue.pop_front() {
            for next in grid.neighbours(cell).into_iter().flatten() {
                if distance[next as usize] == u32::MAX {
                    distance[next as usize] = distance[cell as usize] + 1;
                    queue.push_back(next);
                }
            }
        }
        let plan = plan(&grid, &[(start, goal)], LIMITS);
        if distance[goal as usize] == u32::MAX {
            // No way at all: it stays, and says so.
            assert_eq!((plan.paths[0].as_slice(), plan.unresolved.as_slice()), (&[start][..], &[0][..]));
        } else {
            assert_eq!(plan.paths[0].len() as u32, distance[goal as usize] + 1);
            assert_eq!(faults(&grid, &[(start, goal)], &plan), [""; 0]);
        }
    }
}

/// Place of a cell in the lines of a drawing, the first of which is the highest.
fn place(cell: u32, width: u32, height: u32) -> usize {
    ((height - 1 - cell / width) * width + cell % width) as usize
}

#[test]
fn two_agents_pass_each_other_where_there_is_a_bay() {
    let trips = |grid: &Grid| [(grid.cell(0, 0), grid.cell(4, 0)), (grid.cell(4, 0), grid.cell(0, 0))];
    let grid = Grid::drawn(&["###.#", "....."]);
    let found = solved(&grid, &trips(&grid));
    // The first one goes straight on; the other one waits in the bay.
    let bay = grid.cell(3, 1);
    assert_eq!((found.paths[0].len(), found.paths[0].contains(&bay)), (5, false));
    assert_eq!((found.paths[1].len(), found.paths[1].contains(&bay)), (8, true));
    // Where both would have to give way, planning one after the other finds nothing, and says so.
    let grid = Grid::drawn(&["##.##", "....."]);
    assert_eq!(plan(&grid, &trips(&grid), LIMITS).unresolved.len(), 1);
}

#[test]
fn an_agent_waits_until_the_one_before_has_crossed_its_goal() {
    // The longer way, 0 to 6, leads over the goal of the other agent.
    let grid = Grid::drawn(&["#.#####", "......."]);
    let trips = [(grid.cell(0, 0), grid.cell(6, 0)), (grid.cell(1, 1), grid.cell(1, 0))];
    let plan = solved(&grid, &trips);
    assert_eq!((plan.paths[0].len(), plan.paths[1].len()), (7, 3));
}

#[test]
fn an_agent_that_finds_no_way_is_planned_for_first() {
    // The first one soon parks in the only row to the goal of the other one, whose way round the wall is longer.
    let grid = Grid::drawn(&["...####", ".#.#.##", ".#....."]);
    let trips = [(grid.cell(1, 2), grid.cell(5, 0)), (grid.cell(0, 0), grid.cell(6, 0))];
    let one_round = plan(&grid, &trips, Limits { rounds: 1, ..LIMITS });
    assert_eq!(one_round.unresolved, [1]);
    let found = solved(&grid, &trips);
    assert_eq!([found.paths[0].len(), found.paths[1].len()], [11, 11]);
}

#[test]
fn without_a_solution_the_shortest_way_ignores_the_others_and_says_so() {
    // Nothing to pass each other.
    let grid = Grid::drawn(&["....."]);
    let trips = [(0, 4), (4, 0)];
    let plan = plan(&grid, &trips, LIMITS);
    assert_eq!(plan.unresolved.len(), 1);
    assert_eq!(plan.paths, [vec![0, 1, 2, 3, 4], vec![4, 3, 2, 1, 0]]);
    assert!(faults(&grid, &trips, &plan)[0].contains("vertex"));
    // A limit of nodes ends a search as well.
    let open = Grid::drawn(&[".........."; 10]);
    let short = super::plan(&open, &[(0, 99), (99, 0)], Limits { nodes: 3, ..LIMITS });
    assert_eq!(short.unresolved, [0, 1]);
    assert_eq!(short.paths, [vec![0], vec![99]]);
}

#[test]
fn crowds_on_small_grids_have_no_conflicts_but_those_that_are_told() {
    let mut stream = stream(2);
    let mut whole = 0;
    for _ in 0..60 {
        let side = 4 + stream.below(5);
        let grid = Grid::drawn(&vec![&"........"[..side.min(8) as usize]; side as usize]);
        let cells = grid.cells() as u32;
        let agents = 2 + stream.below(cells / 3) as usize;
        let (starts, goals) = (stream.permutation(cells as usize), stream.permutation(cells as usize));
        let trips: Vec<(u32, u32)> = starts.into_iter().zip(goals).take(agents).collect();
        let plan = plan(&grid, &trips, LIMITS);
        let told = |fault: &String| plan.unresolved.iter().any(|k| fault.contains(&format!(" {k} ")));
        let untold: Vec<String> = faults(&grid, &trips, &plan).into_iter().filter(|fault| !told(fault)).collect();
        assert_eq!(untold, [""; 0]);
        whole += usize::from(plan.unresolved.is_empty());
    }
    assert!(whole >= 50, "{whole} of 60 plans are whole");
}

#[test]
fn points_get_the_nearest_cells_one_each() {
    let points = [[0.03, 0.0], [-0.03, 0.02], [0.0, -0.05], [2.0, 1.0], [0.61, 0.0]];
    let grid = Grid::around(&points).unwrap();
    let cells = grid.distinct_cells(&points);
    for (k, point) in points.iter().enumerate() {
        // By trying every cell.
        let free = (0..grid.cells() as u32).filter(|cell| !cells[..k].contains(cell));
        let distance = |cell: &u32| {
            let centre = grid.centre(*cell);
            (centre[0] - point[0]).powi(2) + (centre[1] - point[1]).powi(2)
        };
        let best = free.min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap();
        assert_eq!(distance(&cells[k]), distance(&best), "{k}");
    }
    let crowd = vec![[0.0; 2]; 1000];
    let mut cells = Grid::around(&crowd).unwrap().distinct_cells(&crowd);
    cells.sort_unstable();
    cells.dedup();
    assert_eq!(cells.len(), 1000);
    let error = Grid::around(&[[0.0; 2], [1000.0; 2]]).unwrap_err().to_string();
    assert!(error.contains("task.side") && error.contains("orca"), "{error}");
}

/// Episodes of Simple Spread, started by the keys of these numbers, each with goals in order.
fn begun(task: &TaskConfig, episodes: &[u32]) -> (Env, Vec<u32>) {
    let streams = episodes.iter().map(|&k| Key::new(1, Purpose::EvalSpawn, &[100, k]).stream());
    let mut env = new_env(task, streams, false).unwrap();
    let goals: Vec<u32> = episodes.iter().flat_map(|_| 0..task.agents as u32).collect();
    env.set_goals(&goals).unwrap();
    (env, goals)
}

#[test]
fn plans_of_the_papers_teams_have_no_conflicts() {
    for (agents, spawn) in [(5, Spawn::Uniform), (20, Spawn::Lines(None)), (50, Spawn::Lines(None))] {
        let task = TaskConfig::simple_spread(agents, spawn);
        let episodes: Vec<u32> = (0..6).collect();
        let (env, goals) = begun(&task, &episodes);
        let (positions, velocities) = (env.positions(), env.velocities());
        let state = JointState {
            positions: &positions,
            velocities: &velocities,
            agent_state: &[],
            world_states: &[],
            masks: &[],
            marks: &[],
            statics: env.statics().view(),
            goals: &goals,
        };
        let mut astar = Astar::new(&task);
        astar.begin(&state).unwrap();
        assert_eq!(astar.courses.len(), 6);
        for course in &astar.courses {
            let trips: Vec<(u32, u32)> = course.plan.paths.iter().map(|path| (path[0], path[path.len() - 1])).collect();
            assert_eq!(course.plan.unresolved, [0; 0]);
            assert_eq!(faults(&course.grid, &trips, &course.plan), [""; 0]);
        }
    }
}
