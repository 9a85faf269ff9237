"""Serves a Python environment to MAGE-X, which trains teams of agents in it.

import magex
magex.serve(make)      # make() returns a PettingZoo Parallel environment, a Gymnasium environment or a VectorEnvironment
"""

import os

# gRPC's handlers of fork() break processes that an environment forks, such as the workers of Gymnasium's AsyncVectorEnv. These
# never call gRPC. It is read when gRPC is imported.
os.environ.setdefault("GRPC_ENABLE_FORK_SUPPORT", "0")

from magex._assignment import Assignment, assign, assign_costs, assign_sparse  # noqa: E402
from magex._random import uniform  # noqa: E402
from magex._server import serve  # noqa: E402
from magex._vector import VectorEnvironment  # noqa: E402

__version__ = "0.2.0"

__all__ = ["Assignment", "VectorEnvironment", "__version__", "assign", "assign_costs", "assign_sparse", "serve", "uniform"]
