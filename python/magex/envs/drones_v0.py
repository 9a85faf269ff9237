"""Drones, N quadrotors fly to N points without a crash."""

from __future__ import annotations

from typing import Any

from magex.envs._parallel import ParallelTask, parallel_to_aec


def parallel_env(
    agents: int = 4,
    spawn: str = "uniform",
    side: float | None = None,
    horizon: int | None = None,
    reward: str = "goals",
    observation: str = "vector",
    render_mode: str | None = None,
    neighbours: int = 6,
    settings: dict[str, float | str] | None = None,
) -> ParallelTask:
    """Drones with PettingZoo's Parallel API; `magex.envs.vector` describes the arguments."""
    return ParallelTask(
        "drones",
        render_mode,
        agents=agents,
        spawn=spawn,
        side=side,
        horizon=horizon,
        reward=reward,
        observation=observation,
        neighbours=neighbours,
        settings=settings,
        threads=1,
    )


def env(**arguments: Any) -> Any:
    """The same with PettingZoo's AEC API."""
    return parallel_to_aec(parallel_env(**arguments))
