//! Parameters: one flat, ordered vector of values with names and shapes. The order is the order of construction, so a
//! norm or a hash over it is always summed the same way. candle's `VarMap` is a hash map and draws from a global generator.

use crate::ops::with_values;
use candle_core::backprop::GradStore;
use candle_core::{DType, Device, Result as CandleResult, Tensor, Var};
use magex_core::rng::Stream;
use std::collections::HashMap;
use std::ops::Range;

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

/// Initial distribution of a tensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Init {
    /// Orthogonal rows or columns times a gain.
    Orthogonal(f64),
    /// One value.
    Constant(f32),
    /// Uniform within plus and minus a bound.
    Uniform(f64),
}

/// Name, shape and place of one tensor.
#[derive(Debug, Clone, PartialEq)]
pub struct Entry {
    /// Dotted name, unique within the network.
    pub name: String,
    /// Dimensions.
    pub shape: Vec<usize>,
    /// How it is initialised.
    pub init: Init,
    /// First index in [`Params::values`].
    pub start: usize,
    /// Entries of the same number stand side by side in one tensor, flat if they are several: the operation that reads them gives
    /// one gradient for all.
    pub group: usize,
}

impl Entry {
    /// Its place in [`Params::values`].
    pub fn range(&self) -> Range<usize> {
        self.start..self.start + self.shape.iter().product::<usize>()
    }
}

/// All parameters of one network.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Params {
    /// Tensors in order of construction.
    pub entries: Vec<Entry>,
    /// Their values, one tensor after the other.
    pub values: Vec<f32>,
}

/// Hands a network its tensors while it is being built, and records their names, shapes and initial distributions.
#[derive(Debug, Default)]
pub struct ParamBuilder {
    entries: Vec<Entry>,
    count: usize,
    groups: usize,
    given: Option<Vec<Tensor>>,
}

impl ParamBuilder {
    /// Hands out zeros: what is built shows the layout, without drawing or reading a value.
    pub fn layout() -> Self {
        Self::default()
    }

    /// Hands out the given tensors in the order of construction.
    pub fn with(tensors: Vec<Tensor>) -> Self {
        Self { given: Some(tensors), ..Self::default() }
    }

    /// The next tensor.
    pub fn tensor(&mut self, name: &str, shape: &[usize], init: Init) -> Result<Tensor, ParamError> {
        self.entry(name.to_owned(), shape, init);
        self.hand_out(name, shape)
    }

    /// The next tensors as one flat tensor, in this order.
    pub(crate) fn group(&mut self, members: Vec<(String, Vec<usize>, Init)>) -> Result<Tensor, ParamError> {
        let (first, start) = (members.first().map(|(name, ..)| name.clone()).unwrap_or_default(), self.count);
        for (name, shape, init) in members {
            self.entry(name, &shape, init);
        }
        self.hand_out(&first, &[self.count - start])
    }

    fn entry(&mut self, name: String, shape: &[usize], init: Init) {
        let entry = Entry { name, shape: shape.to_vec(), init, start: self.count, group: self.groups };
        self.count = entry.range().end;
        self.entries.push(entry);
    }

    fn hand_out(&mut self, name: &str, shape: &[usize]) -> Result<Tensor, ParamError> {
        let tensor = match &self.given {
            None => Tensor::zeros(shape, DType::F32, &Device::Cpu)?,
            Some(given) => match given.get(self.groups) {
                Some(tensor) if tensor.dims() == shape => tensor.clone(),
                other => {
                    let found = other.map(Tensor::dims);
                    return Err(ParamError::Mismatch(format!(
                        "the network wants {name} {shape:?}, there is {found:?}"
                    )));
                }
            },
        };
        self.groups += 1;
        Ok(tensor)
    }

    /// What was asked for, in order.
    pub fn entries(self) -> Vec<Entry> {
        self.entries
    }
}

impl Params {
    /// Initial values, drawn in the order of the entries.
    pub fn init(entries: Vec<Entry>, mut stream: Stream) -> Self {
        let mut values = Vec::new();
        for entry in &entries {
            match entry.init {
                Init::Constant(value) => values.resize(entry.range().end, value),
                Init::Uniform(bound) => {
                    let count = entry.range().len();
                    values.extend((0..count).map(|_| stream.range(-bound, bound) as f32));
                }
                Init::Orthogonal(gain) => values.extend(orthogonal(&entry.shape, gain, &mut stream)),
            }
        }
        Self { entries, values }
    }

    /// The values of one network of a safetensors file written by [`to_safetensors`].
    pub fn load(entries: Vec<Entry>, bytes: &[u8], network: &str) -> Result<Self, ParamError> {
        let file = safetensors::SafeTensors::deserialize(bytes)?;
        let mut values = Vec::new();
        for entry in &entries {
            let name = format!("{network}.{}", entry.name);
            let view = file.tensor(&name).map_err(|_| missing(&file, network, &name))?;
            if view.dtype() != safetensors::Dtype::F32 || view.shape() != entry.shape {
                return Err(misfit(&name, &view, &entry.shape));
            }
            for chunk in view.data().chunks_exact(4) {
                let value = f32::from_le_bytes([chunk[0], chunk[1], chunk[2], chunk[3]]);
                if !value.is_finite() {
                    return Err(ParamError::Mismatch(format!("{name} contains {value}")));
                }
                values.push(value);
            }
        }
        Ok(Self { entries, values })
    }

