"""The compiled part of the package `magex`: worlds that write into NumPy arrays, and exact assignment.

`magex.envs` and `magex.assign` are the interfaces; docs/python-tasks.md of the repository describes them.
"""

from __future__ import annotations

from magex_native._processor import check

# Before the compiled module is loaded: its first instruction may be one that an old processor does not know.
check()

from magex_native._native import (
    AVX2,
    AVX512,
    Worlds,
    __version__,
    assign_costs,
    assign_points,
    assign_sparse,
)

__all__ = ["AVX2", "AVX512", "Worlds", "__version__", "assign_costs", "assign_points", "assign_sparse"]
