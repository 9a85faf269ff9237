//! Reading a table of a TOML file into a struct, with errors that name the full dotted key, what is written there and what to
//! write.

use crate::error::FieldError;
use serde::de::DeserializeOwned;
use toml::{Table, Value};

/// The largest whole number up to which every one is a double.
const EXACT: f64 = (1_i64 << 53) as f64;

/// Reads a table whose keys may all be missing. `section` is its dotted name, empty for the file itself; `bounds` knows the
/// ranges of its keys, in words. A whole number may be written as a decimal one: `1e6`, `5000.0`.
pub(crate) fn read<T: DeserializeOwned>(
    section: &str,
    table: Table,
    bounds: impl Fn(&str) -> Option<String>,
) -> Result<T, FieldError> {
    let table = Table::from_iter(table.into_iter().map(|(key, value)| (key, whole(value))));
    let keys = table.clone();
    T::deserialize(Value::Table(table)).map_err(|error| {
        // The key that is refused by itself is the one at fault.
        let faulty = keys.into_iter().find_map(|(key, value)| {
            let alone = Table::from_iter([(key.clone(), value.clone())]);
            T::deserialize(Value::Table(alone)).err().map(|error| (key, value, error))
        });
        match faulty {
            Some((key, value, error)) => {
                let problem = explain(&value, error.message().trim(), bounds(&key));
                FieldError::new(dotted(section, &key), problem)
            }
            None => FieldError::new(section, error.message().trim()),
        }
    })
}

/// A decimal number without decimals is a whole one; every key takes that, if it is in range.
fn whole(value: Value) -> Value {
    match value {
        Value::Float(number) if number.fract() == 0.0 && number.abs() <= EXACT => Value::Integer(number as i64),
        other => other,
    }
}

/// What is wrong with a value, in place of the deserializer's words.
fn explain(value: &Value, message: &str, bounds: Option<String>) -> String {
    let choices = |text: &str| text.replace('`', "");
    if message.starts_with("unknown field") {
        let known = message.split_once("expected ").map_or("", |(_, known)| known.trim_start_matches("one of "));
        return format!("unknown key; use {}", choices(known));
    }
    // Our own types refuse in our own words.
    let Some((_, expected)) = message.rsplit_once("expected ") else { return message.to_owned() };
    if message.starts_with("unknown variant") {
        return format!("{value} is unknown; use {}", choices(expected.trim_start_matches("one of ")));
    }
    let range = bounds.map(|range| format!(" from {range}")).unwrap_or_default();
    let wanted = match expected {
        "u8" | "u32" | "u64" | "usize" => format!("a whole number{range}"),
        "f32" | "f64" => format!("a number{range}"),
        "a boolean" => "true or false".to_owned(),
        "a map" => return format!("{value} is not a section; write [section] with its keys below"),
        _ => "a text in quotes".to_owned(),
    };
    match value {
        Value::Integer(_) if wanted.starts_with("a whole") => format!("{value} is out of range; write {wanted}"),
        Value::Float(_) if wanted.starts_with("a whole") => format!("{value} is not a whole number; write {wanted}"),
        Value::String(_) => format!("{value} is a text; write {wanted}, without quotes"),
        Value::Array(_) => format!("a list is not possible here; write {wanted}"),
        Value::Table(_) => format!("a section is not possible here; write {wanted}"),
        _ => format!("{value} is not possible here; write {wanted}"),
    }
}

pub(crate) fn dotted(section: &str, key: &str) -> String {
    if section.is_empty() { key.to_owned() } else { format!("{section}.{key}") }
}
