//! The reason of a changed goal, as a sentence.

use magex_proto::v1;

/// An agent whose goal changed, and what the team gains.
pub(super) struct Exchange<'a> {
    pub(super) agent: &'a str,
    pub(super) from: Option<&'a str>,
    pub(super) to: Option<&'a str>,
    pub(super) saving: Option<f64>,
    /// Agents of the team that leave a goal which they could have kept, or that another agent got.
    pub(super) switches: u32,
    pub(super) switching_cost: f64,
}

impl Exchange<'_> {
    pub(super) fn sentence(&self, reason: v1::ChangeReason) -> String {
        let Self { agent, from, to, saving, switches, switching_cost } = *self;
        let (from, then) =
            (from.unwrap_or_default(), to.map_or_else(|| "it has no goal now".into(), |to| format!("it gets {to}")));
        match reason {
            v1::ChangeReason::Assigned => format!("{agent} had no goal and gets {}", to.unwrap_or_default()),
            v1::ChangeReason::Switched => {
                let to = to.unwrap_or_default();
                // Who leaves at the same time for another reason pays nothing, but is not told apart here.
                match saving.filter(|saving| *saving > switching_cost * f64::from(switches)) {
                    Some(saving) => format!(
                        "{agent} switches from {from} to {to}: the costs of the team fall by {saving:.4}, more than {switches} x \
                     the switching cost of {switching_cost}"
                    ),
                    None => format!(
                        "{agent} switches from {from} to {to}: with other changes of the team that is worth more than the \
                     switching cost of {switching_cost}"
                    ),
                }
            }
            v1::ChangeReason::AgentFailed => format!("{agent} failed and loses {from}"),
            v1::ChangeReason::AgentFinished => format!("{agent} finished and loses {from}"),
            v1::ChangeReason::AgentRemoved => format!("{agent} was removed and loses {from}"),
            v1::ChangeReason::GoalFailed => format!("{from}, the goal of {agent}, failed; {then}"),
            v1::ChangeReason::GoalFinished => format!("{from}, the goal of {agent}, is finished; {then}"),
            v1::ChangeReason::GoalRemoved => format!("{from}, the goal of {agent}, was removed; {then}"),
            v1::ChangeReason::PairForbidden => format!("the pair of {agent} and {from} is forbidden now; {then}"),
            v1::ChangeReason::Displaced => {
                format!("another agent gets {from}, the goal of {agent}, at a lower cost of the team; {then}")
            }
            v1::ChangeReason::Forfeited => format!("{agent} gives {from} back; {then}"),
            v1::ChangeReason::Pinned => {
                format!("{agent} leaves {from}, because a pair with one of the two is pinned; {then}")
            }
            v1::ChangeReason::TooLate => format!("{agent} can no longer be at {from} in time; {then}"),
            v1::ChangeReason::NotOpen => format!("{from}, the goal of {agent}, waits for another goal; {then}"),
            v1::ChangeReason::Unspecified => String::new(),
        }
    }
}
