//! Parameters: one flat, ordered vector of numbers with names and shapes. The order is the order of construction, so a
//! norm or a hash over it is always summed the same way (candle's own `VarMap` is a hash map).

use candle_core::{Device, Result as CandleResult, Tensor, Var};
use magex_core::rng::Stream;
use sha2::{Digest, Sha256};
use std::collections::HashMap;

/// Why parameters could not be built, written or read.
#[derive(Debug, thiserror::Error)]
pub enum ParamError {
    /// A tensor of the file is missing or has another shape.
    #[error("weights: {0}")]
    Mismatch(String),
    /// The bytes are not a safetensors file.
    #[error("weights: not a safetensors file: {0}")]
    Format(#[from] safetensors::SafeTensorError),
    /// The tensor library refused.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}

/// How a tensor starts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Start {
    /// Orthogonal rows or columns times a gain.
    Orthogonal(f64),
    /// One number.
    Constant(f32),
}

/// Name, shape and place of one tensor.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Entry {
    /// Dotted name, unique within the network.
    pub name: String,
    /// Dimensions.
    pub shape: Vec<usize>,
    /// First index in [`Params::numbers`].
    pub start: usize,
}

impl Entry {
    /// Count of numbers.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Whether the tensor has no numbers.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// All parameters of one network.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Params {
    /// Tensors in order of construction.
    pub entries: Vec<Entry>,
    /// Their numbers, one tensor after the other.
    pub numbers: Vec<f32>,
}

/// Where a network takes its tensors from while it is being built.
pub enum Source<'a> {
    /// Draws new parameters and remembers them.
    New {
        /// Keyed stream of the initial weights.
        stream: Box<Stream>,
        /// What has been drawn.
        params: Params,
    },
    /// Takes existing tensors in the same order.
    Existing {
        /// Names and shapes to check against.
        params: &'a Params,
        /// One tensor per entry.
        tensors: Vec<Tensor>,
        /// Entries taken.
        taken: usize,
    },
}

impl Source<'_> {
    /// A source that draws.
    pub fn new(stream: Stream) -> Self {
        Self::New { stream: Box::new(stream), params: Params::default() }
    }

    /// The next tensor: drawn, or taken and checked against name and shape.
    pub fn get(&mut self, name: &str, shape: &[usize], start: Start) -> Result<Tensor, ParamError> {
        match self {
            Self::New { stream, params } => {
                let values = match start {
                    Start::Constant(value) => vec![value; shape.iter().product()],
                    Start::Orthogonal(gain) => orthogonal(shape, gain, stream),
                };
                let entry = Entry { name: name.to_owned(), shape: shape.to_vec(), start: params.numbers.len() };
                params.numbers.extend_from_slice(&values);
                params.entries.push(entry);
                Ok(Tensor::from_vec(values, shape, &Device::Cpu)?)
            }
            Self::Existing { params, tensors, taken } => {
                let entry = params.entries.get(*taken);
                match (entry, tensors.get(*taken)) {
                    (Some(entry), Some(tensor)) if entry.name == name && entry.shape == shape => {
                        *taken += 1;
                        Ok(tensor.clone())
                    }
                    (Some(entry), _) => Err(ParamError::Mismatch(format!(
                        "the network wants {name} {shape:?} where the file has {} {:?}; was it trained with another [executor] or [commander]?",
                        entry.name, entry.shape
                    ))),
                    (None, _) => Err(ParamError::Mismatch(format!("{name} {shape:?} is missing"))),
                }
            }
        }
    }
}

impl Params {
    /// Plain tensors: a forward pass on them records no graph.
    pub fn plain(&self) -> CandleResult<Vec<Tensor>> {
        self.entries
            .iter()
            .map(|e| Tensor::from_slice(&self.numbers[e.start..e.start + e.len()], e.shape.as_slice(), &Device::Cpu))
            .collect()
    }

    /// Variables: a forward pass on them can be differentiated. They own a copy of the numbers.
    pub fn variables(&self) -> CandleResult<Vec<Var>> {
        self.plain()?.iter().map(Var::from_tensor).collect()
    }

    /// A source that hands out the given tensors under this layout.
    pub fn source(&self, tensors: Vec<Tensor>) -> Source<'_> {
        Source::Existing { params: self, tensors, taken: 0 }
    }

    /// SHA-256 over names, shapes and bits, in order.
    pub fn sha256(&self) -> String {
        let mut hash = Sha256::new();
        for entry in &self.entries {
            hash.update(entry.name.as_bytes());
            for dim in &entry.shape {
                hash.update((*dim as u64).to_le_bytes());
            }
        }
        for number in &self.numbers {
            hash.update(number.to_le_bytes());
        }
        hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
    }
}

/// Several named networks in one safetensors file (`actor.…`, `critic.…`, `commander.…`), with a note (JSON) as metadata.
/// The bytes are a function of the content.
pub fn to_safetensors(networks: &[(&str, &Params)], note: &str) -> Result<Vec<u8>, ParamError> {
    let mut tensors = Vec::new();
    for (prefix, params) in networks {
        for entry in &params.entries {
            let numbers = &params.numbers[entry.start..entry.start + entry.len()];
            let bytes: Vec<u8> = numbers.iter().flat_map(|x| x.to_le_bytes()).collect();
            tensors.push((format!("{prefix}.{}", entry.name), entry.shape.clone(), bytes));
        }
    }
    let views: Result<Vec<_>, _> = tensors
        .iter()
        .map(|(name, shape, bytes)| {
            safetensors::tensor::TensorView::new(safetensors::Dtype::F32, shape.clone(), bytes).map(|v| (name, v))
        })
        .collect();
    // safetensors keeps metadata in a hash map; one entry has only one order.
    Ok(safetensors::serialize(views?, Some(HashMap::from([("magex".to_owned(), note.to_owned())])))?)
}

