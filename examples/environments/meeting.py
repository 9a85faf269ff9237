"""Three agents on a grid meet in one cell: an environment of one's own, with PettingZoo's Parallel interface."""

import magex
import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

SIDE, STEPS = 7, 20
MOVES = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])


class Meeting(ParallelEnv):
    metadata = {"name": "meeting"}
    max_steps = STEPS
    possible_agents = ["agent_0", "agent_1", "agent_2"]
    view = spaces.Box(-1.0, 1.0, (6,), np.float32)  # the agent's own cell, and the way to each of the others
    move = spaces.Discrete(5)

    def observation_space(self, agent):
        return self.view

    def action_space(self, agent):
        return self.move

    def observe(self):
        cells = self.cells / (SIDE - 1)
        rows = np.concatenate([cells, np.roll(cells, 2, axis=0) - cells, np.roll(cells, 1, axis=0) - cells], axis=1)
        return dict(zip(self.possible_agents, rows.astype(np.float32)))

    def reset(self, seed=None, options=None):
        self.agents, self.steps = self.possible_agents[:], 0
        self.cells = np.random.default_rng(seed).integers(0, SIDE, (3, 2))
        return self.observe(), {agent: {} for agent in self.agents}

    def step(self, actions):
        agents, self.steps = self.agents, self.steps + 1
        self.cells = np.clip(self.cells + MOVES[[actions[agent] for agent in agents]], 0, SIDE - 1)
        apart = np.ptp(self.cells, axis=0).sum() / (SIDE - 1)
        met, late = bool(apart == 0), self.steps == STEPS
        self.agents = [] if met or late else agents
        rewards, infos = dict.fromkeys(agents, -float(apart)), {agent: {"is_success": met} for agent in agents}
        return self.observe(), rewards, dict.fromkeys(agents, met), dict.fromkeys(agents, late and not met), infos


if __name__ == "__main__":
    magex.serve(Meeting)
