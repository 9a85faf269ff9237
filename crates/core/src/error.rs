//! The error of a value that is not accepted: which field, and what is wrong with it.

/// A field that is not accepted. The problem says what is wrong and, where there is one, the remedy.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{field}: {problem}")]
pub struct FieldError {
    /// Path of the field from the outermost section or message, separated by dots.
    pub field: String,
    /// What is wrong with it.
    pub problem: String,
}

impl FieldError {
    /// A problem with a field.
    pub fn new(field: impl Into<String>, problem: impl Into<String>) -> Self {
        Self { field: field.into(), problem: problem.into() }
    }

    /// A required field that is missing.
    pub fn missing(field: impl Into<String>) -> Self {
        Self::new(field, "missing")
    }

    /// `Ok` if the condition holds; otherwise the field and the problem that are given.
    ///
    /// # Errors
    /// The condition does not hold.
    pub fn ensure<F: Into<String>, P: Into<String>>(ok: bool, otherwise: impl FnOnce() -> (F, P)) -> Result<(), Self> {
        if ok {
            return Ok(());
        }
        let (field, problem) = otherwise();
        Err(Self::new(field, problem))
    }

    /// The same problem, named from the section or message that encloses the field.
    #[must_use]
    pub fn within(self, outer: &str) -> Self {
        Self { field: format!("{outer}.{}", self.field), problem: self.problem }
    }
}

/// A name that is none of the known ones.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("unknown {what} '{name}'; use {choices}")]
pub struct UnknownName {
    /// What it should name.
    pub what: &'static str,
    /// The name given.
    pub name: String,
    /// The known names.
    pub choices: &'static str,
}

/// `Ok` if the value is a number in `low..=high`.
pub(crate) fn check_range<T: PartialOrd + std::fmt::Display>(
    field: impl Into<String>,
    value: T,
    low: T,
    high: T,
) -> Result<(), FieldError> {
    if value >= low && value <= high {
        Ok(())
    } else {
        Err(FieldError::new(field, format!("{value} is out of range; write a number from {low} to {high}")))
    }
}

/// `Ok` if an array has as many entries as its shape asks for; `what` names them.
pub fn check_count(field: &str, what: &str, found: usize, expected: usize) -> Result<(), FieldError> {
    if found == expected {
        return Ok(());
    }
    Err(FieldError::new(field, format!("{found} {what}, the shape asks for {expected}")))
}

/// `Ok` if every number is finite.
pub fn check_finite(field: &str, values: &[f32]) -> Result<(), FieldError> {
    match values.iter().position(|x| !x.is_finite()) {
        None => Ok(()),
        Some(place) => Err(FieldError::new(format!("{field}[{place}]"), format!("{} is not finite", values[place]))),
    }
}
