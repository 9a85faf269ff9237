#!/usr/bin/env bash
# pettingzoo 1.27.0, parallel_api_test: what it passes to reset.
#
# Expected: options of reset belong to the environment, so one that refuses an option that it does not know is correct, and says so to
# a user who misspells one.
# Seen: the test itself calls reset with an option that no environment defines, and an environment that refuses it fails the test with
# its own error. An environment that is to pass must ignore unknown options.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check --only-binary=:all: pettingzoo==1.27.0 gymnasium==1.4.0 numpy==2.4.6
cat > options.py <<'PYTHON'
import functools
import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv
from pettingzoo.test import parallel_api_test

class Line(ParallelEnv):
    metadata = {"name": "line_v0"}
    render_mode = None

    def __init__(self, strict):
        self.strict, self.possible_agents = strict, ["agent_0", "agent_1"]

    @functools.lru_cache(None)
    def observation_space(self, agent):
        return spaces.Box(0.0, 20.0, (1,), np.float32)

    @functools.lru_cache(None)
    def action_space(self, agent):
        return spaces.Discrete(2)

    def reset(self, seed=None, options=None):
        unknown = set(options or {}) - {"start"}
        if self.strict and unknown:
            raise ValueError(f"options: unknown {sorted(unknown)}; use start")
        self.agents, self.steps = list(self.possible_agents), 0
        return {agent: np.zeros(1, np.float32) for agent in self.agents}, {agent: {} for agent in self.agents}

    def step(self, actions):
        self.steps += 1
        over, acted = self.steps == 20, self.agents
        self.agents = [] if over else acted
        seen = {agent: np.full(1, self.steps, np.float32) for agent in acted}
        return seen, dict.fromkeys(acted, 1.0), dict.fromkeys(acted, False), dict.fromkeys(acted, over), {a: {} for a in acted}

for strict in (False, True):
    try:
        parallel_api_test(Line(strict), num_cycles=100)
        print(f"refuses unknown options {strict}: passes")
    except ValueError as error:
        print(f"refuses unknown options {strict}: fails, {error}")
PYTHON
venv/bin/python -W ignore options.py | grep "^refuses" | tee seen
diff seen - <<'SEEN' && echo "as before"
refuses unknown options False: passes
refuses unknown options True: fails, options: unknown ['options']; use start
SEEN
