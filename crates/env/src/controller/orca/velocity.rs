//! Optimal reciprocal collision avoidance (van den Berg, Guy, Lin, Manocha, "Reciprocal n-body collision avoidance", 2011):
//! the velocity nearest to the preferred one that, with every neighbour doing its half, collides with none of them for τ
//! seconds. Only square roots besides plain arithmetic: the same bits on every machine.

/// A point or velocity of the plane.
pub(super) type Vector = [f64; 2];

/// Below it two directions count as parallel.
const PARALLEL: f64 = 1e-5;

/// What an agent knows about itself and others; lengths in world units, times in seconds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Settings {
    /// Time in which a collision that has happened is to be undone.
    pub(super) time_step: f64,
    /// τ: for how long a velocity has to be safe.
    pub(super) time_horizon: f64,
    /// Neighbours are nearer than this.
    pub(super) neighbour_distance: f64,
    /// At most this many count, the nearest ones.
    pub(super) max_neighbours: usize,
    /// Radius of every agent.
    pub(super) radius: f64,
    /// Length of a velocity at most.
    pub(super) max_speed: f64,
}

/// Allowed velocities are to the left of `direction` (of length 1) through `point`.
#[derive(Debug, Clone, Copy)]
struct HalfPlane {
    point: Vector,
    direction: Vector,
}

impl HalfPlane {
    /// How far a velocity is on the wrong side; negative on the right one.
    fn violation(&self, velocity: Vector) -> f64 {
        det(self.direction, sub(self.point, velocity))
    }
}

/// Numbers of the nearest neighbours of an agent, the nearest first, ties by number. `by_x` are all agents by their x.
pub(super) fn neighbours(settings: &Settings, positions: &[Vector], by_x: &[u32], agent: usize) -> Vec<u32> {
    let own = positions[agent];
    let from = by_x.partition_point(|&k| positions[k as usize][0] <= own[0] - settings.neighbour_distance);
    let mut found: Vec<(f64, u32)> = by_x[from..]
        .iter()
        .take_while(|&&k| positions[k as usize][0] < own[0] + settings.neighbour_distance)
        .filter(|&&k| k as usize != agent)
        .map(|&k| (square(sub(positions[k as usize], own)), k))
        .filter(|&(distance2, _)| distance2 < settings.neighbour_distance * settings.neighbour_distance)
        .collect();
    found.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    found.into_iter().take(settings.max_neighbours).map(|(_, k)| k).collect()
}

/// The agents by their x, ties by number.
pub(super) fn sorted_by_x(positions: &[Vector]) -> Vec<u32> {
    let mut order: Vec<u32> = (0..positions.len() as u32).collect();
    order.sort_unstable_by(|&a, &b| positions[a as usize][0].total_cmp(&positions[b as usize][0]).then(a.cmp(&b)));
    order
}

/// The new velocity of an agent among its neighbours.
pub(super) fn velocity(
    settings: &Settings,
    (positions, velocities): (&[Vector], &[Vector]),
    (agent, neighbours): (usize, &[u32]),
    preferred: Vector,
) -> Vector {
    let planes: Vec<HalfPlane> =
        neighbours.iter().map(|&k| half_plane(settings, positions, velocities, (agent, k as usize))).collect();
    let (velocity, failed) = nearest_allowed(&planes, settings.max_speed, preferred);
    failed.map_or(velocity, |first| least_violation(&planes, first, settings.max_speed, velocity))
}

/// The velocities that an agent may choose if it does half of what is needed to avoid the other one.
fn half_plane(
    settings: &Settings,
    positions: &[Vector],
    velocities: &[Vector],
    (agent, other): (usize, usize),
) -> HalfPlane {
    let way = sub(positions[other], positions[agent]);
    let relative = sub(velocities[agent], velocities[other]);
    let (distance2, touch) = (square(way), 2.0 * settings.radius);
    let apart = distance2 > touch * touch;
    // The velocity obstacle is a cone, cut off by a disc around way / time.
    let time = if apart { settings.time_horizon } else { settings.time_step };
    let w = sub(relative, scale(way, 1.0 / time));
    let along = dot(w, way);
    let (direction, change) = if !apart || (along < 0.0 && along * along > touch * touch * square(w)) {
        // Out of the disc.
        let length = square(w).sqrt();
        // Two agents at one place with one velocity part along x.
        let side = if agent < other { -1.0 } else { 1.0 };
        let unit = if length > 0.0 { scale(w, 1.0 / length) } else { [side, 0.0] };
        ([unit[1], -unit[0]], scale(unit, touch / time - length))
    } else {
        // To the nearer leg of the cone.
        let leg = (distance2 - touch * touch).sqrt();
        let direction = if det(way, w) > 0.0 {
            [way[0] * leg - way[1] * touch, way[0] * touch + way[1] * leg]
        } else {
            [-(way[0] * leg + way[1] * touch), way[0] * touch - way[1] * leg]
        };
        let direction = scale(direction, 1.0 / distance2);
        (direction, sub(scale(direction, dot(relative, direction)), relative))
    };
    HalfPlane { point: add(velocities[agent], scale(change, 0.5)), direction }
}

