//! Where an episode starts, as data.

use crate::error::UnknownName;
use serde::{Deserialize, Serialize};

/// Where agents and landmarks start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Spawn {
    /// Uniform in the box, with a minimum spacing.
    Uniform,
    /// Random positions on the lines of the paper's four layouts (fig. 3b), one layout drawn per episode, or a fixed one.
    Lines(Option<u8>),
    /// The fixed points of the authors' files, one layout drawn per episode, or a fixed one.
    Authors(Option<u8>),
}

impl TryFrom<String> for Spawn {
    type Error = UnknownName;
    fn try_from(name: String) -> Result<Self, UnknownName> {
        let layout = |prefix: &str| match name.strip_prefix(prefix)?.as_bytes() {
            [] => Some(None),
            [b'-', layout @ b'0'..=b'3'] => Some(Some(layout - b'0')),
            _ => None,
        };
        let spawn = match layout("lines") {
            _ if name == "uniform" => Some(Self::Uniform),
            Some(fixed) => Some(Self::Lines(fixed)),
            None => layout("authors").map(Self::Authors),
        };
        let choices = "uniform, lines, lines-0..3, authors or authors-0..3";
        spawn.ok_or(UnknownName { what: "spawn mode", name, choices })
    }
}

impl std::str::FromStr for Spawn {
    type Err = UnknownName;
    fn from_str(text: &str) -> Result<Self, UnknownName> {
        Self::try_from(text.to_owned())
    }
}

impl From<Spawn> for String {
    fn from(spawn: Spawn) -> Self {
        spawn.to_string()
    }
}

impl std::fmt::Display for Spawn {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (name, layout) = match self {
            Self::Uniform => ("uniform", None),
            Self::Lines(layout) => ("lines", *layout),
            Self::Authors(layout) => ("authors", *layout),
        };
        match layout {
            Some(layout) => write!(f, "{name}-{layout}"),
            None => f.write_str(name),
        }
    }
}
