//! What a series in a plot is of: one name and one colour each, wherever it is drawn.

/// A kind of series.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// An episode metric of the greedy evaluation.
    Greedy,
    /// An episode metric of the training episodes, which sample their actions and goals.
    Sampled,
    /// A number of the update of the actor network.
    Actor,
    /// A number of the update of the critic network.
    Critic,
    /// A number of the update of the goal commander.
    Commander,
}

/// How a kind is called and drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Look {
    /// Its class in a picture and, behind two hyphens, its variable in a style sheet.
    pub class: &'static str,
    /// Its words in a legend.
    pub label: &'static str,
    /// Its colour on white.
    pub light: &'static str,
    /// Its colour on black.
    pub dark: &'static str,
}

impl Kind {
    /// Every kind.
    pub const ALL: [Self; 5] = [Self::Greedy, Self::Sampled, Self::Actor, Self::Critic, Self::Commander];

    /// How it is called and drawn.
    pub const fn look(self) -> Look {
        let (class, label, light, dark) = match self {
            Self::Greedy => ("greedy", "greedy evaluation", "#2f6fde", "#6ea3ff"),
            Self::Sampled => ("sampled", "sampled in training", "#c2570c", "#f2a057"),
            Self::Actor => ("actor", "actor", "#8b4fd8", "#c9a2ff"),
            Self::Critic => ("critic", "critic", "#0b7d84", "#4fc9cf"),
            Self::Commander => ("commander", "commander", "#b8327a", "#f08cc0"),
        };
        Look { class, label, light, dark }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn no_two_kinds_look_alike() {
        let fields: [fn(Look) -> &'static str; 4] = [|k| k.class, |k| k.label, |k| k.light, |k| k.dark];
        for field in fields {
            assert_eq!(Kind::ALL.iter().map(|kind| field(kind.look())).collect::<BTreeSet<_>>().len(), Kind::ALL.len());
        }
    }
}
