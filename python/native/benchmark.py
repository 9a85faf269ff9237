"""Joint steps per second of Simple Spread with N = 5 and 50 agents, random actions: magex, JaxMARL and VMAS in turn.

python python/native/benchmark.py [--rounds 3] [--seconds 3] [--jaxmarl PYTHON] [--vmas PYTHON]

Every library runs in a process of its own, with all cores, one after another, several rounds; the best number of worlds counts,
and of the rounds the median. A step hands observations, rewards and ends to NumPy; the second row leaves the observations
out where the library can (VMAS cannot). `--jaxmarl` and `--vmas` name interpreters that have these packages (the versions measured:
jaxmarl 0.2.0 with jax 0.10.2, vmas 1.5.2 with torch 2.15.0); without them this interpreter is asked.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable

WORLDS = {
    "magex": {5: (256, 1024, 4096), 50: (32, 64, 256)},
    "jaxmarl": {5: (256, 1024, 4096), 50: (4, 16, 64)},
    "vmas": {5: (1024, 4096, 16384), 50: (256, 1024)},
}
#: Seconds that one size may take before larger ones are left out.
PATIENCE = 60.0


def measure(steps: Callable[[], int], seconds: float) -> float:
    """The rate of a function that makes some joint steps and returns how many: its fastest call, after one to warm up."""
    steps()
    best, start = 0.0, time.perf_counter()
    while True:
        begun = time.perf_counter()
        done = steps()
        now = time.perf_counter()
        best = max(best, done / (now - begun))
        if now - start >= seconds:
            return best


def magex(agents: int, worlds: int, observed: bool, seconds: float, reward: str = "team") -> float:
    import numpy as np

    import magex.envs

    observation = "vector" if observed else "none"
    env = magex.envs.vector(
        "simple_spread", agents=agents, worlds=worlds, reward=reward, observation=observation, horizon=25, copy=False
    )
    env.reset(seed=0)
    actions = np.random.default_rng(0).integers(0, 5, (25, worlds, agents)).astype(np.uint8)

    def episode() -> int:
        for given in actions:
            env.step(given)
        return 25 * worlds

    return measure(episode, seconds)


def magex_goals(agents: int, worlds: int, observed: bool, seconds: float) -> float:
    return magex(agents, worlds, observed, seconds, "goals")


def jaxmarl(agents: int, worlds: int, observed: bool, seconds: float) -> float:
    import jax
    import jax.numpy as jnp
    import numpy as np
    from jaxmarl import make

    env = make("MPE_simple_spread_v3", num_agents=agents, num_landmarks=agents)

    def step(carry, _):
        key, state = carry
        key, for_actions, for_steps = jax.random.split(key, 3)
        drawn = jax.random.randint(for_actions, (worlds, agents), 0, 5)
        given = {name: drawn[:, i] for i, name in enumerate(env.agents)}
        seen, state, rewards, ends, _ = jax.vmap(env.step)(jax.random.split(for_steps, worlds), state, given)
        out = (jnp.stack([rewards[name] for name in env.agents], 1), ends["__all__"])
        if observed:
            out += (jnp.stack([seen[name] for name in env.agents], 1),)
        return (key, state), out

    scan = jax.jit(lambda carry: jax.lax.scan(step, carry, None, 25))
    key = jax.random.PRNGKey(0)
    carry = [(key, jax.vmap(env.reset)(jax.random.split(key, worlds))[1])]

    def episode() -> int:
        carry[0], out = scan(carry[0])
        for array in out:
            np.asarray(array)
        return 25 * worlds

    return measure(episode, seconds)


def vmas(agents: int, worlds: int, observed: bool, seconds: float) -> float:
    import numpy as np
    import torch
    from vmas import make_env

    env = make_env("simple_spread", num_envs=worlds, device="cpu", continuous_actions=False, seed=0, n_agents=agents)
    env.reset()

    def steps() -> int:
        for _ in range(5):
            seen, rewards, ends, _ = env.step([torch.randint(0, 5, (worlds,)) for _ in range(agents)])
            if observed:
                np.stack([array.numpy() for array in seen], 1)
            np.stack([array.numpy() for array in rewards], 1), ends.numpy()
        return 5 * worlds

    return measure(steps, seconds)


def one(library: str, agents: int, seconds: float) -> None:
    """Prints the best rates with and without observations, as JSON."""
    run = {"magex": magex, "magex, goals": magex_goals, "jaxmarl": jaxmarl, "vmas": vmas}[library]
    best: dict[str, list] = {}
    for observed in (True, False):
        start = time.perf_counter()
        for worlds in WORLDS[library.split(",")[0]][agents]:
            rate = run(agents, worlds, observed, seconds)
            if rate > best.get(str(observed), [0])[0]:
                best[str(observed)] = [rate, worlds]
            if time.perf_counter() - start > PATIENCE:
                break
    print(json.dumps(best))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=3.0, help="of every number of worlds")
    parser.add_argument("--jaxmarl", default=sys.executable, metavar="PYTHON")
    parser.add_argument("--vmas", default=sys.executable, metavar="PYTHON")
    parser.add_argument("--only", nargs=2, metavar=("LIBRARY", "AGENTS"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only:
        one(options.only[0], int(options.only[1]), options.seconds)
        return
    interpreters = {
        "magex": sys.executable,
        "magex, goals": sys.executable,
        "jaxmarl": options.jaxmarl,
        "vmas": options.vmas,
    }
    found: dict[tuple[str, int, str], list] = {}
    for _ in range(options.rounds):
        for agents in (5, 50):
            for library, python in interpreters.items():
                command = [python, __file__, "--only", library, str(agents), "--seconds", str(options.seconds)]
                run = subprocess.run(command, check=False, capture_output=True, text=True)
                if run.returncode != 0:
                    print(f"{library}: not measured: {run.stderr.strip().splitlines()[-1:]}", file=sys.stderr)
                    continue
                for observed, best in json.loads(run.stdout.strip().splitlines()[-1]).items():
                    found.setdefault((library, agents, observed), []).append(best)
    print("| N | observations | library | joint steps/s (lowest, highest) | worlds | magex over it |")
    print("|---|---|---|---|---|---|")
    for agents in (5, 50):
        for observed in ("True", "False"):
            rates = {}
            for library in interpreters:
                if rounds := found.get((library, agents, observed)):
                    rates[library] = statistics.median(rate for rate, _ in rounds)
            for library, rate in rates.items():
                rounds = sorted(found[(library, agents, observed)])
                ratio = f"{rates['magex'] / rate:.1f}" if "magex" in rates else ""
                span = f"{rate:,.0f} ({rounds[0][0]:,.0f}, {rounds[-1][0]:,.0f})"
                print(f"| {agents} | {'yes' if observed == 'True' else 'no'} | {library} | {span} | {rounds[-1][1]} | {ratio} |")
            others = [rate for library, rate in rates.items() if not library.startswith("magex")]
            if others and "magex" in rates:
                bar = {5: 4, 50: 10}[agents]
                print(
                    f"N = {agents}: {rates['magex'] / max(others):.1f} times the better of the others (bar {bar})",
                    file=sys.stderr,
                )


if __name__ == "__main__":
    main()
