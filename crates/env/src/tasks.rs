//! The list of tasks.

use crate::controller::{
    Astar, Classical, Controller, DroneScript, Nearest, Orca, PushBallScript, Random, SpreadScript,
};
use crate::env::Env;
use crate::rules::{Rules, Starts};
use crate::{drones, push_ball, spread};
use magex_core::error::FieldError;
use magex_core::rng::{Key, Stream};
use magex_core::task::{TaskConfig, TaskName};

/// Episodes of a task, one per stream, started as the task says. In training, starts that help learning may be mixed in. An
/// error if the task does not validate.
pub fn new_env(task: &TaskConfig, streams: impl Iterator<Item = Stream>, training: bool) -> Result<Env, FieldError> {
    assemble(task, starts(task, streams, training)?)
}

/// Where these episodes start.
pub(crate) fn starts(
    task: &TaskConfig,
    streams: impl Iterator<Item = Stream>,
    training: bool,
) -> Result<Starts, FieldError> {
    task.validate()?;
    let mut starts = Starts::none(task);
    for mut stream in streams {
        match task.name {
            TaskName::SimpleSpread => spread::start(task, &mut stream, &mut starts),
            TaskName::PushBall => push_ball::start(task, training, &mut stream, &mut starts)?,
            TaskName::Drones => drones::start(task, &mut stream, &mut starts)?,
            TaskName::External => return Err(elsewhere()),
        }
    }
    starts.velocities = vec![0.0; starts.positions.len()];
    Ok(starts)
}

/// Episodes of a task without other static arrays that start from given positions and velocities [B, E, D] and landmarks
/// [B, N, D].
pub fn env_from_state(
    task: &TaskConfig,
    positions: &[f32],
    velocities: &[f32],
    landmarks: &[f32],
) -> Result<Env, FieldError> {
    assemble(task, Starts::given(task, [positions, velocities, landmarks])?)
}

fn assemble(task: &TaskConfig, starts: Starts) -> Result<Env, FieldError> {
    let rules: Box<dyn Rules> = match task.name {
        TaskName::SimpleSpread => spread::rules(task, &starts)?,
        TaskName::PushBall => push_ball::rules(task, &starts)?,
        TaskName::Drones => Box::new(drones::Flight::new(task, &starts)?),
        TaskName::External => return Err(elsewhere()),
    };
    Ok(Env::new(task, starts, rules))
}

/// The refusal of a task that is not simulated here.
fn elsewhere() -> FieldError {
    FieldError::new("task.name", "external is simulated by a program of its own; give --environment")
}

/// The scripted controller of a task: a yardstick.
pub fn scripted(task: &TaskConfig) -> Box<dyn Controller> {
    match task.name {
        TaskName::SimpleSpread | TaskName::External => Box::new(SpreadScript::new(task.agents)),
        TaskName::PushBall => Box::new(PushBallScript::new(task.agents)),
        TaskName::Drones => Box::new(DroneScript::new(task.agents)),
    }
}

/// A controller without weights for B episodes of a task; `keys` (B of them) name what is random about it.
pub fn classical(kind: Classical, task: &TaskConfig, keys: &[Key]) -> Result<Box<dyn Controller>, FieldError> {
    kind.check(task)?;
    Ok(match kind {
        Classical::Scripted => scripted(task),
        Classical::Astar => Box::new(Astar::new(task)),
        Classical::Orca => Box::new(Orca::new(task, keys)),
        Classical::Nearest => Box::new(Nearest::new(task, scripted(task))),
        Classical::Random => Box::new(Random::new(task, keys)),
    })
}
