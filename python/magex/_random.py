"""Random numbers for environments that hold many worlds in arrays."""

from __future__ import annotations

import numpy as np

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)


def uniform(seeds: np.ndarray, draw: int | np.ndarray, *shape: int) -> np.ndarray:
    """Random numbers in [0, 1) for each world: float64 [W, *shape], a function of the world's seed [W] and of `draw` alone.

    `draw` numbers what an episode draws (0 for its start, then its step for instance); an int, or one for each world [W].
    A world's numbers depend neither on its index nor on the other worlds, and no generator is kept. Not for secrets.
    """
    seeds = np.asarray(seeds, np.uint64)
    count = int(np.prod(shape, dtype=np.int64))
    with np.errstate(over="ignore"):
        key = _mix(_mix(seeds) ^ (np.asarray(draw).astype(np.uint64) * _GOLDEN))
        numbers = _mix(key[:, None] + _GOLDEN * np.arange(1, count + 1, dtype=np.uint64))
    return ((numbers >> np.uint64(11)) * 2.0**-53).reshape(len(seeds), *shape)


def _mix(x: np.ndarray) -> np.ndarray:
    """The finaliser of SplitMix64: every bit of the result depends on every bit of x."""
    x = x + _GOLDEN
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
