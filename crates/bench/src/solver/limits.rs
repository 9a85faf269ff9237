//! The exact solvers at their limits: ties, clusters that are far apart, and sizes without a matrix.

use crate::report::Report;
use crate::vitals::memory_mib;
use magex::output::note;
use magex_assign::{AssignError, PointProblem, Solver, bottleneck_points, solve_points};
use magex_core::rng::{Key, Purpose, Stream};
use serde_json::json;
use std::io::Write;
use std::process::{Command, Stdio};
use std::time::Instant;

const SCRIPT: &str = include_str!("../../peers/solver/solve.py");
/// The least of this many runs counts: other programs can only make one longer.
const RUNS: usize = 3;

/// What a row solves.
enum Input {
    /// Agents and goals `[n, 2]`, power of the distance.
    Points(Vec<f64>, Vec<f64>, f64),
    Makespan(Vec<f64>, Vec<f64>),
    /// `[n, n]`
    Matrix(Vec<f64>, usize),
}

struct Row {
    what: &'static str,
    input: fn() -> Input,
    /// Whether scipy solves it, too.
    compared: bool,
    must: &'static str,
    aim: &'static str,
}

const ROWS: [Row; 14] = [
    Row {
        what: "uniform positions, n = 20,000, d",
        input: || uniform(20_000, 1.0),
        compared: false,
        must: "5 s, 500 MiB",
        aim: "1 s, 200 MiB",
    },
    Row {
        what: "uniform positions, n = 20,000, d²",
        input: || uniform(20_000, 2.0),
        compared: false,
        must: "5 s, 500 MiB",
        aim: "1 s, 200 MiB",
    },
    Row {
        what: "20 clusters, n = 20,000, d",
        input: || clusters(20_000, 20, 10.0, 1000.0, 1.0),
        compared: false,
        must: "5 s, 500 MiB",
        aim: "1 s, 200 MiB",
    },
    Row {
        what: "20 clusters, n = 20,000, d²",
        input: || clusters(20_000, 20, 10.0, 1000.0, 2.0),
        compared: false,
        must: "5 s, 500 MiB",
        aim: "1 s, 200 MiB",
    },
    Row {
        what: "positions of a 141 × 141 grid, n = 20,000, d",
        input: || grid(20_000, 141, 1.0),
        compared: false,
        must: "",
        aim: "",
    },
    Row {
        what: "positions of a 20 × 20 grid, n = 20,000, d",
        input: || grid(20_000, 20, 1.0),
        compared: false,
        must: "",
        aim: "",
    },
    Row { what: "positions on a line, n = 20,000, d", input: || line(20_000), compared: false, must: "", aim: "" },
    Row {
        what: "makespan, uniform positions, n = 5,000",
        input: || makespan(5000),
        compared: false,
        must: "1 s, 300 MiB",
        aim: "0.3 s",
    },
    Row {
        what: "makespan, uniform positions, n = 20,000",
        input: || makespan(20_000),
        compared: false,
        must: "",
        aim: "",
    },
    Row {
        what: "uniform positions, n = 5,000, d",
        input: || uniform(5000, 1.0),
        compared: true,
        must: "0.05 ×",
        aim: "0.015 ×",
    },
    Row {
        what: "two far clusters of 1,500, d",
        input: || clusters(3000, 2, 100.0, 14_000.0, 1.0),
        compared: true,
        must: "0.2 ×",
        aim: "0.05 ×",
    },
    Row {
        what: "all costs equal, matrix, n = 2,000",
        input: || integers(2000, 1),
        compared: true,
        must: "2 ×",
        aim: "1 ×",
    },
    Row {
        what: "costs 0–3, matrix, n = 2,000", input: || integers(2000, 4), compared: true, must: "2 ×", aim: "1 ×"
    },
    Row { what: "|i − j|, matrix, n = 2,000", input: || steps(2000), compared: true, must: "", aim: "" },
];

/// Fills in the rows; in the memory of the process, the peak counts.
pub(crate) fn limits(report: &mut Report, python: &str) -> Result<(), AssignError> {
    for Row { what, input, compared, must, aim } in ROWS {
        let input = input();
        let (mut best, mut cost) = (f64::INFINITY, 0.0);
        let before = memory_mib(std::process::id(), "VmRSS:");
        // Linux: the peak begins anew.
        let _ = std::fs::write("/proc/self/clear_refs", "5");
        for _ in 0..RUNS {
            let start = Instant::now();
            cost = solve(&input)?;
            best = best.min(start.elapsed().as_secs_f64());
        }
        let peak = memory_mib(std::process::id(), "VmHWM:") - before;
        let theirs = if compared { scipy(python, &input) } else { Err(String::new()) };
        let mut text = format!("{:.1} ms, {peak:.0} MiB", best * 1e3);
        let mut ratio = None;
        match theirs {
            Ok((seconds, their_cost)) => {
                text += &format!(", {:.3} × scipy's {:.0} ms", best / seconds, seconds * 1e3);
                ratio = Some(best / seconds);
                // Ours is compensated, theirs is numpy's.
                if (cost - their_cost).abs() > 1e-9 * their_cost.abs() {
                    report.failed = true;
                    report.notes.push(format!("{what}: cost {cost}, scipy's is {their_cost}"));
                }
            }
            Err(reason) if !reason.is_empty() => report.notes.push(format!("{what}: no scipy: {reason}")),
            Err(_) => {}
        }
        note(format!("{what}: {text}"));
        let value = json!({ "what": what, "seconds": best, "peak_mib": peak, "ratio_to_scipy": ratio });
        report.row(vec![what.to_owned(), text, must.to_owned(), aim.to_owned()], value);
    }
    Ok(())
}

