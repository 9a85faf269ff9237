"""Questions of the check about one value."""

from __future__ import annotations

from typing import Any

import numpy as np

from magex._observations import kind
from magex._problems import short
from magex._report import Report


def contains(space: Any, value: Any) -> bool:
    try:
        return bool(space.contains(value))
    except Exception:
        return False


def outside(space: Any, value: Any) -> str:
    """Why a value is not in a space, as far as that can be said."""
    if kind(space) == "Box":
        array = np.asarray(value)
        outside = (array < space.low) | (array > space.high)
        if outside.any():
            at = tuple(int(i) for i in np.argwhere(outside)[0])
            where = at[0] if len(at) == 1 else at
            return f"number {where} is {array[at]}, and its bounds are {space.low[at]} to {space.high[at]}"
        return f"{array.dtype} of shape {array.shape}, and the space is {short(space)}"
    return f"{short(value)}, and the space is {short(space)}"


def dtypes(report: Report, place: str, space: Any, value: Any, field: str) -> bool:
    """Whether all arrays have the dtype of their space."""
    name = kind(space)
    if name in ("Box", "MultiBinary", "MultiDiscrete"):
        if not isinstance(value, np.ndarray):
            report.add("dtypes", f"{place}: {field} is a {type(value).__name__}; return a NumPy array of {space.dtype}")
            return False
        if value.dtype != space.dtype:
            report.add("dtypes", f"{place}: {field} has dtype {value.dtype}, and its space {space.dtype}")
            return False
        return True
    parts = space.spaces.items() if name == "Dict" else enumerate(space.spaces) if name == "Tuple" else ()
    return all([dtypes(report, place, part, value[key], f"{field}[{key!r}]") for key, part in parts])


def equal(a: Any, b: Any) -> bool:
    """Equal bit by bit; NaN equals itself."""
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a)
    if isinstance(a, (tuple, list)) and isinstance(b, (tuple, list)):
        return len(a) == len(b) and all(equal(x, y) for x, y in zip(a, b))
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        x, y = np.asarray(a), np.asarray(b)
        return x.shape == y.shape and x.dtype == y.dtype and x.tobytes() == y.tobytes()
    return bool(a == b) or (a != a and b != b)
