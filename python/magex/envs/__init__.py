"""The tasks of MAGE-X as environments: Simple Spread, Push Ball and drones.

from magex.envs import simple_spread_v0
env = simple_spread_v0.parallel_env(agents=5)              # PettingZoo's Parallel API

import magex.envs
envs = magex.envs.vector("simple_spread", agents=50, worlds=256)   # many worlds in NumPy arrays

The simulators are compiled: they need the package magex-native. docs/python-tasks.md of the repository has the observations,
the actions and the units.
"""

from magex.envs._vector import VectorEnv, vector

__all__ = ["VectorEnv", "drones_v0", "push_ball_v0", "simple_spread_v0", "vector"]


def __getattr__(name: str) -> object:
    # PettingZoo is imported with these only.
    if name in ("drones_v0", "push_ball_v0", "simple_spread_v0"):
        import importlib

        return importlib.import_module(f"magex.envs.{name}")
    raise AttributeError(f"module 'magex.envs' has no attribute '{name}'")
