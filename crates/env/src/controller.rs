//! Hand-written controllers: what an agent that knows its goals can reach without learning.

mod drones;
mod interface;
mod push_ball;
mod spread;

pub use drones::DroneScript;
pub use interface::Controller;
pub use push_ball::PushBallScript;
pub use spread::SpreadScript;
