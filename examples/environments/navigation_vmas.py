"""VMAS's navigation: all worlds in one PyTorch simulation. pip install -r requirements-vmas.txt"""

import magex
import numpy as np
import torch
import vmas
from gymnasium import spaces


class Navigation(magex.VectorEnvironment):
    name = "vmas navigation"
    agents = [f"agent_{i}" for i in range(4)]
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    steps_max = 100

    def __init__(self):
        self.env = self.make(1, 0)
        width = self.env.reset()[0].shape[1]
        self.observation_space = spaces.Box(-np.inf, np.inf, (width,), np.float32)

    def make(self, worlds, seed):
        # Horizon: VMAS says "done" for both ends, so the limit is counted here.
        return vmas.make_env("navigation", worlds, continuous_actions=True, seed=seed, n_agents=len(self.agents))

    def reset(self, worlds, seeds):
        if worlds != self.env.num_envs:
            self.env = self.make(worlds, int(seeds[0]))
        self.steps = np.zeros(worlds, int)
        self.env.seed(int(seeds[0]))
        return self.stack(self.env.reset())

    def restart(self, which, seeds):
        for world in which:
            self.env.reset_at(int(world))
        self.steps[which] = 0
        return self.stack([self.env.scenario.observation(agent) for agent in self.env.agents])[which]

    def step(self, actions):
        self.steps += 1
        observations, rewards, done, _ = self.env.step(list(torch.from_numpy(actions).unbind(dim=1)))
        self.done = done.numpy()
        return self.stack(observations), self.stack(rewards), self.done, (self.steps >= self.steps_max) & ~self.done

    def stack(self, tensors):  # [W, N, ...]
        return torch.stack(list(tensors), dim=1).numpy()

    def successes(self):
        return self.done


if __name__ == "__main__":
    # One generator draws for all worlds, so that an episode is no function of its own seed.
    magex.serve(Navigation, deterministic=False)
