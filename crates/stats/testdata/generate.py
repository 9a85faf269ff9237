#!/usr/bin/env python3
"""Records what rliable 1.2.0 computes of fixed arrays, for tests/rliable.rs.

    python3 -m venv venv
    venv/bin/pip install rliable==1.2.0 pandas==2.3.3 arch==7.2.0
    venv/bin/python generate.py > rliable.json

rliable expects scores [R runs, K tasks]; the file has them as [K tasks][R runs], as the crate does.
"""

import json

import numpy as np
from rliable import library, metrics

random = np.random.default_rng(20261129)
ARRAYS = {
    "one run, one task": np.array([[0.25]]),
    "three runs, one task": np.array([[0.5], [0.7], [0.9]]),
    "three runs, three tasks": random.uniform(0, 1, (3, 3)),
    "five runs, six tasks": random.uniform(-0.5, 1.5, (5, 6)),
    "ten runs, seven tasks": random.normal(0.6, 0.4, (10, 7)),
    "ties": random.integers(0, 4, (6, 4)) / 4,
    "constant": np.full((4, 2), 0.3),
}
PAIRS = [
    ("ties", random.integers(0, 4, (5, 4)) / 4),
    ("five runs, six tasks", random.uniform(-0.5, 1.5, (3, 6))),
    ("constant", np.full((2, 2), 0.3)),
]
TAUS = np.array([-0.5, 0.0, 0.25, 0.3, 0.5, 0.75, 0.99, 1.0, 1.5])


def case(name, scores):
    profile = library.run_score_deviation  # strictly above tau
    return {
        "name": name,
        "scores": scores.T.tolist(),
        "iqm": metrics.aggregate_iqm(scores),
        "mean": metrics.aggregate_mean(scores),
        "median": metrics.aggregate_median(scores),
        "optimality_gap": metrics.aggregate_optimality_gap(scores),
        "optimality_gap_half": metrics.aggregate_optimality_gap(scores, gamma=0.5),
        "profile": [profile(scores, tau) for tau in TAUS],
        "standard_deviation": float(np.std(scores, ddof=1)) if scores.size > 1 else None,
    }


def pair(name, other):
    scores = ARRAYS[name]
    return {
        "x": scores.T.tolist(),
        "y": other.T.tolist(),
        "probability_of_improvement": metrics.probability_of_improvement(scores, other),
    }


def interval(name, repetitions=50_000):
    np.random.seed(1)
    _, ends = library.get_interval_estimates(
        {"x": ARRAYS[name]}, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=repetitions
    )
    return {"name": name, "iqm_interval": [float(end) for end in ends["x"].reshape(-1)]}


print(
    json.dumps(
        {
            "thresholds": TAUS.tolist(),
            "cases": [case(*item) for item in ARRAYS.items()],
            "pairs": [pair(*item) for item in PAIRS],
            "intervals": [interval("five runs, six tasks"), interval("ten runs, seven tasks")],
        },
        indent=1,
    )
)
