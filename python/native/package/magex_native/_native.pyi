"""Types of the compiled module. Arrays are C-contiguous; W worlds, N agents, D dimensions, E bodies, K goals per agent,
H components of an action, V numbers of an observation, X further numbers of an agent's state."""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

#: The compiler was allowed to use AVX2, FMA and BMI2.
AVX2: bool
#: The compiler was allowed to use AVX-512: never in a wheel for x86-64-v3.
AVX512: bool
__version__: str

Floats: TypeAlias = NDArray[np.float32]
Doubles: TypeAlias = NDArray[np.float64]
Longs: TypeAlias = NDArray[np.int64]

class Worlds:
    """W worlds of one task; `magex.envs.vector` is the face of it."""

    #: W, N, D, E, K, H, V, X.
    sizes: list[int]
    #: Joint steps of an episode.
    horizon: int
    #: Side of the map, world units.
    side: float
    #: Choices of every component of an action.
    choices: int
    #: Seconds per joint step.
    step_seconds: float
    #: Radius that a landmark is drawn with, world units.
    landmark_radius: float
    #: Joint steps of the present episode that are done.
    steps: int

    def __init__(
        self,
        task: str,
        agents: int,
        worlds: int,
        *,
        spawn: str,
        side: float | None,
        horizon: int | None,
        reward: str,
        observation: str,
        neighbours: int,
        settings: dict[str, Any] | None,
        threads: int,
    ) -> None: ...
    def reset(self, seed: int | None = None, start: list[Floats] | None = None) -> None:
        """Begins an episode in every world. start: positions and velocities [W, E, D], landmarks [W, N, D]."""
    def set_goals(self, goals: NDArray[np.uint32]) -> None:
        """Takes goals [W, N, K]."""
    def observe(self, out: Floats) -> None:
        """Writes the present observations [W, N, V]."""
    def step(
        self,
        actions: NDArray[np.uint8] | NDArray[np.int32] | NDArray[np.int64],
        rewards: Floats,
        observations: Floats | None,
        last: Floats | None,
        restart: bool,
    ) -> tuple[bool, dict[str, Floats]]:
        """One step with actions [W, N, H]; writes rewards [W, N] and observations [W, N, V], and where the episodes end what was
        seen last [W, N, V]. Returns whether they ended, and what they scored, [W] by name."""
    def state(self) -> tuple[list[Floats], NDArray[np.uint32]]:
        """Positions and velocities [W, E, D], agent_state [W, N, X], landmarks [W, N, D]; goals [W, N, K]."""

def assign_points(agents: Doubles, goals: Doubles, objective: str, power: float) -> tuple[Longs, Longs, float]:
    """Assigns agents [N, D] to goals [G, D]: rows, columns, cost."""

def assign_costs(costs: Doubles, objective: str) -> tuple[Longs, Longs, float]:
    """Assigns the rows of a matrix [R, C] to its columns; +inf forbids a pair."""

def assign_sparse(rows: Longs, cols: Longs, costs: Doubles, shape: list[int]) -> tuple[Longs, Longs, float]:
    """Assigns rows to columns by a list of allowed pairs [P]."""
