//! The list of tasks.

use crate::controller::{Controller, DroneScript, PushBallScript, SpreadScript};
use crate::drones::Drones;
use crate::env::Env;
use crate::error::EnvError;
use crate::push_ball::PushBall;
use crate::spread::Spread;
use magex_core::rng::Stream;
use magex_core::task::{TaskConfig, TaskName};

/// Episodes of a task, one per stream. In training, starts that help learning may be mixed in.
pub fn new_env(
    task: &TaskConfig,
    streams: impl Iterator<Item = Stream>,
    training: bool,
) -> Result<Box<dyn Env>, EnvError> {
    Ok(match task.name {
        TaskName::SimpleSpread => Box::new(Spread::new(task, streams, training)?),
        TaskName::PushBall => Box::new(PushBall::new(task, streams, training)?),
        TaskName::Drones => Box::new(Drones::new(task, streams, training)?),
    })
}

/// The scripted controller of a task: a yardstick.
pub fn scripted(task: &TaskConfig) -> Box<dyn Controller> {
    match task.name {
        TaskName::SimpleSpread => Box::new(SpreadScript::new(task.agents)),
        TaskName::PushBall => Box::new(PushBallScript::new(task.agents)),
        TaskName::Drones => Box::new(DroneScript::new(task.agents)),
    }
}
