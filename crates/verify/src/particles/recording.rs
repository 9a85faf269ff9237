//! A recording as data.

use crate::reader::Field;
use magex_core::error::FieldError;

/// Most bodies and steps a recording may have: far beyond any, small enough that sizes cannot overflow.
const MOST: usize = 1_000_000;
/// Most agents, and balls, so that a pair of them can be named by 32 bits.
const MOST_AGENTS: usize = 1 << 11;

/// An agent, a ball or a landmark.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Body {
    /// Radius in world units.
    pub size: f64,
    /// Mass.
    pub mass: f64,
    /// Whether forces move it.
    pub movable: bool,
    /// Whether it takes part in contacts.
    pub collide: bool,
}

impl Body {
    /// A body of mass 1 that moves and collides.
    pub(super) fn standard(size: f64) -> Self {
        Self { size, mass: 1.0, movable: true, collide: true }
    }
}

/// The bodies' state after a step, and what the authors' code said about it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Frame {
    /// `[N + balls + G]` agents, then balls, then landmarks.
    pub positions: Vec<[f64; 2]>,
    /// `[N + balls + G]`
    pub velocities: Vec<[f64; 2]>,
    /// `[N]`
    pub rewards: Vec<f64>,
    /// Covered landmarks / G.
    pub success_rate: f64,
    /// Pairs of colliding bodies closer than the sum of their radii.
    pub overlaps: usize,
}

/// Which task was recorded, and what only its recordings have.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Scenario {
    Spread {
        /// `[N]` landmark of each agent.
        goals: Vec<usize>,
        /// Unit of the distances in the reward.
        distance_unit: f64,
    },
    PushBall {
        /// `[N]` ball and landmark of each agent.
        goals: Vec<[usize; 2]>,
    },
}

/// One recorded episode.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Recording {
    /// Seconds per step.
    pub dt: f64,
    /// Share of the velocity lost per step.
    pub damping: f64,
    /// Stiffness of a contact.
    pub contact_force: f64,
    /// Softness of a contact in world units.
    pub contact_margin: f64,
    /// Force of an action.
    pub sensitivity: f64,
    /// N.
    pub agents: usize,
    /// `[N + balls]` everything that forces act on: agents, then balls.
    pub bodies: Vec<Body>,
    /// `[G]`
    pub landmarks: Vec<Body>,
    /// Which task it is.
    pub scenario: Scenario,
    /// `[T][N]`
    pub actions: Vec<Vec<u8>>,
    /// `[T + 1]` frame t is the state before step t.
    pub frames: Vec<Frame>,
    /// `[T]` how far a perturbation of 1e-12 has grown after each step.
    pub divergence: Vec<f64>,
}

impl Recording {
    /// Reads the format `mpe-golden-1`. Every error names its field.
    pub(super) fn read(root: &Field<'_>) -> Result<Self, FieldError> {
        root.get("name")?.text()?;
        let pushing = root.get("scenario")?.text()? == "push_ball";
        let n = root.get("n_agents")?.count(MOST_AGENTS)?;
        let g = root.get("n_landmarks")?.count(MOST)?;
        let steps = root.get("T")?.index(MOST)?;
        let balls = root.get("n_balls")?;
        let balls = if pushing { balls.count(MOST_AGENTS)? } else { balls.index(1)? };
        let mut bodies = Self::bodies(&root.get("entities")?, [n, balls, g])?;
        let landmarks = bodies.split_off(n + balls);
        let meta = root.get("meta")?;
        if let Some(speed) = meta.optional("max_speed")? {
            return Err(speed.wrong("is not supported; must be null"));
        }
        let directions = meta.get("action_uxuy")?;
        for (action, direction) in
            [("0", [0.0, 0.0]), ("1", [1.0, 0.0]), ("2", [-1.0, 0.0]), ("3", [0.0, 1.0]), ("4", [0.0, -1.0])]
        {
            let field = directions.get(action)?;
            if field.array()? != direction {
                return Err(field.wrong(format!("must be {direction:?}")));
            }
        }
        Ok(Self {
            dt: meta.get("dt")?.positive()?,
            damping: meta.get("damping")?.number()?,
            contact_force: meta.get("contact_force")?.number()?,
            contact_margin: meta.get("contact_margin")?.positive()?,
            sensitivity: meta.get("action_sensitivity")?.number()?,
            scenario: if pushing {
                let ball = root.get("ball_of_agent")?.each(n, |ball| ball.index(balls))?;
                let landmark = root.get("land_of_agent")?.each(n, |landmark| landmark.index(g))?;
                Scenario::PushBall { goals: ball.into_iter().zip(landmark).map(|(b, l)| [b, l]).collect() }
            } else {
                let goals = root.get("goal")?.each(n, |goal| goal.index(g))?;
                Scenario::Spread { goals, distance_unit: root.get("al_max_dis")?.positive()? }
            },
            agents: n,
            bodies,
            landmarks,
            actions: root.get("actions")?.each(steps, |step| step.each(n, |a| Ok(a.index(5)? as u8)))?,
            frames: Self::frames(root, (n, n + balls + g), steps)?,
            divergence: root.get("divergence_1e-12")?.each(steps, Field::number)?,
        })
    }

    fn bodies<'a>(field: &Field<'a>, [n, balls, g]: [usize; 3]) -> Result<Vec<Body>, FieldError> {
        let read = |(k, body): (usize, Field<'a>)| {
            let expected = match k {
                _ if k < n => "agent",
                _ if k < n + balls => "ball",
                _ => "landmark",
            };
            let kind = body.get("kind")?;
            if kind.text()? != expected {
                return Err(kind.wrong(format!("must be '{expected}': agents come first, then balls, then landmarks")));
            }
            let body = Body {
                size: body.get("size")?.positive()?,
                mass: body.get("mass")?.positive()?,
                movable: body.get("movable")?.flag()?,
                collide: body.get("collide")?.flag()?,
            };
            Ok((body, kind))
        };
        let bodies: Vec<_> = field.list(n + balls + g)?.enumerate().map(read).collect::<Result<_, _>>()?;
        if let Some((_, kind)) = bodies[n + balls..].iter().find(|(body, _)| body.movable || body.collide) {
            return Err(kind.wrong("a landmark neither moves nor collides"));
        }
        Ok(bodies.into_iter().map(|(body, _)| body).collect())
    }

    fn frames(root: &Field<'_>, (n, all): (usize, usize), steps: usize) -> Result<Vec<Frame>, FieldError> {
        let points = |field: &Field<'_>| field.each(all, Field::array);
        let states = root.series("pos", steps, points)?.into_iter().zip(root.series("vel", steps, points)?);
        let rewards = root.series("reward_exe", steps, |field| field.each(n, Field::number))?;
        let success = root.series("success_rate", steps, Field::number)?;
        let overlaps = root.series("overlaps", steps, |count| count.index(usize::MAX))?;
        let scores = rewards.into_iter().zip(success).zip(overlaps);
        let frame = |((positions, velocities), ((rewards, success_rate), overlaps))| Frame {
            positions,
            velocities,
            rewards,
            success_rate,
            overlaps,
        };
        Ok(states.zip(scores).map(frame).collect())
    }
}
