//! Arrays on the wire: little-endian bytes with a type and a shape.

use crate::v1::{Array, DataType};
use bytes::Bytes;
use magex_core::error::FieldError;

/// An f32 array of the given shape.
pub fn from_f32(shape: &[usize], values: &[f32]) -> Array {
    array(DataType::F32, shape, bytes(values, f32::to_le_bytes))
}

/// An f64 array of the given shape.
pub fn from_f64(shape: &[usize], values: &[f64]) -> Array {
    array(DataType::F64, shape, values.iter().flat_map(|value| value.to_le_bytes()).collect())
}

/// A u32 array of the given shape.
pub fn from_u32(shape: &[usize], values: &[u32]) -> Array {
    array(DataType::U32, shape, bytes(values, u32::to_le_bytes))
}

/// A u8 array of the given shape.
pub fn from_u8(shape: &[usize], values: &[u8]) -> Array {
    array(DataType::U8, shape, values.to_vec())
}

/// The numbers of an f32 array that must have exactly this shape.
pub fn to_f32(field: &str, array: Option<Array>, shape: &[usize]) -> Result<Vec<f32>, FieldError> {
    let data = checked(field, array, DataType::F32, shape, 4)?;
    Ok(data.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect())
}

/// The numbers of an f64 array, or of an f32 array, that must have exactly this shape.
pub fn to_f64(field: &str, array: Option<Array>, shape: &[usize]) -> Result<Vec<f64>, FieldError> {
    if array.as_ref().is_some_and(|array| array.r#type() == DataType::F32) {
        return Ok(to_f32(field, array, shape)?.into_iter().map(f64::from).collect());
    }
    let data = checked(field, array, DataType::F64, shape, 8)?;
    Ok(data.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect())
}

/// The numbers of a u32 array that must have exactly this shape.
pub fn to_u32(field: &str, array: Option<Array>, shape: &[usize]) -> Result<Vec<u32>, FieldError> {
    let data = checked(field, array, DataType::U32, shape, 4)?;
    Ok(data.as_chunks().0.iter().map(|bytes| u32::from_le_bytes(*bytes)).collect())
}

/// The numbers of a u8 array that must have exactly this shape.
pub fn to_u8(field: &str, array: Option<Array>, shape: &[usize]) -> Result<Vec<u8>, FieldError> {
    checked(field, array, DataType::U8, shape, 1).map(|data| data.to_vec())
}

/// Numbers that must be finite; the error names the first one that is not.
pub fn finite(field: &str, values: Vec<f32>) -> Result<Vec<f32>, FieldError> {
    match values.iter().position(|value| !value.is_finite()) {
        Some(place) => Err(FieldError::new(format!("{field}[{place}]"), format!("{} is not finite", values[place]))),
        None => Ok(values),
    }
}

/// The shape of an array, which must have at most `axes` axes.
pub fn shape_up_to(field: &str, array: Option<&Array>, axes: usize) -> Result<Vec<usize>, FieldError> {
    let array = array.ok_or_else(|| FieldError::missing(field))?;
    let found = array.shape.len();
    FieldError::ensure(found <= axes, || (field, format!("a shape of {found} axes, at most {axes} are known")))?;
    Ok(array.shape.iter().map(|&extent| extent as usize).collect())
}

/// The shape of an array, which must have exactly `axes` axes.
pub fn shape_of(field: &str, array: Option<&Array>, axes: usize) -> Result<Vec<usize>, FieldError> {
    let array = array.ok_or_else(|| FieldError::missing(field))?;
    let found = array.shape.len();
    FieldError::ensure(found == axes, || (field, format!("its shape has {found} axes, not {axes}")))?;
    shape_up_to(field, Some(array), axes)
}

fn bytes<T: Copy>(values: &[T], encode: impl Fn(T) -> [u8; 4]) -> Vec<u8> {
    let mut data = vec![0u8; values.len() * 4];
    for (slot, value) in data.as_chunks_mut().0.iter_mut().zip(values) {
        *slot = encode(*value);
    }
    data
}

fn array(kind: DataType, shape: &[usize], data: Vec<u8>) -> Array {
    Array { r#type: kind.into(), shape: shape.iter().map(|&extent| extent as u32).collect(), data: data.into() }
}

/// Type, shape and length agree with what is expected. Nothing is multiplied before it is known to be expected.
fn checked(
    field: &str,
    array: Option<Array>,
    kind: DataType,
    shape: &[usize],
    size: usize,
) -> Result<Bytes, FieldError> {
    let array = array.ok_or_else(|| FieldError::missing(field))?;
    let found = array.r#type();
    FieldError::ensure(found == kind, || {
        (field, format!("type {} where {} is expected", found.as_str_name(), kind.as_str_name()))
    })?;
    if !array.shape.iter().map(|&extent| extent as usize).eq(shape.iter().copied()) {
        // A shape of a million axes is not repeated to its sender.
        let found = match array.shape.len() {
            0..=8 => format!("shape {:?}", array.shape),
            axes => format!("a shape of {axes} axes"),
        };
        return Err(FieldError::new(field, format!("{found} where {shape:?} is expected")));
    }
    let expected = shape.iter().try_fold(size, |product, &extent| product.checked_mul(extent));
    let found = array.data.len();
    FieldError::ensure(expected == Some(found), || (field, format!("{found} bytes do not fill shape {shape:?}")))?;
    Ok(array.data)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_bit_pattern_survives() {
        let values = [0.0, -0.0, f32::MIN_POSITIVE / 2.0, f32::NAN, f32::INFINITY, -1.5];
        let back = to_f32("x", Some(from_f32(&[2, 3], &values)), &[2, 3]).unwrap();
        assert_eq!(back.map_bits(), values.to_vec().map_bits());
        let whole = [0, 1, u32::MAX];
        assert_eq!(to_u32("x", Some(from_u32(&[3], &whole)), &[3]).unwrap(), whole);
    }

    trait MapBits {
        fn map_bits(&self) -> Vec<u32>;
    }
    impl MapBits for Vec<f32> {
        fn map_bits(&self) -> Vec<u32> {
            self.iter().map(|x| x.to_bits()).collect()
        }
    }

    #[test]
    fn what_does_not_fit_is_named() {
        let check = |array: Option<Array>, words: &str| {
            let error = to_f32("team.goals", array, &[2, 2]).unwrap_err().to_string();
            assert!(error.starts_with("team.goals: ") && error.contains(words), "{error}");
        };
        check(None, "missing");
        check(Some(from_u32(&[2, 2], &[0; 4])), "DATA_TYPE_U32");
        check(Some(from_f32(&[4], &[0.0; 4])), "[4]");
        check(Some(from_f32(&[2, 2], &[0.0; 3])), "12 bytes");
    }
}
