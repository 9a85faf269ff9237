//! Where the agents, balls and landmarks of an episode start.

use super::constants::SPACING;
use super::layouts::{layout, scale};
use crate::particles::constants::CONTACT_DISTANCE;
use crate::particles::curves::{Curve, LAYOUTS, Points};
use crate::particles::placement::{lattice, near, scatter};
use magex_core::error::FieldError;
use magex_core::rng::Stream;
use magex_core::task::{PushBallConfig, Spawn, TaskConfig};

/// Agents start at least this far from balls.
const PUSH_DISTANCE: f64 = PushBallConfig::PUSH_DISTANCE;
/// Part of the way to a neighbour by which points on the lines are moved.
const JITTER: f64 = 0.3;
/// Tries after which a slot stays where it is, or an agent out of line.
const PATIENCE: usize = 100;
/// Nearest that an agent, or a landmark, is put in line with a ball; the farthest is half the side of the map.
const IN_LINE: f64 = 0.35;
/// Most that a landmark is off the line, per unit of distance.
const ASIDE: f64 = 0.6;

/// The start of an episode. Balls start 0.3 from each other, agents 0.2 from each other and 0.25 from balls.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Start {
    /// `[N, 2]`
    pub agents: Vec<f32>,
    /// `[N, 2]`
    pub balls: Vec<f32>,
    /// `[N, 2]`
    pub landmarks: Vec<f32>,
}

/// Draws the start of an episode from its own stream. What `training` may add is drawn last, so that the same stream
/// gives an evaluation episode the same start whatever `task.push_ball.start_in_line_fraction` is. An error if the task is
/// another one.
pub(super) fn spawn(task: &TaskConfig, training: bool, stream: &mut Stream) -> Result<Start, FieldError> {
    let in_line = task.push_ball()?.start_in_line_fraction;
    let mut start = match task.spawn {
        Spawn::Uniform => uniform(task.agents, task.side, stream),
        Spawn::Lines(fixed) => on_layout(task, fixed, JITTER, stream),
        Spawn::Authors(fixed) => on_layout(task, fixed, 0.0, stream),
    };
    if training && stream.uniform() < f64::from(in_line) {
        align(&mut start, task.side, stream);
    }
    Ok(start)
}

/// Everything uniform in the centred square. A task that validates has room; if luck runs out all the same, agents and
/// balls share a lattice.
fn uniform(n: usize, side: f32, stream: &mut Stream) -> Start {
    let balls = scatter(n, side, SPACING, None, stream);
    let both = balls.and_then(|balls| {
        let agents = scatter(n, side, CONTACT_DISTANCE, Some((&balls, PUSH_DISTANCE)), stream)?;
        Some((agents, balls))
    });
    let (agents, balls) = both.unwrap_or_else(|| {
        let mut agents = lattice(2 * n, side, SPACING, stream);
        let balls = agents.split_off(2 * n);
        (agents, balls)
    });
    let landmarks = scatter(n, side, SPACING, None, stream).unwrap_or_else(|| lattice(n, side, SPACING, stream));
    Start { agents, balls, landmarks }
}

/// Balls on their curves, agents and landmarks on the slots, in random order, each moved along its curve by up to `jitter` of
/// the way to a neighbour. A slot that a ball reaches into goes to a landmark.
fn on_layout(task: &TaskConfig, fixed: Option<u8>, jitter: f64, stream: &mut Stream) -> Start {
    let layout = layout(fixed.unwrap_or_else(|| stream.below(u32::from(LAYOUTS)) as u8), task.agents);
    let scale = scale(task);
    let places = |points: &Points| -> Vec<(Curve, usize, usize)> {
        points.iter().flat_map(|&(curve, n)| (0..n).map(move |k| (curve.scaled(scale), k, n))).collect()
    };
    let moved = |&(curve, k, n): &(Curve, usize, usize), stream: &mut Stream| {
        curve.jittered((k, n), jitter, SPACING, stream).map(|c| c as f32)
    };

    let mut balls: Vec<[f32; 2]> = places(&layout.balls).iter().map(|place| moved(place, stream)).collect();
    stream.shuffle(&mut balls);
    let balls = balls.concat();
    let blocked = |&[x, y]: &[f32; 2]| near(&balls, x, y, PUSH_DISTANCE);
    let free = |place: &(Curve, usize, usize)| {
        let mut point = moved(place, stream);
        for _ in 0..PATIENCE {
            if !blocked(&point) {
                break;
            }
            point = moved(place, stream);
        }
        point
    };
    let mut slots: Vec<[f32; 2]> = places(&layout.slots).iter().map(free).collect();
    stream.shuffle(&mut slots);
    slots.sort_by_key(blocked);
    let mut agents = slots.concat();
    let landmarks = agents.split_off(2 * task.agents);
    Start { agents, balls, landmarks }
}

/// Puts an agent exactly in line with each ball, and a landmark behind the agent, exactly or nearly in the same direction,
/// wherever the map and the spacings leave room: the start from which a policy without a preferred side pushes its ball
/// straight away from the landmark for ever. Random positions never show it, fixed layouts do.
fn align(start: &mut Start, side: f32, stream: &mut Stream) {
    let Start { agents, balls, landmarks } = start;
    for (i, ball) in balls.chunks_exact(2).enumerate() {
        for _ in 0..PATIENCE {
            let (axis, sign) = (stream.below(2) as usize, if stream.below(2) == 0 { 1.0 } else { -1.0 });
            let along = |distance: f64, aside: f64| {
                let mut point = [ball[0], ball[1]];
                point[axis] += sign * distance as f32;
                point[1 - axis] += (distance * aside) as f32;
                point
            };
            let far = f64::from(side) / 2.0;
            let agent = along(stream.range(IN_LINE, far), 0.0);
            let aside = if stream.below(4) == 0 { 0.0 } else { stream.range(-ASIDE, ASIDE) };
            let landmark = along(stream.range(IN_LINE, far), aside);
            let inside = |point: [f32; 2]| point.iter().all(|c| c.abs() <= side / 2.0);
            let apart = |points: &[f32], [x, y]: [f32; 2], spacing: f64| {
                !near(&points[..2 * i], x, y, spacing) && !near(&points[2 * i + 2..], x, y, spacing)
            };
            if inside(agent)
                && inside(landmark)
                && apart(agents, agent, CONTACT_DISTANCE)
                && apart(landmarks, landmark, SPACING)
                && !near(balls, agent[0], agent[1], PUSH_DISTANCE)
            {
                agents[2 * i..2 * i + 2].copy_from_slice(&agent);
                landmarks[2 * i..2 * i + 2].copy_from_slice(&landmark);
                break;
            }
        }
    }
}

#[cfg(test)]
mod tests;
