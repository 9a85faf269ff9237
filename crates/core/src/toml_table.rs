//! Reading a table of a TOML file into a struct, with errors that name the full dotted key.

use crate::error::FieldError;
use serde::de::DeserializeOwned;
use toml::{Table, Value};

/// Reads a table whose keys may all be missing. `section` is its dotted name, empty for the file itself.
pub(crate) fn read<T: DeserializeOwned>(section: &str, table: Table) -> Result<T, FieldError> {
    let keys = table.clone();
    T::deserialize(Value::Table(table)).map_err(|error| {
        // The key that is refused by itself is the one at fault.
        let faulty = keys.into_iter().find_map(|(key, value)| {
            let alone = Table::from_iter([(key.clone(), value)]);
            T::deserialize(Value::Table(alone)).err().map(|error| (key, error))
        });
        match faulty {
            Some((key, error)) => FieldError::new(dotted(section, &key), error.message().trim()),
            None => FieldError::new(section, error.message().trim()),
        }
    })
}

pub(crate) fn dotted(section: &str, key: &str) -> String {
    if section.is_empty() { key.to_owned() } else { format!("{section}.{key}") }
}
