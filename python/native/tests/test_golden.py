"""The same numbers as the native code: states, rewards and observations, to the bit."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

import magex.envs

GOLDEN = Path(__file__).parent / "golden"
CASES = [line.split() for line in (GOLDEN / "bits.txt").read_text().splitlines()]


@pytest.mark.parametrize("case", CASES, ids=" ".join)
@pytest.mark.parametrize("threads", [1, 2])
def test_positions_and_rewards_have_the_bits_of_native_code(case, threads):
    wanted, task, agents, worlds, seed, episode, reward = case
    agents, worlds, seed, episode = int(agents), int(worlds), int(seed), int(episode)
    env = magex.envs.vector(task, agents=agents, worlds=worlds, reward=reward, threads=threads)
    env.reset(seed=seed)
    for _ in range(episode):
        env.reset()
    heads = 3 if task == "drones" else 1
    world, agent, head = np.ogrid[:worlds, :agents, :heads]
    parts = []
    for step in range(env.horizon):
        # The same formula stands in episode/main.rs.
        actions = (31 * step + 17 * agent + 7 * world + 3 * head) % (3 if task == "drones" else 5)
        last = step + 1 == env.horizon
        if last:
            # The state after the last step is to be read before the next episode begins.
            env._restarts = False
        _, rewards, _, _, _ = env.step(actions if heads > 1 else actions[..., 0])
        parts.append(np.concatenate([env.state()["positions"].reshape(worlds, -1), rewards], axis=1))
    numbers = np.stack(parts, axis=1).astype("<f4")
    assert hashlib.sha256(numbers.tobytes()).hexdigest() == wanted


TRACES = [
    ("spread-landmarks", "simple_spread", "team", "vector"),
    ("spread-goals", "simple_spread", "goals", "vector"),
    ("spread-local", "simple_spread", "goals", "goal"),
    ("push-landmarks", "push_ball", "team", "vector"),
    ("push-goals", "push_ball", "goals", "vector"),
    ("drones-goals", "drones", "goals", "vector"),
    ("drones-local", "drones", "goals", "goal"),
]


def index_of(points: np.ndarray, of: np.ndarray) -> np.ndarray:
    """The index in `of` of each of the points."""
    return (points[:, None] == of[None]).all(axis=2).argmax(axis=1)


@pytest.mark.parametrize("name, task, reward, observation", TRACES)
def test_an_episode_of_the_program_is_replayed_and_seen_alike(name, task, reward, observation):
    trace = np.load(GOLDEN / f"{name}.npz")
    steps, agents = trace["positions"].shape[:2]
    env = magex.envs.vector(task, agents=agents, horizon=steps, reward=reward, observation=observation)
    bodies = [trace["positions"]]
    goals = index_of(trace["goals"][0], trace["landmarks"][0])[:, None]
    if task == "push_ball":
        bodies.append(trace["all_balls"])
        goals = np.concatenate([index_of(trace["balls"][0], trace["all_balls"][0])[:, None], goals], axis=1)
    bodies = np.concatenate(bodies, axis=1)
    start = {"positions": bodies[:1], "landmarks": trace["landmarks"][:1], "goals": goals[None]}
    seen, _ = env.reset(options=start)
    if observation == "vector":
        wanted = trace["seen_vectors"]
    else:
        wanted = np.concatenate([trace["seen_goals"], trace["seen_neighbours"].reshape(steps, agents, -1)], axis=2)
    for step in range(steps):
        np.testing.assert_array_equal(env.state()["positions"][0], bodies[step])
        np.testing.assert_array_equal(env.state()["velocities"][0, :agents], trace["velocities"][step])
        np.testing.assert_array_equal(seen[0], wanted[step], err_msg=f"step {step}")
        seen, *_ = env.step(trace["actions"][step][None] if task == "drones" else trace["actions"][step, :, 0][None])
