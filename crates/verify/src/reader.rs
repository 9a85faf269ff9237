//! JSON values that know where they are, so that every error names its field.

use crate::error::RecordingError;
use serde_json::Value;

/// A value and its path in the file.
#[derive(Debug, Clone)]
pub(crate) struct Field<'a> {
    path: String,
    value: &'a Value,
}

impl<'a> Field<'a> {
    /// The whole file.
    pub(crate) fn root(value: &'a Value) -> Self {
        Self { path: String::new(), value }
    }

    /// An error that names this field.
    pub(crate) fn wrong(&self, problem: impl Into<String>) -> RecordingError {
        let field = if self.path.is_empty() { "recording" } else { &self.path };
        RecordingError::Field { field: field.to_owned(), problem: problem.into() }
    }

    /// A member of an object.
    pub(crate) fn get(&self, name: &str) -> Result<Field<'a>, RecordingError> {
        let path = if self.path.is_empty() { name.to_owned() } else { format!("{}.{name}", self.path) };
        let object = self.value.as_object().ok_or_else(|| self.wrong("must be an object"))?;
        match object.get(name) {
            Some(value) => Ok(Field { path, value }),
            None => Err(RecordingError::Field { field: path, problem: "is missing".into() }),
        }
    }

    /// Where it is in the file, such as `cases[3]`; empty for the whole file.
    pub(crate) fn path(&self) -> &str {
        &self.path
    }

    /// A member of an object, unless it is missing or null.
    pub(crate) fn optional(&self, name: &str) -> Result<Option<Field<'a>>, RecordingError> {
        match self.get(name) {
            Ok(field) => Ok(Some(field).filter(|field| !field.is_null())),
            Err(_) if self.value.is_object() => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Whether the field is JSON's null.
    pub(crate) fn is_null(&self) -> bool {
        self.value.is_null()
    }

    pub(crate) fn text(&self) -> Result<&'a str, RecordingError> {
        self.value.as_str().ok_or_else(|| self.wrong("must be a string"))
    }

    pub(crate) fn flag(&self) -> Result<bool, RecordingError> {
        self.value.as_bool().ok_or_else(|| self.wrong("must be true or false"))
    }

    /// A finite number.
    pub(crate) fn number(&self) -> Result<f64, RecordingError> {
        let number = self.value.as_f64().filter(|number| number.is_finite());
        number.ok_or_else(|| self.wrong("must be a finite number"))
    }

    /// A finite number above zero.
    pub(crate) fn positive(&self) -> Result<f64, RecordingError> {
        let number = self.number()?;
        if number > 0.0 { Ok(number) } else { Err(self.wrong(format!("{number} must be above 0"))) }
    }

    /// A whole number in 0..bound.
    pub(crate) fn index(&self, bound: usize) -> Result<usize, RecordingError> {
        let index = self.value.as_u64().and_then(|index| usize::try_from(index).ok());
        index.filter(|&index| index < bound).ok_or_else(|| self.wrong(format!("must be a whole number below {bound}")))
    }

    /// The elements of a list of known length.
    pub(crate) fn list(&self, len: usize) -> Result<impl Iterator<Item = Field<'a>> + use<'a>, RecordingError> {
        let list = self.value.as_array().ok_or_else(|| self.wrong("must be a list"))?;
        if list.len() != len {
            return Err(self.wrong(format!("has {} entries, {len} are needed", list.len())));
        }
        let path = self.path.clone();
        Ok(list.iter().enumerate().map(move |(k, value)| Field { path: format!("{path}[{k}]"), value }))
    }

    /// The elements of a list of at most `most`.
    pub(crate) fn items(&self, most: usize) -> Result<impl Iterator<Item = Field<'a>> + use<'a>, RecordingError> {
        let len = self.value.as_array().ok_or_else(|| self.wrong("must be a list"))?.len();
        if len > most {
            return Err(self.wrong(format!("has {len} entries, at most {most} are supported")));
        }
        self.list(len)
    }

    /// Every element of a list of known length, read.
    pub(crate) fn each<T>(
        &self,
        len: usize,
        read: impl Fn(&Field<'a>) -> Result<T, RecordingError>,
    ) -> Result<Vec<T>, RecordingError> {
        self.list(len)?.map(|field| read(&field)).collect()
    }

    /// A list of points `[len][2]`.
    pub(crate) fn points(&self, len: usize) -> Result<Vec<[f64; 2]>, RecordingError> {
        self.each(len, |point| {
            let pair = point.each(2, Field::number)?;
            Ok([pair[0], pair[1]])
        })
    }
}
