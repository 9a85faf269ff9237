//! The reason of a changed goal, as a sentence.

use magex_proto::v1;

pub(super) fn sentence(
    reason: v1::ChangeReason,
    agent: &str,
    from: Option<&str>,
    to: Option<&str>,
    saving: Option<f64>,
    switching_cost: f64,
) -> String {
    let (from, then) =
        (from.unwrap_or_default(), to.map_or_else(|| "it has no goal now".into(), |to| format!("it gets {to}")));
    match reason {
        v1::ChangeReason::Assigned => format!("{agent} had no goal and gets {}", to.unwrap_or_default()),
        v1::ChangeReason::Switched => {
            let saves = saving.map_or_else(
                || "the changed team saves more than".to_owned(),
                |saving| format!("the team saves {saving:.4}, more than"),
            );
            let to = to.unwrap_or_default();
            format!("{agent} switches from {from} to {to}: {saves} the switching cost of {switching_cost} per agent")
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
        v1::ChangeReason::Unspecified => String::new(),
    }
}
