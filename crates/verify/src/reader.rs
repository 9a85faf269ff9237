//! JSON values that know where they are, so that every error names its field.

use magex_core::error::FieldError;
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

    pub(crate) fn wrong(&self, problem: impl Into<String>) -> FieldError {
        let field = if self.path.is_empty() { "recording" } else { &self.path };
        FieldError::new(field, problem)
    }

    /// A member of an object.
    pub(crate) fn get(&self, name: &str) -> Result<Field<'a>, FieldError> {
        let path = if self.path.is_empty() { name.to_owned() } else { format!("{}.{name}", self.path) };
        let object = self.value.as_object().ok_or_else(|| self.wrong("must be an object"))?;
        match object.get(name) {
            Some(value) => Ok(Field { path, value }),
            None => Err(FieldError::new(path, "is missing")),
        }
    }

    /// Where it is in the file, such as `cases[3]`; empty for the whole file.
    pub(crate) fn path(&self) -> &str {
        &self.path
    }

    /// A member of an object, unless it is missing or null.
    pub(crate) fn optional(&self, name: &str) -> Result<Option<Field<'a>>, FieldError> {
        match self.get(name) {
            Ok(field) => Ok(Some(field).filter(|field| !field.is_null())),
            Err(_) if self.value.is_object() => Ok(None),
            Err(error) => Err(error),
        }
    }

    pub(crate) fn is_null(&self) -> bool {
        self.value.is_null()
    }

    pub(crate) fn text(&self) -> Result<&'a str, FieldError> {
        self.value.as_str().ok_or_else(|| self.wrong("must be a string"))
    }

    pub(crate) fn flag(&self) -> Result<bool, FieldError> {
        self.value.as_bool().ok_or_else(|| self.wrong("must be true or false"))
    }

    /// A finite number.
    pub(crate) fn number(&self) -> Result<f64, FieldError> {
        let number = self.value.as_f64().filter(|number| number.is_finite());
        number.ok_or_else(|| self.wrong("must be a finite number"))
    }

    pub(crate) fn positive(&self) -> Result<f64, FieldError> {
        let number = self.number()?;
        if number > 0.0 { Ok(number) } else { Err(self.wrong(format!("{number} must be above 0"))) }
    }

    /// A whole number in 0..bound.
    pub(crate) fn index(&self, bound: usize) -> Result<usize, FieldError> {
        let index = self.value.as_u64().and_then(|index| usize::try_from(index).ok());
        index.filter(|&index| index < bound).ok_or_else(|| self.wrong(format!("must be a whole number below {bound}")))
    }

    /// A whole number in 1..bound.
    pub(crate) fn count(&self, bound: usize) -> Result<usize, FieldError> {
        match self.index(bound)? {
            0 => Err(self.wrong("must be at least 1")),
            count => Ok(count),
        }
    }

    /// The elements of a list of known length.
    pub(crate) fn list(&self, len: usize) -> Result<impl Iterator<Item = Field<'a>> + use<'a>, FieldError> {
        let list = self.value.as_array().ok_or_else(|| self.wrong("must be a list"))?;
        if list.len() != len {
            return Err(self.wrong(format!("has {} entries, {len} are needed", list.len())));
        }
        let path = self.path.clone();
        Ok(list.iter().enumerate().map(move |(k, value)| Field { path: format!("{path}[{k}]"), value }))
    }

    /// The elements of a list of at most `most`.
    pub(crate) fn items(&self, most: usize) -> Result<impl Iterator<Item = Field<'a>> + use<'a>, FieldError> {
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
        read: impl Fn(&Field<'a>) -> Result<T, FieldError>,
    ) -> Result<Vec<T>, FieldError> {
        self.list(len)?.map(|field| read(&field)).collect()
    }

    /// The elements of a list of N, read.
    pub(crate) fn fixed<T, const N: usize>(
        &self,
        read: impl Fn(&Field<'a>) -> Result<T, FieldError>,
    ) -> Result<[T; N], FieldError> {
        self.each(N, read)?.try_into().map_err(|_| self.wrong(format!("must have {N} entries")))
    }

    /// N finite numbers.
    pub(crate) fn array<const N: usize>(&self) -> Result<[f64; N], FieldError> {
        self.fixed(Field::number)
    }

    /// The value before the first step, `init_<name>`, and those after each of `steps` steps, `<name>`.
    pub(crate) fn series<T>(
        &self,
        name: &str,
        steps: usize,
        read: impl Fn(&Field<'a>) -> Result<T, FieldError>,
    ) -> Result<Vec<T>, FieldError> {
        let mut all = vec![read(&self.get(&format!("init_{name}"))?)?];
        all.extend(self.get(name)?.each(steps, read)?);
        Ok(all)
    }
}
