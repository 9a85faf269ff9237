"""Trivial environments: what is measured is the way to them."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

import magex

AGENTS = ["agent_0", "agent_1", "agent_2"]
VIEW = spaces.Box(-np.inf, np.inf, (18,), np.float32)
CHOICE = spaces.Discrete(5)


class Objects:
    """Three agents with PettingZoo's Parallel interface that hardly compute."""

    metadata = {"name": "objects"}
    possible_agents = AGENTS
    render_mode = None

    def observation_space(self, agent: str) -> spaces.Box:
        return VIEW

    def action_space(self, agent: str) -> spaces.Discrete:
        return CHOICE

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        self.agents = list(AGENTS)
        self.steps = 0
        self.view = {agent: np.full(18, seed, np.float32) for agent in AGENTS}
        return self.view, {agent: {} for agent in AGENTS}

    def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
        self.steps += 1
        over = self.steps == 25
        if over:
            self.agents = []
        rewards = {agent: float(action) for agent, action in actions.items()}
        return (
            self.view,
            rewards,
            dict.fromkeys(AGENTS, False),
            dict.fromkeys(AGENTS, over),
            {agent: {} for agent in AGENTS},
        )

    def close(self) -> None:
        pass


class Arrays(magex.VectorEnvironment):
    """The same for all worlds at once, in arrays."""

    agents = AGENTS
    observation_space = VIEW
    action_space = CHOICE
    steps_max = 25

    def reset(self, worlds: int, seeds: np.ndarray) -> np.ndarray:
        self.steps = np.zeros(worlds, np.int64)
        self.view = np.repeat(seeds.astype(np.float32), 3 * 18).reshape(worlds, 3, 18)
        return self.view

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        self.steps += 1
        return self.view, actions.astype(np.float64), np.zeros(len(self.steps), bool), self.steps == 25

    def restart(self, which: np.ndarray, seeds: np.ndarray) -> np.ndarray:
        self.steps[which] = 0
        self.view[which] = seeds[:, None, None]
        return self.view[which]