/// The note of a safetensors file written by [`to_safetensors`].
pub fn note(bytes: &[u8]) -> Result<String, ParamError> {
    let (_, header) = safetensors::SafeTensors::read_metadata(bytes)?;
    header
        .metadata()
        .as_ref()
        .and_then(|m| m.get("magex").cloned())
        .ok_or_else(|| ParamError::Mismatch("the file has no `magex` metadata".to_owned()))
}

/// Fills `params` (its layout is kept) with the numbers of one network of a safetensors file.
pub fn from_safetensors(bytes: &[u8], prefix: &str, params: &mut Params) -> Result<(), ParamError> {
    let file = safetensors::SafeTensors::deserialize(bytes)?;
    let mut numbers = Vec::with_capacity(params.numbers.len());
    for entry in &params.entries {
        let name = format!("{prefix}.{}", entry.name);
        let view = file.tensor(&name).map_err(|_| ParamError::Mismatch(format!("{name} is missing")))?;
        if view.dtype() != safetensors::Dtype::F32 || view.shape() != entry.shape {
            return Err(ParamError::Mismatch(format!(
                "{name} is {:?} {:?}, expected F32 {:?}; was it trained with another configuration or team size?",
                view.dtype(),
                view.shape(),
                entry.shape
            )));
        }
        for chunk in view.data().chunks_exact(4) {
            let number = f32::from_le_bytes([chunk[0], chunk[1], chunk[2], chunk[3]]);
            if !number.is_finite() {
                return Err(ParamError::Mismatch(format!("{name} contains {number}")));
            }
            numbers.push(number);
        }
    }
    params.numbers = numbers;
    Ok(())
}

/// Orthogonal matrix [rows, columns] times a gain: Gram–Schmidt on Gaussian vectors, in double precision.
fn orthogonal(shape: &[usize], gain: f64, stream: &mut Stream) -> Vec<f32> {
    let columns = shape.last().copied().unwrap_or(1);
    let rows = shape.iter().product::<usize>() / columns.max(1);
    let (count, length) = (rows.min(columns), rows.max(columns));
    let mut basis: Vec<Vec<f64>> = Vec::with_capacity(count);
    while basis.len() < count {
        let mut v: Vec<f64> = (0..length).map(|_| stream.normal()).collect();
        for _ in 0..2 {
            for b in &basis {
                let dot: f64 = b.iter().zip(&v).map(|(x, y)| x * y).sum();
                v.iter_mut().zip(b).for_each(|(x, y)| *x -= dot * y);
            }
        }
        let norm = v.iter().map(|x| x * x).sum::<f64>().sqrt();
        if norm > 1e-6 {
            v.iter_mut().for_each(|x| *x /= norm);
            basis.push(v);
        }
    }
    let mut out = Vec::with_capacity(rows * columns);
    for i in 0..rows {
        for j in 0..columns {
            let value = if rows <= columns { basis[i][j] } else { basis[j][i] };
            out.push((gain * value) as f32);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use magex_core::rng::{Key, Purpose};

    fn drawn() -> Params {
        let mut source = Source::new(Key::new(1, Purpose::Init, &[0]).stream());
        source.get("a", &[4, 8], Start::Orthogonal(2.0)).unwrap();
        source.get("b", &[8], Start::Constant(0.5)).unwrap();
        match source {
            Source::New { params, .. } => params,
            Source::Existing { .. } => unreachable!(),
        }
    }

    #[test]
    fn orthogonal_rows_have_the_gain_as_length_and_are_perpendicular() {
        let params = drawn();
        for i in 0..4 {
            for j in 0..4 {
                let dot: f32 = (0..8).map(|k| params.numbers[i * 8 + k] * params.numbers[j * 8 + k]).sum();
                assert!((dot - if i == j { 4.0 } else { 0.0 }).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn a_file_round_trips_and_is_the_same_bytes_each_time() {
        let params = drawn();
        let bytes = to_safetensors(&[("actor", &params)], "{}").unwrap();
        assert_eq!(bytes, to_safetensors(&[("actor", &params)], "{}").unwrap());
        assert_eq!(note(&bytes).unwrap(), "{}");
        let mut back = params.clone();
        back.numbers.fill(0.0);
        from_safetensors(&bytes, "actor", &mut back).unwrap();
        assert_eq!(back, params);
        assert_eq!(back.sha256(), params.sha256());
    }

    #[test]
    fn another_layout_is_refused_by_name() {
        let params = drawn();
        let bytes = to_safetensors(&[("actor", &params)], "").unwrap();
        let mut other = params.clone();
        other.entries[0].shape = vec![8, 4];
        assert!(from_safetensors(&bytes, "actor", &mut other).unwrap_err().to_string().contains("actor.a"));
        assert!(from_safetensors(&bytes[..40], "actor", &mut params.clone()).is_err());
    }
}
