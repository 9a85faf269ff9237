//! What an environment says about itself.

use super::EnvironmentError;
use magex_core::task::ExternalConfig;
use magex_proto::v1::EnvironmentDescription;
use magex_proto::v1::environment_description::Action;

/// Version of `environment.proto` that this program speaks.
pub(super) const PROTOCOL: u32 = 1;

/// A description as the configuration of a run has it.
///
/// # Errors
/// It speaks another version, or has no action.
pub(super) fn read(description: &EnvironmentDescription) -> Result<ExternalConfig, EnvironmentError> {
    let broke = |problem: String| Err(EnvironmentError::BrokeItsWord(problem));
    if description.protocol != PROTOCOL {
        let other = description.protocol;
        return broke(format!(
            "it speaks version {other} of environment.proto, this program {PROTOCOL}; use the same release"
        ));
    }
    let (choices, low, high) = match &description.action {
        Some(Action::Discrete(action)) => {
            (action.choices.iter().map(|&choices| choices as usize).collect(), Vec::new(), Vec::new())
        }
        Some(Action::Continuous(action)) => (Vec::new(), action.low.clone(), action.high.clone()),
        None => return broke("its description has no action; set discrete or continuous".to_owned()),
    };
    let external = ExternalConfig {
        environment: description.name.clone(),
        agent_names: description.agents.clone(),
        observation_width: description.observation_width as usize,
        choices,
        low,
        high,
        state_width: description.state_width as usize,
        masks: description.masks,
        successes: description.successes,
        renders: description.renders,
        deterministic: description.deterministic,
    };
    if external.agent_names.is_empty() {
        return broke("its description names no agents".to_owned());
    }
    Ok(external)
}

/// The first key in which an environment is not the one of a run. What does not reach a number does not count, nor what an
/// environment finds out about itself by playing and may find out otherwise the next time.
pub(super) fn difference(run: &ExternalConfig, now: &ExternalConfig) -> Option<String> {
    let ExternalConfig { renders, deterministic, successes, .. } = *run;
    let alike = ExternalConfig { renders, deterministic, successes, ..now.clone() };
    let key = run.changed(&alike)?;
    let value = |config: &ExternalConfig| {
        let table = toml::Value::try_from(config).ok()?;
        Some(table.get(key)?.to_string())
    };
    let (run, now) = (value(run).unwrap_or_default(), value(now).unwrap_or_default());
    Some(format!("task.external.{key} is {now}, and {run} in the run"))
}