    /// Constant tensors, one for each group: a forward pass on them records no graph.
    pub fn tensors(&self) -> CandleResult<Vec<Tensor>> {
        let tensor = |group: &[Entry]| match group {
            [e] => Tensor::from_slice(&self.values[e.range()], e.shape.as_slice(), &Device::Cpu),
            _ => {
                let range = group.first().map_or(0, |e| e.start)..group.last().map_or(0, |e| e.range().end);
                Tensor::from_slice(&self.values[range.clone()], range.len(), &Device::Cpu)
            }
        };
        self.entries.chunk_by(|a, b| a.group == b.group).map(tensor).collect()
    }

    /// Variables, one for each group: a forward pass on them can be differentiated, by several threads at once. They own a copy of the
    /// values.
    pub fn variables(&self) -> CandleResult<Vec<Var>> {
        self.tensors()?.iter().map(Var::from_tensor).collect()
    }

    /// The gradient as flat as the values; zero where a variable does not reach the loss, empty without variables.
    pub fn gradient(&self, variables: &[Var], gradients: &GradStore) -> CandleResult<Vec<f32>> {
        let mut flat = Vec::with_capacity(if variables.is_empty() { 0 } else { self.values.len() });
        for variable in variables {
            match gradients.get(variable) {
                Some(gradient) => with_values(&gradient.contiguous()?, |values| flat.extend_from_slice(values))?,
                None => flat.resize(flat.len() + variable.elem_count(), 0.0),
            }
        }
        Ok(flat)
    }
}

/// Several named networks in one safetensors file (`actor.…`, `critic.…`, `commander.…`), with a note (JSON) as metadata.
/// The bytes are a function of the content.
pub fn to_safetensors(networks: &[(&str, &Params)], note: &str) -> Result<Vec<u8>, ParamError> {
    let mut tensors = Vec::new();
    for (prefix, params) in networks {
        for entry in &params.entries {
            let bytes: Vec<u8> = params.values[entry.range()].iter().flat_map(|x| x.to_le_bytes()).collect();
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

/// Why a tensor cannot be used, with the remedy.
fn misfit(name: &str, view: &safetensors::tensor::TensorView<'_>, wanted: &[usize]) -> ParamError {
    let (dtype, shape) = (view.dtype(), view.shape());
    let reversed: Vec<usize> = shape.iter().rev().copied().collect();
    let problem = if dtype != safetensors::Dtype::F32 {
        format!(
            "{name} is {dtype:?} {shape:?}, expected F32 {wanted:?}; convert every tensor to F32 (single precision)"
        )
    } else if shape.len() == 2 && reversed == wanted {
        format!(
            "{name} is F32 {shape:?}, expected F32 {wanted:?}: it is transposed; weights are stored [inputs, outputs], \
             PyTorch's Linear has them the other way round"
        )
    } else {
        format!(
            "{name} is F32 {shape:?}, expected F32 {wanted:?}; was it trained with another configuration or team size?"
        )
    };
    ParamError::Mismatch(problem)
}

/// Why a tensor is not there, with the remedy.
fn missing(file: &safetensors::SafeTensors<'_>, network: &str, name: &str) -> ParamError {
    let whole = network == "commander" && !file.names().iter().any(|name| name.starts_with("commander."));
    ParamError::Mismatch(match whole {
        true => format!(
            "{name} is missing: the file holds no goal scheduler, only what acts; add --scheduler exact (or makespan, greedy), or \
             set commander.kind = \"exact\" in its configuration"
        ),
        false => format!("{name} is missing"),
    })
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
    let value = |i: usize, j: usize| if rows <= columns { basis[i][j] } else { basis[j][i] };
    (0..rows * columns).map(|k| (gain * value(k / columns, k % columns)) as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use magex_core::rng::{Key, Purpose};

    fn layout() -> Vec<Entry> {
        let mut builder = ParamBuilder::layout();
        builder.tensor("a", &[4, 8], Init::Orthogonal(2.0)).unwrap();
        builder.tensor("b", &[8], Init::Constant(0.5)).unwrap();
        builder.entries()
    }

    fn drawn() -> Params {
        Params::init(layout(), Key::new(1, Purpose::Init, &[0]).stream())
    }

    #[test]
    fn orthogonal_rows_have_the_gain_as_length_and_are_perpendicular() {
        let params = drawn();
        for i in 0..4 {
            for j in 0..4 {
                let dot: f32 = (0..8).map(|k| params.values[i * 8 + k] * params.values[j * 8 + k]).sum();
                assert!((dot - if i == j { 4.0 } else { 0.0 }).abs() < 1e-5);
            }
        }
        assert_eq!(params.values[32..], [0.5; 8]);
    }

    #[test]
    fn a_file_round_trips_and_is_the_same_bytes_each_time() {
        let params = drawn();
        let bytes = to_safetensors(&[("actor", &params)], "{}").unwrap();
        assert_eq!(bytes, to_safetensors(&[("actor", &params)], "{}").unwrap());
        assert_eq!(Params::load(layout(), &bytes, "actor").unwrap(), params);
    }

    #[test]
    fn another_layout_is_rejected_by_name() {
        let bytes = to_safetensors(&[("actor", &drawn())], "").unwrap();
        let mut other = layout();
        other[0].shape = vec![8, 4];
        assert!(Params::load(other, &bytes, "actor").unwrap_err().to_string().contains("actor.a"));
        assert!(Params::load(layout(), &bytes, "critic").unwrap_err().to_string().contains("critic.a is missing"));
        assert!(Params::load(layout(), &bytes[..40], "actor").is_err());
        let mut builder = ParamBuilder::with(drawn().tensors().unwrap());
        assert!(builder.tensor("a", &[8, 4], Init::Constant(0.0)).is_err());
    }
}
