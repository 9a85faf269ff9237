//! The tensors of a policy, by name.

use magex_core::config::RunConfig;
use magex_core::sha256;
use magex_nets::executor::Model;
use magex_nets::params::{ParamError, Params};
use std::collections::BTreeMap;

/// Shape and values of the tensors of what acts.
#[derive(Debug, Clone, Default)]
pub struct Tensors {
    /// Name of the network, and a dot.
    prefix: String,
    /// By name without the prefix.
    by_name: BTreeMap<String, (Vec<usize>, Vec<f32>)>,
}

impl Tensors {
    /// Those of a weights file that the policy of a configuration reads.
    ///
    /// # Errors
    /// The weights do not fit the configuration.
    pub fn load(config: &RunConfig, weights: &[u8]) -> Result<Self, ParamError> {
        let model = Model::new(config)?;
        let mut all = Self::default();
        for (part, layout) in model.parts().iter().zip(model.layouts()?) {
            if part.policy {
                let params = Params::load(layout, weights, part.name)?;
                all.prefix = format!("{}.", part.name);
                // MAT has its value function in the same network; what acts does not read it.
                for entry in params
                    .entries
                    .iter()
                    .filter(|entry| part.name != "transformer" || !entry.name.starts_with("value."))
                {
                    let values = params.values[entry.range()].to_vec();
                    all.by_name.insert(entry.name.clone(), (entry.shape.clone(), values));
                }
            }
        }
        Ok(all)
    }

    /// Whole name, shape and values; empty if there is none of this name.
    pub fn get(&self, name: &str) -> (String, &[usize], &[f32]) {
        let name = (format!("{}{name}", self.prefix), self.by_name.get(name));
        match name {
            (name, Some((shape, values))) => (name, shape, values),
            (name, None) => (name, &[], &[]),
        }
    }

    /// Whether there is one of this name.
    pub fn has(&self, name: &str) -> bool {
        self.by_name.contains_key(name)
    }

    /// Whole names, shapes and values, by name.
    pub fn all(&self) -> impl Iterator<Item = (String, &[usize], &[f32])> {
        self.by_name.keys().map(|name| self.get(name))
    }

    /// SHA-256 of the little-endian bytes of all tensors, ordered by name: the identity of a policy in any format.
    pub fn sha256(&self) -> String {
        let bytes: Vec<u8> =
            self.by_name.values().flat_map(|(_, values)| values.iter().flat_map(|x| x.to_le_bytes())).collect();
        sha256::hex(&bytes)
    }
}
