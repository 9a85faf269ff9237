"""Environments of the tests: right ones, and ones that break one rule each."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

import magex


class Line:
    """Agents on a line go left, stay or go right. Everything that a test wants to be different is an argument."""

    metadata = {"name": "line"}
    render_mode: str | None = None

    def __init__(self, agents: int = 3, limit: int = 10, leaves: dict[str, int] | None = None) -> None:
        self.possible_agents = [f"agent_{i}" for i in range(agents)]
        self.agents: list[str] = []
        self.max_steps = limit
        self.leaves = leaves or {}
        self.view = spaces.Box(-100.0, 100.0, (2,), np.float32)
        self.choice = spaces.Discrete(3)
        self.closed = 0

    def observation_space(self, agent: str) -> Any:
        return self.view

    def action_space(self, agent: str) -> Any:
        return self.choice

    def observe(self, agent: str) -> Any:
        return np.array([self.place[agent], self.steps], np.float32)

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        rng = np.random.default_rng(seed)
        self.steps = 0
        self.options = options
        self.agents = self.possible_agents[:]
        self.place = {agent: rng.uniform(-1, 1) for agent in self.agents}
        if options and "place" in options:
            self.place = dict.fromkeys(self.agents, options["place"])
        return {agent: self.observe(agent) for agent in self.agents}, {agent: self.info(agent) for agent in self.agents}

    def info(self, agent: str) -> dict:
        return {}

    def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
        self.steps += 1
        acted = self.agents
        for agent in acted:
            self.place[agent] += int(actions[agent]) - 1
        terminations = {agent: self.leaves.get(agent) == self.steps for agent in acted}
        truncations = {agent: self.steps >= self.max_steps and not terminations[agent] for agent in acted}
        self.agents = [agent for agent in acted if not terminations[agent] and not truncations[agent]]
        return (
            {agent: self.observe(agent) for agent in acted},
            {agent: float(self.place[agent]) for agent in acted},
            terminations,
            truncations,
            {agent: self.info(agent) for agent in acted},
        )

    def close(self) -> None:
        self.closed += 1


class Alone(gymnasium.Env):
    """One agent with Gymnasium's interface; says whether it was a success."""

    metadata = {"render_modes": ["rgb_array"]}
    max_steps = 5

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.observation_space = spaces.Box(-np.inf, np.inf, (2, 2), np.float64)
        self.action_space = spaces.Discrete(2, start=3)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        self.steps = 0
        self.sum = self.np_random.random()
        return self.observe(), {}

    def observe(self) -> Any:
        return np.full((2, 2), self.sum)

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict]:
        assert action in (3, 4)
        self.steps += 1
        self.sum += action
        over = self.steps == self.max_steps
        return self.observe(), 0.1, False, over, {"is_success": self.sum > 17.0} if over else {}

    def render(self) -> Any:
        return np.full((3, 4, 3), 7, np.uint8)


class Many(magex.VectorEnvironment):
    """Two agents in W worlds of arrays."""

    agents = ("left", "right")
    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = spaces.Discrete(3)
    steps_max = 6

    def reset(self, worlds: int, seeds: np.ndarray) -> np.ndarray:
        self.steps = np.zeros(worlds, np.int64)
        self.place = magex.uniform(seeds, 0, 2)
        return self.view()

    def view(self) -> np.ndarray:
        return np.stack([self.place, np.repeat(self.steps[:, None], 2, axis=1)], axis=2).astype(np.float32)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        self.steps += 1
        self.place = self.place + actions - 1
        return self.view(), self.place.copy(), np.zeros(len(self.steps), bool), self.steps >= self.steps_max

    def restart(self, which: np.ndarray, seeds: np.ndarray) -> np.ndarray:
        self.steps[which] = 0
        self.place[which] = magex.uniform(seeds, 0, 2)
        return self.view()[which]

    def states(self) -> np.ndarray:
        return self.place

    def successes(self) -> np.ndarray:
        return self.place[:, 0] > 0


def vector(num_envs: int) -> gymnasium.vector.VectorEnv:
    return gymnasium.vector.SyncVectorEnv([Alone] * num_envs, autoreset_mode=gymnasium.vector.AutoresetMode.DISABLED)