/// Linear program in two dimensions: the velocity of at most `speed` nearest to `wanted` in all half-planes, one after the
/// other; the place of the first one that leaves nothing, with the velocity before it.
fn nearest_allowed(planes: &[HalfPlane], speed: f64, wanted: Vector) -> (Vector, Option<usize>) {
    let length2 = square(wanted);
    let velocity = if length2 > speed * speed { scale(wanted, speed / length2.sqrt()) } else { wanted };
    in_order(planes, speed, velocity, |line| dot(line.direction, sub(wanted, line.point)))
}

/// The same, but the velocity farthest along `direction`, of length 1.
fn farthest_allowed(planes: &[HalfPlane], speed: f64, direction: Vector) -> (Vector, Option<usize>) {
    let best = |line: &HalfPlane| if dot(direction, line.direction) > 0.0 { f64::INFINITY } else { f64::NEG_INFINITY };
    in_order(planes, speed, scale(direction, speed), best)
}

fn in_order(
    planes: &[HalfPlane],
    speed: f64,
    mut velocity: Vector,
    best: impl Fn(&HalfPlane) -> f64,
) -> (Vector, Option<usize>) {
    for (k, plane) in planes.iter().enumerate() {
        if plane.violation(velocity) > 0.0 {
            let Some((left, right)) = segment(&planes[..k], plane, speed) else { return (velocity, Some(k)) };
            velocity = add(plane.point, scale(plane.direction, best(plane).max(left).min(right)));
        }
    }
    (velocity, None)
}

/// Linear program in one dimension: the part of a half-plane's line, in lengths of its direction, within the disc of `speed`
/// and the other half-planes.
fn segment(others: &[HalfPlane], line: &HalfPlane, speed: f64) -> Option<(f64, f64)> {
    let middle = dot(line.point, line.direction);
    let room = middle * middle + speed * speed - square(line.point);
    if room < 0.0 {
        return None;
    }
    let (mut left, mut right) = (-middle - room.sqrt(), -middle + room.sqrt());
    for other in others {
        let turn = det(line.direction, other.direction);
        let beyond = det(other.direction, sub(line.point, other.point));
        if turn.abs() <= PARALLEL {
            if beyond < 0.0 {
                return None;
            }
            continue;
        }
        if turn > 0.0 {
            right = right.min(beyond / turn);
        } else {
            left = left.max(beyond / turn);
        }
        if left > right {
            return None;
        }
    }
    Some((left, right))
}

/// Linear program in three dimensions, where the half-planes from `first` on leave nothing: the velocity whose largest
/// violation is least.
fn least_violation(planes: &[HalfPlane], first: usize, speed: f64, mut velocity: Vector) -> Vector {
    let mut worst = 0.0;
    for (k, plane) in planes.iter().enumerate().skip(first) {
        if plane.violation(velocity) <= worst {
            continue;
        }
        // Where each earlier half-plane is violated as much as this one.
        let equal: Vec<HalfPlane> = planes[..k]
            .iter()
            .filter_map(|other| {
                let turn = det(plane.direction, other.direction);
                let point = if turn.abs() > PARALLEL {
                    let t = det(other.direction, sub(plane.point, other.point)) / turn;
                    add(plane.point, scale(plane.direction, t))
                } else if dot(plane.direction, other.direction) > 0.0 {
                    return None;
                } else {
                    scale(add(plane.point, other.point), 0.5)
                };
                let direction = sub(other.direction, plane.direction);
                Some(HalfPlane { point, direction: scale(direction, 1.0 / square(direction).sqrt()) })
            })
            .collect();
        let inwards = [-plane.direction[1], plane.direction[0]];
        // It fails by rounding only; the velocity so far is on the boundary then.
        if let (better, None) = farthest_allowed(&equal, speed, inwards) {
            velocity = better;
        }
        worst = plane.violation(velocity);
    }
    velocity
}

pub(super) fn add(a: Vector, b: Vector) -> Vector {
    [a[0] + b[0], a[1] + b[1]]
}

pub(super) fn sub(a: Vector, b: Vector) -> Vector {
    [a[0] - b[0], a[1] - b[1]]
}

pub(super) fn scale(a: Vector, by: f64) -> Vector {
    [a[0] * by, a[1] * by]
}

pub(super) fn square(a: Vector) -> f64 {
    dot(a, a)
}

fn dot(a: Vector, b: Vector) -> f64 {
    a[0] * b[0] + a[1] * b[1]
}

fn det(a: Vector, b: Vector) -> f64 {
    a[0] * b[1] - a[1] * b[0]
}
