#!/usr/bin/env bash
# pettingzoo 1.27.0, multiwalker_v9: state() beside walkers that fall.
#
# Expected: state() of the parallel environment gives the global state for a centralised critic in every step.
# Seen: it works until a walker falls; in that step it raises AttributeError. A trainer that asks for the state after every step stops
# there; one that serves the environment must drop the state, and let the critic see all observations.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check --only-binary=:all: pettingzoo==1.27.0 gymnasium==1.4.0 numpy==2.4.6 pygame==2.6.1 box2d==2.3.10
cat > state.py <<'PYTHON'
import numpy as np
from pettingzoo.sisl import multiwalker_v9

env = multiwalker_v9.parallel_env(terminate_on_fall=False)
env.reset(seed=1)
rng = np.random.default_rng(1)
before = env.state().shape
for step in range(1, 500):
    ends = env.step({agent: rng.uniform(-1, 1, 4).astype(np.float32) for agent in env.agents})[2]
    fell = any(ends.values())
    try:
        env.state()
    except Exception as error:
        print(f"state of {before} before; {type(error).__name__} in the step of the first fall: {fell}")
        break
else:
    print("no error")
PYTHON
SDL_VIDEODRIVER=dummy venv/bin/python -W ignore state.py | grep -E "state|no error" | tee seen
diff seen - <<'SEEN' && echo "as before"
state of (75,) before; AttributeError in the step of the first fall: True
SEEN
