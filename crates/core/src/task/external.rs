//! An external environment, which an actor calls over gRPC, as data: what it said about itself.

use super::definition::{Definition, wrong_task};
use super::{ActionCode, Bounds, Observation, TaskConfig, TaskName, TaskSettings};
use crate::error::FieldError;
use crate::section::section;
use crate::toml_table;

section! {
    /// `[task.external]`: what the environment said about itself (`EnvironmentDescription`). `magex train --environment` writes it.
    ExternalConfig {
        /// Its name.
        environment: String = String::new();
        /// The N agents by name, in the order of all arrays.
        agent_names: Vec<String> = Vec::new();
        /// V: numbers of an agent's observation.
        observation_width: usize = 0, 1..=65_536;
        /// `[H]` choices of each component of an action; empty if actions are vectors of real numbers.
        choices: Vec<usize> = Vec::new();
        /// `[C]` lower bounds of the numbers of an action; infinite if there is none.
        low: Vec<f32> = Vec::new();
        /// `[C]` upper bounds.
        high: Vec<f32> = Vec::new();
        /// S: numbers of the state of the whole world that a centralised critic sees; 0: it sees all observations.
        state_width: usize = 0, 0..=1_048_576;
        /// Whether some choices may be forbidden.
        masks: bool = false;
        /// Whether the environment says at the end of an episode if it was a success.
        successes: bool = false;
        /// Whether the environment draws pictures.
        renders: bool = false;
        /// Whether an episode is a function of its seed and its actions. If not, no shard is computed twice and the run cannot be
        /// reproduced.
        deterministic: bool = false;
    }
}

/// Largest number of choices of a component of an action.
pub const CHOICES_MAX: usize = 256;
/// Largest number of components, or of real numbers, of an action.
const COMPONENTS_MAX: usize = 256;

pub(super) const DEFINITION: Definition = Definition {
    title: "external environment",
    section: "external",
    dims: 0,
    has_balls: false,
    agent_state: 0,
    crashes: false,
    action_code: ActionCode::Own,
    stages: &[],
    statics: |_| Vec::new(),
    observation: Observation::SIMPLE_SPREAD,
    landmark_radius: 0.0,
    step_seconds: 0.1,
    side: |_| 1.0,
    horizon: |_, _| 0,
    layout_scale: |_| 1.0,
    default_settings: |_| TaskSettings::External(ExternalConfig::default()),
    read_settings: |_, section| {
        Ok(TaskSettings::External(toml_table::read("task.external", section, ExternalConfig::bounds)?))
    },
    // Whatever it is: an actor checks that it is finite.
    bounds: |_| Bounds { position: f32::MAX, velocity: f32::MAX, agent_state: f32::MAX },
    reward_range: |_, _| [f32::MIN, f32::MAX],
    validate,
};

/// The default of `task.horizon` is what the environment says; a file that says neither is refused with both remedies.
pub(super) const NO_HORIZON: &str = "missing: the joint steps of an episode, at most; longer ones are cut there";

fn validate(task: &TaskConfig) -> Result<(), FieldError> {
    let external = task.external()?;
    let field = |key: &str| format!("task.external.{key}");
    if external.agent_names.is_empty() {
        let problem = "missing: start with --environment COMMAND, which describes itself";
        return Err(FieldError::new("task.external", problem));
    }
    if external.agent_names.len() != task.agents {
        let problem = format!("{} where the environment has {} agents", task.agents, external.agent_names.len());
        return Err(FieldError::new("task.agents", problem));
    }
    external.check_ranges("task.external")?;
    let ExternalConfig { choices, low, high, masks, .. } = external;
    if choices.is_empty() == low.is_empty() {
        let problem = "an action has either choices or bounds (low and high)";
        return Err(FieldError::new(field("choices"), problem));
    }
    if choices.len().max(low.len()) > COMPONENTS_MAX {
        return Err(FieldError::new(field("choices"), format!("more than {COMPONENTS_MAX} components")));
    }
    if let Some(place) = choices.iter().position(|choices| !(1..=CHOICES_MAX).contains(choices)) {
        let problem = format!("{} is outside 1..={CHOICES_MAX}", choices[place]);
        return Err(FieldError::new(field(&format!("choices[{place}]")), problem));
    }
    if low.len() != high.len() {
        return Err(FieldError::new(field("high"), format!("{} numbers where low has {}", high.len(), low.len())));
    }
    let valid = |(low, high): (&f32, &f32)| {
        (low.is_finite() && high.is_finite() && low < high) || (*low == f32::NEG_INFINITY && *high == f32::INFINITY)
    };
    if let Some(place) = low.iter().zip(high).position(|bounds| !valid(bounds)) {
        let problem =
            format!("{} to {} must be two increasing numbers, or infinite on both sides", low[place], high[place]);
        return Err(FieldError::new(field(&format!("low[{place}]")), problem));
    }
    if *masks && choices.is_empty() {
        return Err(FieldError::new(field("masks"), "belong to choices; an action of real numbers has none"));
    }
    Ok(())
}

impl TaskConfig {
    /// What only an external environment has; an error in any other task.
    pub fn external(&self) -> Result<&ExternalConfig, FieldError> {
        match &self.settings {
            TaskSettings::External(external) => Ok(external),
            _ => Err(wrong_task(self, TaskName::External)),
        }
    }

    /// Whether a shard is a function of its name and of the weights: only then it may be computed a second time.
    pub fn pure(&self) -> bool {
        self.external().is_ok_and(|external| external.deterministic) || self.name != TaskName::External
    }
}

impl ExternalConfig {
    /// C: real numbers of an action.
    pub fn moves(&self) -> usize {
        self.low.len()
    }

    /// A point of an action's range: the policy's numbers are unbounded, tanh takes them to what the environment allows.
    pub fn to_range(&self, moves: &[f32], out: &mut Vec<f32>) {
        out.extend(moves.iter().zip(self.low.iter().zip(&self.high)).map(|(u, (low, high))| {
            if low.is_finite() { low + (high - low) * 0.5 * (libm::tanhf(*u) + 1.0) } else { *u }
        }));
    }
}
