"""The task of meeting.py with all worlds in arrays: 64 worlds cost hardly more than one."""

import magex
import numpy as np
from gymnasium import spaces

SIDE, STEPS = 7, 20
MOVES = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])


class Meeting(magex.VectorEnvironment):
    name = "meeting"
    agents = ["agent_0", "agent_1", "agent_2"]
    observation_space = spaces.Box(-1.0, 1.0, (6,), np.float32)
    action_space = spaces.Discrete(5)
    steps_max = STEPS

    def observe(self):  # [W, 3, 6]
        scaled = self.cells / (SIDE - 1)
        others = [np.roll(scaled, shift, axis=1) - scaled for shift in (2, 1)]
        return np.concatenate([scaled, *others], axis=2)

    def begin(self, seeds):  # [W, 3, 2]
        return (magex.uniform(seeds, 0, 3, 2) * SIDE).astype(int)

    def reset(self, worlds, seeds):
        self.steps = np.zeros(worlds, int)
        self.cells = self.begin(seeds)
        return self.observe()

    def restart(self, which, seeds):
        self.steps[which] = 0
        self.cells[which] = self.begin(seeds)
        return self.observe()[which]

    def step(self, actions):  # [W, 3]
        self.steps += 1
        self.cells = np.clip(self.cells + MOVES[actions], 0, SIDE - 1)
        apart = np.ptp(self.cells, axis=1).sum(axis=1) / (SIDE - 1)
        self.met = apart == 0
        rewards = np.repeat(-apart[:, None], 3, axis=1)
        return self.observe(), rewards, self.met, (self.steps >= STEPS) & ~self.met

    def successes(self):
        return self.met


if __name__ == "__main__":
    magex.serve(Meeting)
