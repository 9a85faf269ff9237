"""PettingZoo's own tests, and what they do not look at."""

from __future__ import annotations

import numpy as np
import pytest
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test
from pettingzoo.utils.conversions import parallel_to_aec

from magex.envs import drones_v0, push_ball_v0, simple_spread_v0

CASES = [
    (simple_spread_v0, {"agents": 5}),
    (simple_spread_v0, {"agents": 3, "reward": "team", "spawn": "uniform", "horizon": 25}),
    (simple_spread_v0, {"agents": 20, "spawn": "lines", "observation": "goal"}),
    (push_ball_v0, {"agents": 5}),
    (push_ball_v0, {"agents": 3, "observation": "goal", "reward": "team"}),
    (drones_v0, {"agents": 2}),
    (drones_v0, {"agents": 4, "observation": "goal", "neighbours": 2}),
]


@pytest.mark.parametrize("module, arguments", CASES)
def test_the_apis_are_those_of_pettingzoo(module, arguments):
    def make():
        return module.parallel_env(**arguments)

    parallel_api_test(make(), num_cycles=300)
    api_test(parallel_to_aec(make()), num_cycles=300)
    api_test(module.env(**arguments), num_cycles=100)
    parallel_seed_test(make, num_cycles=150)


@pytest.mark.parametrize("module, arguments", CASES)
def test_every_step_is_within_the_spaces(module, arguments):
    env = module.parallel_env(**arguments)
    assert env.observation_space("agent_0") is env.observation_space("agent_1")
    for seed in (3, None):
        observations, infos = env.reset(seed=seed)
        env.action_space("agent_0").seed(1)
        steps = 0
        while env.agents:
            assert env.state_space.contains(env.state())
            given = {agent: env.action_space(agent).sample() for agent in env.agents}
            acting = list(env.agents)
            observations, rewards, terminations, truncations, infos = env.step(given)
            steps += 1
            for agent in acting:
                assert env.observation_space(agent).contains(observations[agent])
                assert type(rewards[agent]) is float and np.isfinite(rewards[agent])
            assert not any(terminations.values())
            assert len(set(truncations.values())) == 1
            assert list(observations) == list(rewards) == list(infos) == acting
        assert steps == env.max_cycles and all(truncations.values())
        score = infos["agent_0"]["episode"]
        assert 0.0 <= score["success_rate"] <= 1.0
        assert infos["agent_0"]["is_success"] == (score["all_covered_rate"] == 1.0)
        assert env.step({}) == ({}, {}, {}, {}, {})


def test_goals_are_the_callers_or_the_nearest():
    env = simple_spread_v0.parallel_env(agents=5)
    env.reset(seed=1)
    assert sorted(env.goals()) == list(range(5))
    env.reset(seed=1, options={"goals": [4, 3, 2, 1, 0]})
    assert env.goals().tolist() == [4, 3, 2, 1, 0]
    env.set_goals([0, 0, 0, 0, 0])
    assert env.goals().tolist() == [0] * 5
    with pytest.raises(ValueError, match="goals.*5 is not a goal"):
        env.set_goals([0, 1, 2, 3, 5])


def test_a_missing_action_is_named():
    env = simple_spread_v0.parallel_env(agents=3)
    env.reset(seed=1)
    with pytest.raises(ValueError, match="actions: agent_2 is missing"):
        env.step({"agent_0": 0, "agent_1": 0})
    with pytest.raises(ValueError, match=r"actions\[0\]\[1\]: 7 is not an action; use 0 to 4"):
        env.step({"agent_0": 0, "agent_1": 7, "agent_2": 0})


@pytest.mark.parametrize("module, agents", [(simple_spread_v0, 5), (push_ball_v0, 5), (drones_v0, 2)])
def test_pictures(module, agents):
    env = module.parallel_env(agents=agents, render_mode="rgb_array")
    env.reset(seed=2)
    picture = env.render()
    assert picture.shape == (512, 512, 3) and picture.dtype == np.uint8
    blue = np.abs(picture.astype(int) - (1, 115, 178)).sum(axis=2) < 9
    assert blue.sum() > 20 * agents
    assert module.parallel_env(agents=agents).render() is None
    with pytest.raises(ValueError, match="render_mode: 'human'"):
        module.parallel_env(render_mode="human")
