//! A recording as data.

use crate::error::RecordingError;
use crate::reader::Field;

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
    /// Simple Spread.
    Spread {
        /// `[N]` landmark of each agent.
        goals: Vec<usize>,
        /// Unit of the distances in the reward.
        distance_unit: f64,
    },
    /// Push Ball.
    PushBall {
        /// `[N]` ball and landmark of each agent.
        goals: Vec<[usize; 2]>,
    },
}

/// One recorded episode.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Recording {
    /// Its name.
    pub name: String,
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
    /// Direction of each action.
    pub directions: [[f64; 2]; 5],
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
    pub(super) fn parse(text: &str) -> Result<Self, RecordingError> {
        let value: serde_json::Value = serde_json::from_str(text)?;
        let root = Field::root(&value);
        let format = root.get("format")?.text()?;
        if format != super::FORMAT {
            return Err(RecordingError::Format { found: format.to_owned(), expected: super::FORMAT });
        }
        let scenario = root.get("scenario")?.text()?;
        let pushing = match scenario {
            "spread" => false,
            "push_ball" => true,
            _ => return Err(RecordingError::UnsupportedScenario { found: scenario.to_owned() }),
        };
        let n = root.get("n_agents")?.index(MOST_AGENTS)?;
        let g = root.get("n_landmarks")?.index(MOST)?;
        let steps = root.get("T")?.index(MOST)?;
        let balls = root.get("n_balls")?.index(if pushing { MOST_AGENTS } else { 1 })?;
        for (count, name) in [(n, "n_agents"), (g, "n_landmarks"), (balls, "n_balls")] {
            if count == 0 && (pushing || name != "n_balls") {
                return Err(root.get(name)?.wrong("must be at least 1"));
            }
        }
        let mut bodies = Self::bodies(&root.get("entities")?, [n, balls, g])?;
        let landmarks = bodies.split_off(n + balls);
        let meta = root.get("meta")?;
        if meta.get("max_speed").is_ok_and(|speed| !speed.is_null()) {
            return Err(meta.get("max_speed")?.wrong("is not supported; must be null"));
        }
        Ok(Self {
            name: root.get("name")?.text()?.to_owned(),
            dt: meta.get("dt")?.positive()?,
            damping: meta.get("damping")?.number()?,
            contact_force: meta.get("contact_force")?.number()?,
            contact_margin: meta.get("contact_margin")?.positive()?,
            sensitivity: meta.get("action_sensitivity")?.number()?,
            directions: Self::directions(&meta.get("action_uxuy")?)?,
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
            frames: Self::frames(&root, (n, n + balls + g), steps)?,
            divergence: root.get("divergence_1e-12")?.each(steps, Field::number)?,
        })
    }

    fn directions(field: &Field<'_>) -> Result<[[f64; 2]; 5], RecordingError> {
        let mut directions = [[0.0; 2]; 5];
        for (action, direction) in directions.iter_mut().enumerate() {
            let pair = field.get(&action.to_string())?.each(2, Field::number)?;
            *direction = [pair[0], pair[1]];
        }
        Ok(directions)
    }

    fn bodies<'a>(field: &Field<'a>, [n, balls, g]: [usize; 3]) -> Result<Vec<Body>, RecordingError> {
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

    fn frames(root: &Field<'_>, (n, all): (usize, usize), steps: usize) -> Result<Vec<Frame>, RecordingError> {
        let points = |field: &Field<'_>| field.points(all);
        let numbers = |field: &Field<'_>| field.each(n, Field::number);
        let first = Frame {
            positions: points(&root.get("init_pos")?)?,
            velocities: points(&root.get("init_vel")?)?,
            rewards: numbers(&root.get("init_reward_exe")?)?,
            success_rate: root.get("init_success_rate")?.number()?,
            overlaps: root.get("init_overlaps")?.index(usize::MAX)?,
        };
        let positions = root.get("pos")?.each(steps, points)?;
        let velocities = root.get("vel")?.each(steps, points)?;
        let rewards = root.get("reward_exe")?.each(steps, numbers)?;
        let success = root.get("success_rate")?.each(steps, Field::number)?;
        let overlaps = root.get("overlaps")?.each(steps, |count| count.index(usize::MAX))?;
        let states = positions.into_iter().zip(velocities);
        let rest = states.zip(rewards).zip(success.into_iter().zip(overlaps)).map(
            |(((positions, velocities), rewards), (success_rate, overlaps))| Frame {
                positions,
                velocities,
                rewards,
                success_rate,
                overlaps,
            },
        );
        Ok(std::iter::once(first).chain(rest).collect())
    }
}
