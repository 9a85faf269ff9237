"""The assignment functions beside SciPy's."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.spatial.distance import cdist

import magex

SIZES = [(1, 1), (3, 3), (5, 9), (9, 5), (20, 20), (60, 60), (60, 41), (7, 60)]


@pytest.mark.parametrize("rows, cols", SIZES)
@pytest.mark.parametrize("power", [1.0, 1.5, 2.0, 3.0])
def test_points(rows, cols, power):
    rng = np.random.default_rng(rows * 100 + cols)
    for dims in (1, 2, 3, 4):
        agents, goals = rng.normal(size=(rows, dims)), rng.normal(size=(cols, dims))
        row_ind, col_ind, cost = magex.assign(agents, goals, power=power)
        costs = cdist(agents, goals) ** power
        a, b = linear_sum_assignment(costs)
        np.testing.assert_array_equal(row_ind, a)
        np.testing.assert_allclose(cost, costs[a, b].sum(), rtol=1e-9)
        np.testing.assert_allclose(costs[row_ind, col_ind].sum(), cost, rtol=1e-9)
        longest = magex.assign(agents, goals, "bottleneck", power)
        np.testing.assert_allclose(longest.cost, costs[longest.row_ind, longest.col_ind].max(), rtol=1e-9)
        assert longest.cost <= costs[a, b].max() * (1 + 1e-9)


@pytest.mark.parametrize("rows, cols", SIZES)
@pytest.mark.parametrize("whole", [True, False])
def test_costs(rows, cols, whole):
    rng = np.random.default_rng(rows * 100 + cols)
    for _ in range(20):
        costs = rng.integers(-9, 10, (rows, cols)).astype(float) if whole else rng.normal(size=(rows, cols))
        found = magex.assign_costs(costs)
        a, b = linear_sum_assignment(costs)
        assert len(found.row_ind) == len(set(found.col_ind.tolist())) == min(rows, cols)
        assert (np.diff(found.row_ind) > 0).all()
        np.testing.assert_allclose(found.cost, costs[a, b].sum(), atol=1e-9)
        np.testing.assert_allclose(costs[found.row_ind, found.col_ind].sum(), found.cost, atol=1e-9)
        longest = magex.assign_costs(costs, objective="bottleneck")
        assert longest.cost == costs[longest.row_ind, longest.col_ind].max()
        # No threshold below allows as many pairs.
        below = np.where(costs < longest.cost, 0.0, 1.0)
        a, b = linear_sum_assignment(below)
        assert below[a, b].sum() > 0


def test_forbidden_pairs_and_lists_of_pairs():
    rng = np.random.default_rng(5)
    for n in range(1, 61, 4):
        costs = np.where(rng.random((n, n)) < 0.5, rng.normal(size=(n, n)), np.inf)
        np.fill_diagonal(costs, rng.normal(size=n))
        a, b = linear_sum_assignment(costs)
        dense = magex.assign_costs(costs)
        np.testing.assert_allclose(dense.cost, costs[a, b].sum(), atol=1e-9)
        rows, cols = np.nonzero(np.isfinite(costs))
        sparse = magex.assign_sparse(rows, cols, costs[rows, cols], costs.shape)
        for mine, other in zip(dense, sparse):
            np.testing.assert_array_equal(mine, other)
    array = coo_array(([3.0, 1.0, 1.0], ([0, 0, 1], [0, 1, 1])), shape=(2, 3))
    found = magex.assign_sparse(array.row, array.col, array.data, array.shape)
    assert found.col_ind.tolist() == [0, 1] and found.cost == 4.0
    # SciPy calls this infeasible; here it is an answer with fewer pairs.
    found = magex.assign_costs([[1.0, np.inf], [2.0, np.inf]])
    assert (found.row_ind.tolist(), found.col_ind.tolist(), found.cost) == ([0], [0], 1.0)
    assert magex.assign_costs([[np.inf]], "bottleneck")[2] == 0.0


def test_of_several_best_answers_it_is_the_lowest():
    assert magex.assign_costs(np.ones((4, 4))).col_ind.tolist() == [0, 1, 2, 3]
    assert magex.assign_costs([[0.1 + 0.2, 0.3], [0.3, 0.3]]).col_ind.tolist() == [1, 0]


def test_refusals_name_the_argument():
    ok = np.zeros((2, 2))
    for match, call in [
        ("objective: 'sum' is not an objective", lambda: magex.assign(ok, ok, "sum")),
        ("power: 0.5 is not a number from 1 to 16", lambda: magex.assign(ok, ok, power=0.5)),
        ("agents_xy: is not an array of numbers", lambda: magex.assign([["a"]], ok)),
        ("agents_xy: has 1 axes; pass", lambda: magex.assign([1.0, 2.0], ok)),
        ("goals_xy: has 3 coordinates per point, agents_xy has 2", lambda: magex.assign(ok, np.zeros((2, 3)))),
        (r"goals_xy\[1\]\[0\]: NaN is not finite", lambda: magex.assign(ok, [[0.0, 0.0], [np.nan, 0.0]])),
        ("0 rows by 2 columns is empty", lambda: magex.assign(np.zeros((0, 2)), ok)),
        (r"matrix\[0\]\[1\]: NaN is not a finite", lambda: magex.assign_costs([[0.0, np.nan]])),
        (r"matrix\[0\]\[0\]: -inf is not a finite", lambda: magex.assign_costs([[-np.inf]])),
        ("matrix: has 3 axes", lambda: magex.assign_costs(np.zeros((1, 1, 1)))),
        (r"cols\[1\]: 2 is not from 0 to below 2", lambda: magex.assign_sparse([0, 1], [0, 2], [1, 1], (2, 2))),
        (r"rows\[0\]: -1 is not", lambda: magex.assign_sparse([-1], [0], [1], (2, 2))),
        (r"costs\[0\]: NaN is neither", lambda: magex.assign_sparse([0], [0], [np.nan], (2, 2))),
        ("costs: has 2 entries, rows has 1", lambda: magex.assign_sparse([0], [0], [1, 2], (2, 2))),
        ("rows: is of type float64", lambda: magex.assign_sparse([0.5], [0], [1], (2, 2))),
        ("shape: .* is not a pair of sizes", lambda: magex.assign_sparse([0], [0], [1], (2,))),
    ]:
        with pytest.raises(ValueError, match=match):
            call()


def test_other_threads_run_meanwhile():
    rng = np.random.default_rng(0)
    costs = rng.random((1500, 1500))
    solved = threading.Event()
    thread = threading.Thread(target=lambda: (magex.assign_costs(costs), solved.set()))
    thread.start()
    turns = 0
    while not solved.is_set():
        turns += 1
        time.sleep(0.001)
    thread.join()
    assert turns > 5
