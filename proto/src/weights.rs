//! One version of a run's weights, whole and verified.

use crate::parts::{Assembler, split};
use crate::v1::WatchWeightsResponse;
use bytes::Bytes;
use magex_core::error::FieldError;
use magex_core::ids::{RunId, WeightsVersion};

/// SHA-256 as lower-case hex.
pub use magex_core::sha256::hex as sha256_hex;

/// Maximum size of weights that a subscriber accepts, bytes.
pub const MAX_WEIGHTS_BYTES: usize = 1 << 30;

/// One version of the weights of executor and commander; immutable.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Weights {
    /// Run of the weights.
    pub run_id: RunId,
    /// Their version.
    pub version: WeightsVersion,
    /// SHA-256 of the bytes, lower-case hex.
    pub sha256: String,
    /// safetensors.
    pub bytes: Bytes,
}

impl Weights {
    /// Names the bytes and computes their hash.
    pub fn new(run_id: RunId, version: WeightsVersion, bytes: Bytes) -> Self {
        Self { run_id, version, sha256: sha256_hex(&bytes), bytes }
    }

    /// The messages of a weights stream that carry this version.
    pub fn messages(&self, run_config_toml: &str) -> impl ExactSizeIterator<Item = WatchWeightsResponse> {
        split(self.bytes.clone()).map(|part| WatchWeightsResponse {
            run_id: self.run_id.0.clone(),
            version: self.version.0,
            sha256: self.sha256.clone(),
            run_config_toml: if part.index == 0 { run_config_toml.to_owned() } else { String::new() },
            part: Some(part),
        })
    }
}

/// Joins the messages of a weights stream and verifies the hash before it returns weights.
#[derive(Debug)]
pub struct WeightsAssembler {
    parts: Assembler,
    run_config_toml: String,
}

impl Default for WeightsAssembler {
    fn default() -> Self {
        Self { parts: Assembler::new(MAX_WEIGHTS_BYTES), run_config_toml: String::new() }
    }
}

impl WeightsAssembler {
    /// Adds the next message; the last one of a version returns the weights and the run's configuration (TOML).
    pub fn push(&mut self, message: WatchWeightsResponse) -> Result<Option<(Weights, String)>, FieldError> {
        let part = message.part.ok_or_else(|| FieldError::missing("part"))?;
        if part.index == 0 {
            self.run_config_toml = message.run_config_toml;
        }
        let pushed = self.parts.push(part).map_err(|error| FieldError::new("part", error.to_string()))?;
        let Some(bytes) = pushed else { return Ok(None) };
        let weights = Weights::new(RunId(message.run_id), WeightsVersion(message.version), bytes);
        if weights.sha256 != message.sha256 {
            let problem = format!("weights of version {} hash to {}", weights.version, weights.sha256);
            return Err(FieldError::new("sha256", format!("{} is claimed, the {problem}", message.sha256)));
        }
        Ok(Some((weights, std::mem::take(&mut self.run_config_toml))))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::PART_BYTES;

    #[test]
    fn weights_round_trip_and_damage_is_refused() {
        let bytes = Bytes::from(vec![7u8; PART_BYTES + 10]);
        let weights = Weights::new(RunId("r".into()), WeightsVersion(3), bytes);
        let mut assembler = WeightsAssembler::default();
        let mut got = None;
        for message in weights.messages("name = 'x'") {
            got = assembler.push(message).unwrap();
        }
        assert_eq!(got, Some((weights.clone(), "name = 'x'".to_owned())));

        let mut wrong = weights.clone();
        wrong.sha256 = sha256_hex(b"something else");
        let error = wrong.messages("").map(|m| assembler.push(m)).find_map(Result::err).unwrap().to_string();
        assert!(error.contains("sha256") && error.contains(&weights.sha256), "{error}");
    }
}
