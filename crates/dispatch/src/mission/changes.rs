//! Why an agent's goal changed, as a sentence.

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
        (from.unwrap_or_default(), to.map_or_else(|| "no goal is left for it".into(), |to| format!("{to} is next")));
    match reason {
        v1::ChangeReason::Assigned => format!("{agent} had no goal and takes {}", to.unwrap_or_default()),
        v1::ChangeReason::Switched => match saving {
            Some(saving) => format!(
                "{agent} leaves {from} for {}: the team saves {saving:.4}, more than the switching cost of {switching_cost} each",
                to.unwrap_or_default()
            ),
            None => format!(
                "{agent} leaves {from} for {}: the team as it is now is served better, by more than the switching cost of {switching_cost} each",
                to.unwrap_or_default()
            ),
        },
        v1::ChangeReason::AgentFailed => format!("{agent} failed and gives up {from}"),
        v1::ChangeReason::AgentFinished => format!("{agent} has finished and gives up {from}"),
        v1::ChangeReason::AgentRemoved => format!("{agent} was removed and gives up {from}"),
        v1::ChangeReason::GoalFailed => format!("{from} failed; {then}"),
        v1::ChangeReason::GoalFinished => format!("{from} is finished; {then}"),
        v1::ChangeReason::GoalRemoved => format!("{from} was removed; {then}"),
        v1::ChangeReason::PairForbidden => format!("{agent} must not go to {from} any more; {then}"),
        v1::ChangeReason::Displaced => format!("{from} serves the team better with another agent; {then}"),
        v1::ChangeReason::Unspecified => String::new(),
    }
}
