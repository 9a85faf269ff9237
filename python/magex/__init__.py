"""Serves a Python environment to MAGE-X, which trains teams of agents in it.

import magex
magex.serve(make)      # make() returns a PettingZoo Parallel environment, a Gymnasium environment or a VectorEnvironment
"""

from magex._random import uniform
from magex._server import serve
from magex._vector import VectorEnvironment

__version__ = "0.2.0"

__all__ = ["VectorEnvironment", "__version__", "serve", "uniform"]
