//! NumPy arrays as slices, and refusals as exceptions.

use magex_core::error::FieldError;
use numpy::{
    Element, PyArray1, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn, PyReadwriteArrayDyn, PyUntypedArrayMethods,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

/// A refusal: the field's name, what is wrong, and the remedy.
pub(crate) fn refused(error: FieldError) -> PyErr {
    PyValueError::new_err(error.to_string())
}

/// The entries of an array that is only read, in C order.
pub(crate) fn entries<'a, T: Element>(field: &str, array: &'a PyReadonlyArrayDyn<'_, T>) -> PyResult<&'a [T]> {
    let problem = "is not contiguous; pass numpy.ascontiguousarray(...)";
    // `as_slice` takes Fortran's order too, where the last index does not run fastest.
    if !array.is_c_contiguous() {
        return Err(refused(FieldError::new(field, problem)));
    }
    array.as_slice().map_err(|_| refused(FieldError::new(field, problem)))
}

/// The entries of an array that has to have a shape.
pub(crate) fn read<'a, T: Element>(
    field: &str,
    array: &'a PyReadonlyArrayDyn<'_, T>,
    shape: [usize; 3],
) -> PyResult<&'a [T]> {
    check_shape(field, array, &shape)?;
    entries(field, array)
}

/// The entries of an array that is overwritten.
pub(crate) fn room<'a, T: Element>(
    field: &str,
    array: &'a mut PyReadwriteArrayDyn<'_, T>,
    shape: &[usize],
) -> PyResult<&'a mut [T]> {
    check_shape(field, array, shape)?;
    let problem = "is not contiguous; pass an array that numpy.empty(...) made";
    if !array.is_c_contiguous() {
        return Err(refused(FieldError::new(field, problem)));
    }
    array.as_slice_mut().map_err(|_| refused(FieldError::new(field, problem)))
}

/// `Ok` if an array has a shape.
fn check_shape<T: Element>(field: &str, array: &Bound<'_, PyArrayDyn<T>>, shape: &[usize]) -> PyResult<()> {
    if array.shape() == shape {
        return Ok(());
    }
    Err(refused(FieldError::new(field, format!("has the shape {:?}, but {shape:?} is needed", array.shape()))))
}

/// A new array of a shape.
pub(crate) fn array<'py, T: Element>(
    py: Python<'py>,
    values: Vec<T>,
    shape: &[usize],
) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
    PyArray1::from_vec(py, values).reshape(shape.to_vec())
}
