"""Many worlds in arrays."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import magex.envs
import magex_native
from magex.envs import push_ball_v0, simple_spread_v0
from magex_native import _processor


def actions(env, rng):
    heads = 3 if env.task == "drones" else 1
    shape = (env.worlds, env.agents, heads) if heads > 1 else (env.worlds, env.agents)
    return rng.integers(0, 3 if heads > 1 else 5, shape)


@pytest.mark.parametrize("task, agents", [("simple_spread", 5), ("push_ball", 3), ("drones", 2)])
def test_shapes_ends_and_autoreset(task, agents):
    env = magex.envs.vector(task, agents=agents, worlds=18, horizon=7)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    first, infos = env.reset(seed=5)
    assert infos == {} and env.observation_space.contains(first)
    rng = np.random.default_rng(1)
    for episode in range(2):
        for step in range(7):
            given = actions(env, rng)
            assert env.action_space.contains(given)
            seen, rewards, terminations, truncations, infos = env.step(given)
            assert env.observation_space.contains(seen)
            assert rewards.shape == terminations.shape == truncations.shape == (18, agents)
            assert rewards.dtype == np.float32 and terminations.dtype == truncations.dtype == np.bool_
            assert not terminations.any()
            assert (truncations == (step == 6)).all()
            assert bool(infos) == (step == 6)
        assert infos["final_obs"].shape == seen.shape and infos["_final_obs"].all()
        assert {"success_rate", "arrival_step", "reward"} <= set(infos["final_info"])
        assert all(values.shape == (18,) for values in infos["final_info"].values())
        # The next episode has begun: its starts are other ones, and nothing moves yet.
        state = env.state()
        assert (state["velocities"] == 0).all()
        assert not np.array_equal(seen, first) and not np.array_equal(seen, infos["final_obs"])


def test_a_disabled_autoreset_returns_the_last_state_and_waits():
    same = magex.envs.vector("simple_spread", agents=4, worlds=3, horizon=5)
    waits = magex.envs.vector("simple_spread", agents=4, worlds=3, horizon=5, autoreset="disabled")
    assert waits.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    for env in (same, waits):
        env.reset(seed=2)
    for _ in range(5):
        given = np.full((3, 4), 1, np.uint8)
        seen, _, _, _, infos = same.step(given)
        last, _, _, ends, _ = waits.step(given)
    np.testing.assert_array_equal(infos["final_obs"], last)
    assert ends.all()
    with pytest.raises(ValueError, match="step: the episodes are over; call reset first"):
        waits.step(given)
    np.testing.assert_array_equal(waits.reset()[0], seen)


def test_world_w_has_the_seed_plus_w_whatever_the_batch_and_the_threads():
    rng = np.random.default_rng(3)
    given = rng.integers(0, 5, (30, 70, 5))

    def run(worlds, seed, threads, columns):
        env = magex.envs.vector("simple_spread", agents=5, worlds=worlds, threads=threads, horizon=12)
        seen = [env.reset(seed=seed)[0]]
        for step in given:
            seen.append(env.step(step[columns])[0])
        return np.stack(seen)

    whole = run(70, 100, 2, slice(None))
    np.testing.assert_array_equal(whole, run(70, 100, 1, slice(None)))
    np.testing.assert_array_equal(whole[:, 41:44], run(3, 141, 1, slice(41, 44)))
    one = simple_spread_v0.parallel_env(agents=5, horizon=12)
    np.testing.assert_array_equal(whole[0, 9, 2], one.reset(seed=109)[0]["agent_2"])


def test_arrays_are_new_or_the_same_or_the_callers():
    new = magex.envs.vector("simple_spread", agents=3, worlds=2)
    old = magex.envs.vector("simple_spread", agents=3, worlds=2, copy=False)
    zeros = np.zeros((2, 3), np.uint8)
    for env, same in ((new, False), (old, True)):
        env.reset(seed=1)
        a, b = env.step(zeros), env.step(zeros)
        assert (a[0] is b[0]) == same and (a[1] is b[1]) == same
    buffer = np.empty((4, 2, 3, new.width), np.float32)
    for row in buffer:
        assert new.step(zeros, out=row)[0] is row
    with pytest.raises(ValueError, match="observations: has the shape"):
        new.step(zeros, out=buffer[0, :1])
    with pytest.raises(ValueError, match="observations: is not contiguous"):
        new.step(zeros, out=np.empty((2, 3, 2 * new.width), np.float32)[:, :, ::2])
    with pytest.raises(ValueError, match="read-only"):
        new.step(zeros)[3][0, 0] = True


@pytest.mark.parametrize("kind", [np.uint8, np.int32, np.int64, np.uint16, list])
def test_actions_of_any_whole_type(kind):
    env = magex.envs.vector("simple_spread", agents=3, worlds=2)
    env.reset(seed=1)
    given = [[1, 2, 3], [4, 0, 1]]
    env.step(given if kind is list else np.asarray(given, kind))
    velocities = env.state()["velocities"]
    assert velocities[0, 0, 0] > 0 > velocities[0, 1, 0] and velocities[0, 2, 1] > 0 > velocities[1, 0, 1]


def test_refusals_name_the_field():
    make = magex.envs.vector
    for match, arguments in [
        ("task: 'maze' is not a task", {"task": "maze"}),
        ("agents: 0 is out of range", {"agents": 0}),
        ("agents: 2.5 is out of range", {"agents": 2.5}),
        ("worlds: 0 is out of range", {"worlds": 0}),
        ("spawn: .*unknown spawn mode 'circle'", {"spawn": "circle"}),
        ("side: .*do not fit a side of 0.5", {"side": 0.5}),
        ("side: NaN must be a positive", {"side": float("nan")}),
        ("horizon: 0 is not a size", {"horizon": 0}),
        ("reward: 'sum' is not a reward", {"reward": "sum"}),
        ("observation: 'pixels' is not an observation", {"observation": "pixels"}),
        ("neighbours: 65 is out of range", {"neighbours": 65}),
        ("settings.bonus: -1 is out of range", {"settings": {"bonus": -1.0}}),
        ("settings.colour: unknown key", {"settings": {"colour": 1}}),
        ("autoreset: 'next_step' is not a mode", {"autoreset": "next_step"}),
    ]:
        with pytest.raises(ValueError, match=match):
            make(**{"task": "simple_spread", "agents": 5, **arguments})
    env = make("drones", agents=2, worlds=2)
    with pytest.raises(ValueError, match="reset: missing; call reset first"):
        env.step(np.zeros((2, 2, 3), np.uint8))
    env.reset(seed=0)
    for match, given in [
        (r"actions: has the shape \[2, 2\], but \[2, 2, 3\] is needed", np.zeros((2, 2), int)),
        (r"actions\[1\]\[0\]\[2\]: -1 is not an action; use 0 to 2", [[[0] * 3] * 2, [[0, 0, -1], [0] * 3]]),
        ("actions: are of type float64", np.zeros((2, 2, 3))),
    ]:
        with pytest.raises(ValueError, match=match):
            env.step(given)
    for match, options in [
        ("options: goal is unknown", {"goal": [0, 1]}),
        ("goals: has the shape", {"goals": [0, 1, 0]}),
        ("goals: -1 is not a goal", {"goals": [0, -1]}),
        (r"goals\[0\]\[1\]: 2 is not a goal; use an index below 2", {"goals": [0, 2]}),
        ("goals: is of type float64", {"goals": [0.0, 1.0]}),
        ("options: landmarks is missing", {"positions": np.zeros((2, 2, 3))}),
        ("positions: has the shape", {"positions": np.zeros((2, 3)), "landmarks": np.zeros((2, 2, 3))}),
        ("positions.* is not finite", {"positions": np.full((2, 2, 3), np.nan), "landmarks": np.zeros((2, 2, 3))}),
    ]:
        with pytest.raises(ValueError, match=match):
            env.reset(options=options)
    for seed in (-1, 2**64, 1.5, [1, 2]):
        with pytest.raises(ValueError, match="seed: "):
            env.reset(seed=seed)
    with pytest.raises(ValueError, match="seed: .* is too large"):
        env.reset(seed=2**64 - 1)


def test_rewards_without_goals_and_observations_without_numbers():
    env = magex.envs.vector("simple_spread", agents=6, worlds=2, reward="team", observation="none", spawn="lines-2")
    seen, _ = env.reset(seed=1)
    assert seen.shape == (2, 6, 0)
    _, rewards, *_ = env.step(np.zeros((2, 6), np.uint8))
    assert (rewards == rewards[:, :1]).all()
    free = magex.envs.vector("simple_spread", agents=6, worlds=2, settings={"bonus": 0, "distance": 0, "collision": 0})
    free.reset(seed=1)
    assert (free.step(np.ones((2, 6), np.uint8))[1] == 0).all()


def test_the_goal_observation_of_push_ball_is_as_documented():
    agents, k = 6, 4
    env = magex.envs.vector("push_ball", agents=agents, worlds=2, side=4.0, observation="goal", neighbours=k)
    env.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(30):
        seen, *_ = env.step(actions(env, rng))
    state = env.state()
    p, v = state["positions"][1].astype(np.float64), state["velocities"][1].astype(np.float64)

    def length(x):
        return np.sqrt((x * x).sum())

    for i in range(agents):
        ball, landmark = state["goals"][1, i]
        ball += agents
        row = [*(v[i] / 2)]
        for offset, extra in (
            (p[ball] - p[i], v[ball] / 2),
            (state["landmarks"][1, landmark] - p[ball], ()),
        ):
            d = length(offset)
            row += [*(offset / max(d, 0.3)), *(offset / (1 + d)), float(d <= 0.3), *extra]
        others = [j for j in range(2 * agents) if j not in (i, ball) and length(p[j] - p[i]) <= 1.5]
        for j in sorted(others, key=lambda j: length(p[j] - p[i]))[:k]:
            d = length(p[j] - p[i])
            row += [*(p[j] - p[i]), *((v[j] - v[i]) / 2), min(0.2 / d, 2), float(j >= agents)]
        row += [0.0] * (env.width - len(row))
        np.testing.assert_allclose(seen[1, i], row, atol=2e-6)


def test_set_goals_changes_what_is_seen_and_paid():
    env = magex.envs.vector("push_ball", agents=3, worlds=2)
    before, _ = env.reset(seed=4)
    goals = env.state()["goals"]
    after = env.set_goals(goals[:, ::-1])
    assert not np.array_equal(before, after)
    np.testing.assert_array_equal(env.set_goals(goals), before)
    one = push_ball_v0.parallel_env(agents=3)
    one.reset(seed=4, options={"goals": [[0, 2], [1, 1], [2, 0]]})
    assert one.goals().tolist() == [[0, 2], [1, 1], [2, 0]]


def test_a_forked_process_has_threads_of_its_own():
    env = magex.envs.vector("simple_spread", agents=5, worlds=200, threads=2)
    env.reset(seed=1)
    given = np.zeros((200, 5), np.uint8)
    env.step(given)
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        os.write(write, pickle.dumps(env.step(given)[1].sum()))
        os._exit(0)
    os.close(write)
    assert pickle.loads(os.read(read, 4096)) == env.step(given)[1].sum()
    assert os.waitpid(child, 0)[1] == 0


def test_the_wheel_is_for_the_processors_that_it_checks_for(tmp_path):
    assert magex_native.AVX2 and not magex_native.AVX512
    old = tmp_path / "cpuinfo"
    old.write_text("processor\t: 0\nflags\t\t: fpu sse4_2 avx fma movbe abm f16c\n")
    with pytest.raises(ImportError, match="x86-64-v3 .*, and this one lacks avx2, bmi1, bmi2; run it"):
        _processor.check(str(old))
    _processor.check(str(tmp_path / "absent"))


def test_what_is_missing_is_named_with_the_remedy():
    script = """
import sys
sys.modules[{module!r}] = None
try:
    {statement}
except ImportError as error:
    print(error)
"""
    for module, statement, wanted in [
        ("magex_native", "import magex.envs; magex.envs.vector('drones')", "python/native/build DIR && pip install"),
        ("magex_native", "import magex; magex.assign([[0.0]], [[1.0]])", "magex.assign needs the compiled package"),
        ("pettingzoo", "from magex.envs import drones_v0", "pip install pettingzoo"),
        ("gymnasium", "import magex.envs; magex.envs.vector('drones').action_space", "pip install gymnasium"),
    ]:
        code = script.format(module=module, statement=statement)
        run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert wanted in run.stdout and run.stdout.count("\n") == 1, run.stdout
