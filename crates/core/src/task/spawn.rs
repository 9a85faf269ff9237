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
    fn try_from(text: String) -> Result<Self, UnknownName> {
        let unknown = || UnknownName {
            what: "spawn mode",
            name: text.clone(),
            choices: "uniform, lines, lines-0..3, authors or authors-0..3",
        };
        let layout = |suffix: &str| match suffix {
            "" => Ok(None),
            "-0" => Ok(Some(0)),
            "-1" => Ok(Some(1)),
            "-2" => Ok(Some(2)),
            "-3" => Ok(Some(3)),
            _ => Err(unknown()),
        };
        if text == "uniform" {
            Ok(Self::Uniform)
        } else if let Some(rest) = text.strip_prefix("lines") {
            layout(rest).map(Self::Lines)
        } else if let Some(rest) = text.strip_prefix("authors") {
            layout(rest).map(Self::Authors)
        } else {
            Err(unknown())
        }
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
        let suffix = |layout: Option<u8>| layout.map(|k| format!("-{k}")).unwrap_or_default();
        match spawn {
            Spawn::Uniform => "uniform".into(),
            Spawn::Lines(layout) => format!("lines{}", suffix(layout)),
            Spawn::Authors(layout) => format!("authors{}", suffix(layout)),
        }
    }
}

impl std::fmt::Display for Spawn {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&String::from(*self))
    }
}
