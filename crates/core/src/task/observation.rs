//! What an agent sees of a joint state, as numbers that the networks' features are made with.

/// The axes that an agent sees the world along.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Frame {
    /// The axes of the world.
    #[default]
    World,
    /// The axes of the world, mirrored and swapped so that the way of the agent's ball to its landmark points along the
    /// first one, and the agent is always on the same side of that way. The policy need not learn eight copies of one skill,
    /// and is never of two minds about which way to walk around a ball; its actions are turned back.
    Push,
}

/// Sizes that a task's features are measured with. Lengths are world units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    /// Unit of velocities, world units per second.
    pub speed: f32,
    /// Within this distance the direction to a target fades, so that it has no jump at the target.
    pub fade_radius: f32,
    /// Bodies farther than this are not seen as neighbours.
    pub sensing_radius: f32,
    /// Distance at which the last target counts as reached.
    pub success_radius: f32,
    /// Distance at which two agents touch.
    pub contact_radius: f32,
    /// The axes that an agent sees the world along.
    pub frame: Frame,
    /// Neighbours are seen with the time and the offset of their closest approach, by every executor but the literal one.
    pub encounters: bool,
    /// Which of an agent's agent_state says (by 1) that it is out of the episode: others do not see it any more.
    pub out: Option<usize>,
}

impl Observation {
    /// The sizes of Simple Spread, from which the other tasks differ in part.
    pub(super) const SIMPLE_SPREAD: Self = Self {
        speed: 2.0,
        fade_radius: 0.3,
        sensing_radius: 1.0,
        success_radius: 0.15,
        contact_radius: 0.2,
        frame: Frame::World,
        encounters: false,
        out: None,
    };
}
