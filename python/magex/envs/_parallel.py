"""One world with PettingZoo's Parallel API."""

from __future__ import annotations

from typing import Any

import numpy as np

from magex.envs._vector import vector

try:
    from pettingzoo import ParallelEnv
    from pettingzoo.utils.conversions import parallel_to_aec
except ModuleNotFoundError as missing:
    if missing.name not in ("pettingzoo", "gymnasium"):
        raise
    raise ImportError(
        "parallel_env needs the packages pettingzoo and gymnasium; pip install pettingzoo, or use magex.envs.vector without them"
    ) from None

__all__ = ["ParallelTask", "parallel_to_aec"]


class ParallelTask(ParallelEnv):
    """One world of a task. All agents act in every step; the time limit truncates all of them at once; nothing terminates.

    `reset(seed=s)` begins the first episode of world 0 of `magex.envs.vector(...).reset(seed=s)`, with the same numbers.
    options={"goals": [N]} (push_ball [N, 2]) gives the agents goals, and so does `set_goals`; without it they are assigned.
    The infos of the last step have "episode", a dict of what the episode scored, and "is_success": all landmarks are covered.
    """

    def __init__(self, task: str, render_mode: str | None, **arguments: Any) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode: {render_mode!r} is not a mode; use None or 'rgb_array'")
        self._vector = vector(task, worlds=1, autoreset="disabled", **arguments)
        self.render_mode = render_mode
        modes = self._vector.metadata
        self.metadata = {
            "name": modes["name"],
            "render_modes": ["rgb_array"],
            "render_fps": modes["render_fps"],
            "is_parallelizable": True,
        }
        #: Steps of an episode.
        self.max_cycles = self._vector.horizon
        self.possible_agents = [f"agent_{i}" for i in range(self._vector.agents)]
        self.agents: list[str] = []

    def observation_space(self, agent: str) -> Any:
        """The space of an agent's observation, float32 [V]."""
        return self._vector.agent_observation_space

    def action_space(self, agent: str) -> Any:
        """The space of an agent's action: Discrete(5), for drones MultiDiscrete([3, 3, 3])."""
        return self._vector.agent_action_space

    @property
    def state_space(self) -> Any:
        """The space of `state`."""
        return self._vector._space("state", lambda s: s.Box(-np.inf, np.inf, self._state_shape, np.float32))

    @property
    def _state_shape(self) -> tuple[int]:
        v = self._vector
        return ((2 * v.bodies + v.agents) * v.dims + v.agents * v._core.sizes[7],)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """Begins an episode; returns observations and infos by agent. Options other than goals are ignored."""
        # PettingZoo's test passes an option that no environment knows.
        goals = (options or {}).get("goals")
        observations, _ = self._vector.reset(seed=seed, options=None if goals is None else {"goals": goals})
        self.agents = list(self.possible_agents)
        return dict(zip(self.agents, observations[0])), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """One step; actions are integers by agent, for drones three of them."""
        if not self.agents:
            return {}, {}, {}, {}, {}
        try:
            given = np.asarray([actions[agent] for agent in self.agents])
        except KeyError as missing:
            raise ValueError(f"actions: {missing.args[0]} is missing; every agent acts in every step") from None
        agents = self.agents
        observations, rewards, _, truncations, infos = self._vector.step(given[None])
        over = bool(truncations[0, 0])
        score = {name: float(values[0]) for name, values in infos.get("final_info", {}).items()}
        if over:
            self.agents = []
        last = {"episode": score, "is_success": score.get("all_covered_rate") == 1.0} if over else {}
        return (
            dict(zip(agents, observations[0])),
            dict(zip(agents, rewards[0].tolist())),
            dict.fromkeys(agents, False),
            dict.fromkeys(agents, over),
            {agent: dict(last) for agent in agents},
        )

    def set_goals(self, goals: Any) -> dict[str, np.ndarray]:
        """Gives the agents goals [N] (push_ball [N, 2]) until the episode ends; returns the observations by agent."""
        return dict(zip(self.agents, self._vector.set_goals(np.asarray(goals)[None])[0]))

    def goals(self) -> np.ndarray:
        """The agents' goals, uint32 [N] (push_ball [N, 2])."""
        goals = self._vector.state()["goals"][0]
        return goals[:, 0] if goals.shape[1] == 1 else goals

    def state(self) -> np.ndarray:
        """Positions of all bodies, velocities of all bodies, landmarks, further state of the agents: float32, world units."""
        state = self._vector.state()
        parts = ("positions", "velocities", "landmarks", "agent_state")
        return np.concatenate([state[part][0].ravel() for part in parts])

    def render(self) -> np.ndarray | None:
        """A picture [512, 512, 3] uint8 from above; None without render_mode."""
        return self._vector.render() if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Nothing is held that needs to be given back."""
