"""Exact assignment of arrays: the solvers of the goal commander as functions."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from magex._native import native


class Assignment(NamedTuple):
    """Pairs, as `scipy.optimize.linear_sum_assignment` returns them, and what they cost."""

    #: int64 [P] rows (agents) that have a partner, ascending.
    row_ind: np.ndarray
    #: int64 [P] the column (goal) of each of them.
    col_ind: np.ndarray
    #: What the objective minimises: the sum of the pairs' costs, or the largest of them. 0 without pairs.
    cost: float


def assign(agents_xy: Any, goals_xy: Any, objective: str = "total", power: float = 1.0) -> Assignment:
    """Assigns agents to goals by distance.

    agents_xy: [N, D] positions, D ≥ 1, in any unit. goals_xy: [G, D]. min(N, G) pairs are made.
    objective: "total" minimises the sum of distance^power; "bottleneck" the largest of them, then their sum.
    power: 1 to 16. The cost is in the unit of the positions to this power.

    The answer is exact, and the same on every machine: of several best ones it is the lowest (agent 0 has the lowest goal that
    the best answers give it, and so on). Teams of thousands need no matrix. Other threads run meanwhile, and Ctrl-C ends it.
    ValueError names the argument that is not accepted.
    """
    module = native("magex.assign")
    agents, goals = _numbers("agents_xy", agents_xy), _numbers("goals_xy", goals_xy)
    return _answer(module.assign_points, agents, goals, objective, float(power))


def assign_costs(matrix: Any, objective: str = "total") -> Assignment:
    """Assigns rows to columns of a matrix of costs.

    matrix: [R, C], each cost a number up to 1e300 in magnitude; +inf forbids a pair.
    objective: "total" makes as many pairs as can be and minimises the sum of their costs; "bottleneck" minimises the largest
    cost, then the sum.

    Unlike scipy, a matrix whose rows cannot all have a partner is no error: the answer has fewer pairs. Sums are compared as if
    they were added without rounding; of several best answers it is the lowest.
    """
    return _answer(native("magex.assign_costs").assign_costs, _numbers("matrix", matrix), objective)


def assign_sparse(rows: Any, cols: Any, costs: Any, shape: tuple[int, int]) -> Assignment:
    """Assigns rows to columns by a list of allowed pairs; every other pair is forbidden.

    rows, cols: integers [P]. costs: numbers [P]. shape: (rows, columns) of the whole.
    Makes as many pairs as can be and minimises the sum of their costs. The last one of a pair that is listed twice counts.
    Memory grows with the list. These are the arrays of a scipy.sparse.coo_array: `assign_sparse(a.row, a.col, a.data, a.shape)`.
    """
    module = native("magex.assign_sparse")
    if len(shape) != 2 or any(int(size) < 0 for size in shape):
        raise ValueError(f"shape: {shape} is not a pair of sizes; pass (rows, columns)")
    pairs = (_indices("rows", rows), _indices("cols", cols), _numbers("costs", costs))
    for field, array in zip(("rows", "cols", "costs"), pairs):
        if array.ndim != 1:
            raise ValueError(f"{field}: has {array.ndim} axes; pass an array of shape [pairs]")
    return _answer(module.assign_sparse, *pairs, [int(size) for size in shape])


def _answer(solver: Any, *arguments: Any) -> Assignment:
    return Assignment(*solver(*arguments))


def _numbers(field: str, value: Any) -> np.ndarray:
    try:
        return np.ascontiguousarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{field}: is not an array of numbers; pass floats") from None


def _indices(field: str, value: Any) -> np.ndarray:
    array = np.asarray(value)
    if array.size and array.dtype.kind not in "iu":
        raise ValueError(f"{field}: is of type {array.dtype}; pass whole numbers")
    return np.ascontiguousarray(array, dtype=np.int64)