fn solve(input: &Input) -> Result<f64, AssignError> {
    let answer = match input {
        Input::Points(agents, goals, power) => {
            solve_points(&PointProblem { power: *power, ..PointProblem::new(agents, goals, 2) }, &|| true)?
        }
        Input::Makespan(agents, goals) => bottleneck_points(&PointProblem::new(agents, goals, 2), &|| true)?,
        Input::Matrix(cost, n) => Solver::default().solve(cost, *n, *n)?,
    };
    Ok(answer.cost)
}

/// Seconds and cost of scipy on the same input, in a process of its own.
fn scipy(python: &str, input: &Input) -> Result<(f64, f64), String> {
    let (kind, n, values) = match input {
        Input::Points(agents, goals, _) | Input::Makespan(agents, goals) => {
            ("points", agents.len() / 2, [agents.as_slice(), goals.as_slice()])
        }
        Input::Matrix(cost, n) => ("matrix", *n, [cost.as_slice(), &[]]),
    };
    let mut child = Command::new(python)
        .args(["-c", SCRIPT, kind, &n.to_string(), &n.to_string(), &RUNS.to_string()])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(|error| format!("{python}: {error}"))?;
    if let Some(mut stdin) = child.stdin.take() {
        let bytes: Vec<u8> = values.concat().iter().flat_map(|value| value.to_le_bytes()).collect();
        // A Python without scipy does not read; it says why below.
        let _ = stdin.write_all(&bytes);
    }
    let output = child.wait_with_output().map_err(|error| error.to_string())?;
    let text = String::from_utf8_lossy(&output.stdout);
    let numbers: Option<Vec<f64>> = text.split_whitespace().map(|word| word.parse().ok()).collect();
    match numbers.as_deref() {
        Some(&[seconds, cost]) => Ok((seconds, cost)),
        _ => Err(String::from_utf8_lossy(&output.stderr).lines().last().unwrap_or("it failed").to_owned()),
    }
}

fn stream(index: u32) -> Stream {
    Key::new(1, Purpose::Bench, &[index]).stream()
}

/// Agents and goals from a generator of points.
fn both(n: usize, mut point: impl FnMut(&mut Stream) -> [f64; 2]) -> [Vec<f64>; 2] {
    [0, 1].map(|side| {
        let mut stream = stream(side);
        (0..n).flat_map(|_| point(&mut stream)).collect()
    })
}

fn uniform(n: usize, power: f64) -> Input {
    let [agents, goals] = both(n, |stream| [stream.uniform(), stream.uniform()]);
    Input::Points(agents, goals, power)
}

fn makespan(n: usize) -> Input {
    let [agents, goals] = both(n, |stream| [stream.uniform(), stream.uniform()]);
    Input::Makespan(agents, goals)
}

/// Squares of one side, a gap apart in rows of five; the same number of agents and of goals in each only by chance.
fn clusters(n: usize, count: u32, side: f64, gap: f64, power: f64) -> Input {
    let [agents, goals] = both(n, |stream| {
        let cluster = stream.below(count);
        let corner = [f64::from(cluster % 5), f64::from(cluster / 5)].map(|place| gap * place);
        [corner[0] + side * stream.uniform(), corner[1] + side * stream.uniform()]
    });
    Input::Points(agents, goals, power)
}

fn grid(n: usize, side: u32, power: f64) -> Input {
    let [agents, goals] = both(n, |stream| [f64::from(stream.below(side)), f64::from(stream.below(side))]);
    Input::Points(agents, goals, power)
}

fn line(n: usize) -> Input {
    let [agents, goals] = both(n, |stream| [stream.uniform(), 0.0]);
    Input::Points(agents, goals, 1.0)
}

/// Whole numbers from 0 on, this many different ones.
fn integers(n: usize, values: u32) -> Input {
    let mut stream = stream(2);
    Input::Matrix((0..n * n).map(|_| f64::from(stream.below(values))).collect(), n)
}

fn steps(n: usize) -> Input {
    Input::Matrix((0..n * n).map(|place| (place / n).abs_diff(place % n) as f64).collect(), n)
}
