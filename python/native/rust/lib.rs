//! The tasks and the exact solvers of MAGE-X for Python: worlds that write into the caller's arrays, and assignment of arrays.
//! `magex.envs` and `magex.assign` are made of it; see docs/python-tasks.md.

mod arrays;
mod assign;
mod observe;
mod options;
mod shard;
mod vector;
mod worlds;

use pyo3::prelude::*;

/// The compiled part of `magex_native`.
#[pymodule]
mod _native {
    #[pymodule_export]
    use crate::assign::{assign_costs, assign_points, assign_sparse};
    #[pymodule_export]
    use crate::vector::Worlds;
    use pyo3::prelude::*;

    /// Says what the compiler was allowed to use, so that a test can see that no other flags won.
    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("AVX2", cfg!(all(target_feature = "avx2", target_feature = "fma", target_feature = "bmi2")))?;
        module.add("AVX512", cfg!(target_feature = "avx512f"))?;
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
