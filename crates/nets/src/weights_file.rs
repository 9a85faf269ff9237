//! Weights files as a whole: what they say about themselves, and whether a configuration fits them.

use crate::commander::Commander;
use crate::executor::Model;
use crate::params::{Entry, ParamError, Params, to_safetensors};
use magex_core::about::{self, About};
use magex_core::config::RunConfig;
use magex_core::sha256;
use std::collections::BTreeSet;

/// The key of the metadata.
const KEY: &str = "magex";

/// Networks as a weights file that says what it is.
///
/// # Errors
/// Two networks have one name.
pub fn write(networks: &[(&str, &Params)], about: &About) -> Result<Vec<u8>, ParamError> {
    let bare = to_safetensors(networks, "")?;
    let tensors = tensors_sha256(&bare)?;
    to_safetensors(networks, &About { tensors, ..about.clone() }.to_json())
}

/// SHA-256 of all bytes behind the header.
fn tensors_sha256(bytes: &[u8]) -> Result<String, ParamError> {
    let (header, _) = safetensors::SafeTensors::read_metadata(bytes)?;
    Ok(sha256::hex(&bytes[(8 + header).min(bytes.len())..]))
}

/// The metadata of a weights file, JSON; `None` without any.
///
/// # Errors
/// It is no safetensors file, or not whole.
pub fn metadata(bytes: &[u8]) -> Result<Option<String>, ParamError> {
    let (_, header) = safetensors::SafeTensors::read_metadata(bytes).map_err(|error| damaged(bytes, error))?;
    Ok(header.metadata().as_ref().and_then(|map| map.get(KEY).cloned()))
}

/// Says in words that a file ends early; other faults as the library names them.
fn damaged(bytes: &[u8], error: safetensors::SafeTensorError) -> ParamError {
    use safetensors::SafeTensorError::{HeaderTooSmall, InvalidHeaderLength, MetadataIncompleteBuffer};
    match error {
        HeaderTooSmall | InvalidHeaderLength | MetadataIncompleteBuffer => {
            let length = bytes.len();
            ParamError::Mismatch(format!(
                "the file is truncated, or no safetensors file: its header promises other than the {length} bytes that are \
                 there; copy it again"
            ))
        }
        other => other.into(),
    }
}

/// Whether a weights file belongs to a configuration. Returns warnings.
///
/// # Errors
/// It is of another format, task, executor or team size, or not whole; the message names what differs and the remedy.
pub fn check(bytes: &[u8], config: &RunConfig) -> Result<Vec<String>, ParamError> {
    let found = metadata(bytes)?;
    let mut warnings = about::check(found.as_deref(), config).map_err(ParamError::Mismatch)?;
    let promised = found.as_deref().and_then(about::tensors);
    if let Some(promised) = promised.filter(|promised| *promised != tensors_sha256(bytes).unwrap_or_default()) {
        let promised = promised.get(..12).unwrap_or(&promised);
        warnings.push(format!(
            "the tensors are not those that were written (SHA-256 {promised}… in the metadata): the file was changed since"
        ));
    }
    let file = safetensors::SafeTensors::deserialize(bytes)?;
    let known = known(config)?;
    let extra: BTreeSet<&str> = file.names().into_iter().filter(|name| !known.contains(*name)).collect();
    if !extra.is_empty() {
        let names: Vec<&str> = extra.iter().take(3).copied().collect();
        let more = if extra.len() > 3 { format!(" and {} more", extra.len() - 3) } else { String::new() };
        warnings.push(format!("tensors that this executor does not read: {}{more}", names.join(", ")));
    }
    Ok(warnings)
}

/// Names of all tensors that a run's weights can have.
fn known(config: &RunConfig) -> Result<BTreeSet<String>, ParamError> {
    let model = Model::new(config)?;
    let mut known = BTreeSet::new();
    let mut add = |network: &str, entries: &[Entry]| {
        known.extend(entries.iter().map(|entry| format!("{network}.{}", entry.name)));
    };
    for (part, entries) in model.parts().iter().zip(model.layouts()?) {
        add(part.name, &entries);
    }
    if config.commander.kind.learned() {
        add("commander", &Commander::layout(&config.commander, config.task.agents, config.task.dims())?);
    }
    Ok(known)
}
