//! Actions to the wire, and what the agents of all worlds see back: sizes and numbers checked.

use super::EnvironmentError;
use magex_core::error::FieldError;
use magex_core::task::ExternalConfig;
use magex_proto::arrays;
use magex_proto::v1;
use magex_proto::v1::DataType;

/// The actions of all agents of W worlds, as a policy chose them.
#[derive(Debug, Clone, Copy)]
pub struct Taken<'a> {
    /// [W, N, H]
    pub choices: &'a [u8],
    /// [W, N, C] before they are taken to the environment's range.
    pub moves: &'a [f32],
}

impl Taken<'_> {
    pub(super) fn to_array(self, description: &ExternalConfig, worlds: usize) -> v1::Array {
        let agents = description.agent_names.len();
        if description.choices.is_empty() {
            let mut values = Vec::with_capacity(self.moves.len());
            self.moves.chunks(description.moves()).for_each(|moves| description.to_range(moves, &mut values));
            return arrays::from_f32(&[worlds, agents, description.moves()], &values);
        }
        arrays::from_u8(&[worlds, agents, description.choices.len()], self.choices)
    }
}

/// What all agents of W worlds see.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Observed {
    /// [W, N, V]
    pub observations: Vec<f32>,
    /// [W, N]
    pub rewards: Vec<f32>,
    /// [W, N] 1 for an agent whose episode ended in this step.
    pub terminated: Vec<u8>,
    /// [W, N] 1 for an agent whose episode was cut in this step.
    pub truncated: Vec<u8>,
    /// [W, N] 1 for an agent that acts next.
    pub active: Vec<u8>,
    /// [W, N, A] 1 for a choice that is allowed next; empty without masks.
    pub masks: Vec<u8>,
    /// [W, S]
    pub states: Vec<f32>,
    /// `[W]` 1 for a world whose episode ended with success; empty if the environment does not say.
    pub successes: Vec<u8>,
}

impl Observed {
    /// Checks every size and number.
    ///
    /// # Errors
    /// Names the field, and world and agent of the first number that cannot be.
    pub(super) fn read(
        message: v1::Observed,
        description: &ExternalConfig,
        worlds: usize,
    ) -> Result<Self, EnvironmentError> {
        Self::checked(message, description, worlds).map_err(|error| EnvironmentError::BrokeItsWord(error.to_string()))
    }

    fn checked(message: v1::Observed, description: &ExternalConfig, w: usize) -> Result<Self, FieldError> {
        let (n, v, s) = (description.agent_names.len(), description.observation_width, description.state_width);
        let choices: usize = description.choices.iter().sum();
        let place = |at: usize, width: usize| {
            let (row, name) = (at / width, &description.agent_names[at / width % n]);
            format!("world {}, agent {name}", row / n)
        };
        let observations = numbers("observations", message.observations, &[w, n, v])?;
        finite("observations", &observations, |at| format!("{}, number {}", place(at, v), at % v))?;
        let rewards = numbers("rewards", message.rewards, &[w, n])?;
        finite("rewards", &rewards, |at| place(at, 1))?;
        let states = if s == 0 { Vec::new() } else { numbers("states", message.states, &[w, s])? };
        finite("states", &states, |at| format!("world {}, number {}", at / s, at % s))?;
        let flags = |field: &str, bytes: &[u8], expected: usize| {
            if bytes.len() != expected {
                let problem = format!("{} bytes where {expected} are expected", bytes.len());
                return Err(FieldError::new(field, problem));
            }
            match bytes.iter().position(|&byte| byte > 1) {
                Some(at) => Err(FieldError::new(format!("{field}[{at}]"), format!("{} is not 0 or 1", bytes[at]))),
                None => Ok(bytes.to_vec()),
            }
        };
        let out = Self {
            observations,
            rewards,
            terminated: flags("terminated", &message.terminated, w * n)?,
            truncated: flags("truncated", &message.truncated, w * n)?,
            active: flags("active", &message.active, w * n)?,
            masks: if description.masks { flags("masks", &message.masks, w * n * choices)? } else { Vec::new() },
            states,
            successes: match message.successes.len() {
                0 => Vec::new(),
                _ => flags("successes", &message.successes, w)?,
            },
        };
        for at in 0..w * n {
            if out.active[at] == 1 && out.terminated[at] + out.truncated[at] > 0 {
                return Err(FieldError::new("active", format!("{}: it has ended and is said to act", place(at, 1))));
            }
            let mut from = at * choices;
            for (component, &size) in description.choices.iter().enumerate().filter(|_| description.masks) {
                if out.active[at] == 1 && out.masks[from..from + size].iter().all(|&mask| mask == 0) {
                    let problem = format!("{}: no choice of component {component} is allowed", place(at, 1));
                    return Err(FieldError::new("masks", problem));
                }
                from += size;
            }
        }
        Ok(out)
    }

    /// Whether the episode of a world of N agents is over.
    pub fn over(&self, world: usize, agents: usize) -> bool {
        self.active[world * agents..(world + 1) * agents].iter().all(|&active| active == 0)
    }
}

/// An array of either precision, in single precision.
fn numbers(field: &str, array: Option<v1::Array>, shape: &[usize]) -> Result<Vec<f32>, FieldError> {
    if array.as_ref().is_some_and(|array| array.r#type() == DataType::F64) {
        return Ok(arrays::to_f64(field, array, shape)?.into_iter().map(|x| x as f32).collect());
    }
    arrays::to_f32(field, array, shape)
}

fn finite(field: &str, values: &[f32], place: impl Fn(usize) -> String) -> Result<(), FieldError> {
    match values.iter().position(|value| !value.is_finite()) {
        Some(at) => Err(FieldError::new(field, format!("{}: {} is not finite", place(at), values[at]))),
        None => Ok(()),
    }
}
