"""Observations as rows, rows as actions, masks and padding."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conftest import refused
from environments import Line
from gymnasium import spaces
from gymnasium.spaces.utils import flatdim, flatten

from magex._observations import ObservationCodec, Unfit
from magex._problems import Refused

BOX = spaces.Box(-1, 1, (2, 3), np.float64)
EVERY = spaces.Dict(
    {
        "zebra": spaces.Tuple((spaces.Discrete(3, start=-1), spaces.MultiBinary((2, 2)))),
        "ant": BOX,
        "many": spaces.MultiDiscrete([2, 3], start=[5, 1]),
    }
)


@pytest.mark.parametrize("space", [BOX, spaces.Discrete(4, start=2), EVERY, spaces.Tuple((EVERY, BOX)), spaces.MultiBinary(3)])
def test_the_order_is_that_of_gymnasium(space: spaces.Space) -> None:
    codec = ObservationCodec(space, "a")
    assert codec.width == flatdim(space)
    space.seed(3)
    for _ in range(5):
        value = space.sample()
        row = np.zeros(codec.width)
        codec.write(value, row)
        np.testing.assert_array_equal(row, flatten(space, value))


@pytest.mark.parametrize(
    ("space", "value", "said"),
    [
        (BOX, np.zeros((3, 2)), "observation: expected shape (2, 3), seen shape (3, 2)"),
        (spaces.Discrete(3, start=2), 5, "observation: expected an integer from 2 to 4, seen 5"),
        (spaces.Discrete(3), 1.5, "observation: expected an integer from 0 to 2, seen 1.5"),
        (spaces.Discrete(3), None, "observation: expected an integer from 0 to 2, seen None"),
        (
            spaces.MultiDiscrete([2, 2]),
            np.array([0, 2]),
            "observation: expected an array of integers of shape (2,), from [0, 0] and below [2, 2]",
        ),
        (spaces.Dict(a=BOX), {"b": 1}, "observation['a']: expected a dict with this part, seen {'b': 1}"),
        (spaces.Tuple((BOX,)), (), "observation[0]: expected a tuple with this part, seen ()"),
    ],
)
def test_what_does_not_fit_is_named(space: spaces.Space, value: Any, said: str) -> None:
    codec = ObservationCodec(space, "a")
    with pytest.raises(Unfit) as error:
        codec.write(value, np.zeros(codec.width))
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("space", "said"),
    [
        (spaces.Text(5), 'observation_space of agent "a": Text has no fixed number of numbers; use Box'),
        (spaces.Box(0, 1, (0,)), 'observation_space of agent "a": has no numbers'),
        (spaces.Dict(action_mask=BOX), 'has the key "action_mask" but not "observation"'),
        (spaces.Dict(action_mask=BOX, observation=BOX, map=BOX), 'keys "map" beside "observation" and "action_mask"'),
    ],
)
def test_spaces_that_are_refused(space: spaces.Space, said: str) -> None:
    with pytest.raises(Refused) as error:
        ObservationCodec(space, "a")
    assert said in str(error.value)


class Spaces(Line):
    """Any spaces; keeps the actions that it is given."""

    given: dict[str, Any] = {}

    def __init__(self, views: Any = None, choices: Any = None, agents: int = 2) -> None:
        super().__init__(agents)
        self.views, self.choices = views, choices

    def observation_space(self, agent: str) -> Any:
        return self.views[self.possible_agents.index(agent)] if self.views else self.view

    def action_space(self, agent: str) -> Any:
        return self.choices[self.possible_agents.index(agent)] if self.choices else self.choice

    def observe(self, agent: str) -> Any:
        if not self.views:
            return super().observe(agent)
        return np.full(self.observation_space(agent).shape, 1 + self.possible_agents.index(agent), np.float32)

    def step(self, actions: dict) -> tuple:
        Spaces.given = dict(actions)
        return super().step(dict.fromkeys(actions, 1))


def test_discrete_actions_begin_where_the_space_says(run) -> None:
    stream = run(lambda: Spaces(choices=[spaces.Discrete(3, start=-1)] * 2))
    stream.reset(1)
    stream.step(np.array([[[0], [2]]]))
    assert Spaces.given == {"agent_0": -1, "agent_1": 1}


def test_several_components(run) -> None:
    stream = run(lambda: Spaces(choices=[spaces.MultiDiscrete([3, 4], start=[10, 0])] * 2))
    assert list(stream.description.discrete.choices) == [3, 4]
    stream.reset(1)
    stream.step(np.array([[[0, 3], [2, 1]]]))
    np.testing.assert_array_equal(Spaces.given["agent_0"], [10, 3])
    np.testing.assert_array_equal(Spaces.given["agent_1"], [12, 1])
    assert spaces.MultiDiscrete([3, 4], start=[10, 0]).contains(Spaces.given["agent_0"])
    assert 'agent "agent_1", number 0: expected a choice below 3, seen 3' in stream.step(np.array([[[2, 3], [3, 3]]])).message


def test_bits(run) -> None:
    space = spaces.MultiBinary((2, 2))
    stream = run(lambda: Spaces(choices=[space] * 2))
    assert list(stream.description.discrete.choices) == [2, 2, 2, 2]
    stream.reset(1)
    stream.step(np.array([[[0, 1, 1, 0]] * 2]))
    np.testing.assert_array_equal(Spaces.given["agent_0"], [[0, 1], [1, 0]])
    assert space.contains(Spaces.given["agent_0"])


def test_continuous_actions(run) -> None:
    space = spaces.Box(np.array([[-1.0, 0.0]]), np.array([[1.0, 0.1]]), dtype=np.float64)
    stream = run(lambda: Spaces(choices=[space] * 2))
    description = stream.description
    assert list(description.continuous.low) == [-1, 0] and np.allclose(description.continuous.high, [1, 0.1])
    stream.reset(1)
    # The binary32 that is nearest to 0.1 lies above it.
    stream.step(np.array([[[0.5, 0.1], [9.0, -1.0]]]))
    np.testing.assert_array_equal(Spaces.given["agent_0"], [[0.5, 0.1]])
    np.testing.assert_array_equal(Spaces.given["agent_1"], [[1.0, 0.0]])
    assert space.contains(Spaces.given["agent_0"]) and space.contains(Spaces.given["agent_1"])
    problem = stream.step(np.array([[[0.5, 0.1], [np.nan, 0.0]]]))
    assert problem.message == 'actions: world 0, agent "agent_1", number 0: expected a finite number, seen nan'


@pytest.mark.parametrize(
    ("choices", "said"),
    [
        ([spaces.Discrete(257)] * 2, "257 choices in one component, and at most 256 are possible; split it"),
        ([spaces.MultiDiscrete([[2, 2]])] * 2, "MultiDiscrete of shape (1, 2); give it one axis"),
        ([spaces.Box(0, 5, (1,), np.int32)] * 2, "Box of int32; use MultiDiscrete for whole numbers"),
        ([spaces.Box(0, np.inf, (2,))] * 2, "number 0 has one bound, 0.0 to inf; give both or none"),
        (
            [spaces.Box(np.zeros(2), np.array([1.0, 0.0]), dtype=np.float64)] * 2,
            "number 1 lies between 0.0 and 0.0; leave it out",
        ),
        ([spaces.Tuple((spaces.Discrete(2),))] * 2, "Tuple is not supported; use Discrete, MultiDiscrete, MultiBinary or Box"),
        (
            [spaces.Discrete(2), spaces.Box(-1, 1, (1,))],
            'agent "agent_0" has Discrete(2) and agent "agent_1" Box(-1.0, 1.0, (1,), float32); discrete and continuous',
        ),
        (
            [spaces.Discrete(2), spaces.Discrete(3)],
            'action_space: agent "agent_0" has Discrete(2) and agent "agent_1" Discrete(3); make them equal, or',
        ),
        (
            [spaces.Box(-1, 1, (1,)), spaces.Box(-2, 2, (1,))],
            'action_space: agent "agent_0" has Box(-1.0, 1.0, (1,), float32) and agent "agent_1" Box(-2.0, 2.0, (1,), float32)',
        ),
    ],
)
def test_actions_that_are_refused(served, choices: list, said: str) -> None:
    assert said in refused(served(lambda: Spaces(choices=choices)))


def test_observations_of_different_sizes(served, run) -> None:
    views = [spaces.Box(-9, 9, (4,)), spaces.Box(-9, 9, (1, 2))]
    said = refused(served(lambda: Spaces(views)))
    assert said.startswith(
        'observation_space: agent "agent_0" has Box(-9.0, 9.0, (4,), float32) and agent "agent_1" Box(-9.0, 9.0, (1, 2), float32)'
    )
    stream = run(lambda: Spaces(views), pad=True)
    assert stream.description.observation_width == 4 and list(stream.description.observation_widths) == [4, 2]
    assert stream.reset(1).observations[0].tolist() == [[1, 1, 1, 1], [2, 2, 0, 0]]
    assert stream.step().observations[0].tolist() == [[1, 1, 1, 1], [2, 2, 0, 0]]


def test_bounds_of_observations_may_differ(run) -> None:
    assert run(lambda: Spaces([spaces.Box(-9, 9, (2,)), spaces.Box(-5, 5, (2,))])).description.observation_width == 2


def test_padded_choices_are_masked(run) -> None:
    choices = [spaces.Discrete(3), spaces.MultiDiscrete([2, 4])]
    stream = run(lambda: Spaces(choices=choices), pad=True)
    assert list(stream.description.discrete.choices) == [3, 4] and stream.description.masks
    first = stream.reset(1)
    assert first.masks[0].tolist() == [[1, 1, 1, 1, 0, 0, 0], [1, 1, 0, 1, 1, 1, 1]]
    stream.step(np.array([[[2, 0], [1, 3]]]))
    assert Spaces.given["agent_0"] == 2 and Spaces.given["agent_1"].tolist() == [1, 3]
    assert "expected a choice below 1, seen 1" in stream.step(np.array([[[2, 1], [1, 3]]])).message


def test_a_component_of_one_choice_is_masked(run) -> None:
    stream = run(lambda: Spaces(choices=[spaces.Discrete(1)] * 2))
    assert list(stream.description.discrete.choices) == [2] and stream.reset(1).masks[0].tolist() == [[1, 0]] * 2


def test_padded_numbers_are_ignored(run) -> None:
    choices = [spaces.Box(-1, 1, (2,)), spaces.Box(-3, 0, (1,))]
    stream = run(lambda: Spaces(choices=choices), pad=True)
    assert list(stream.description.continuous.low) == [-3, -1] and list(stream.description.continuous.high) == [1, 1]
    stream.reset(1)
    stream.step(np.array([[[-2, 0.5], [-2, 0.5]]]))
    assert Spaces.given["agent_0"].tolist() == [-1, 0.5] and Spaces.given["agent_1"].tolist() == [-2]


class Masked(Line):
    """What is allowed next, in infos or in observations."""

    def __init__(self, where: str) -> None:
        super().__init__(2)
        self.where = where
        if where == "observation":
            self.view = spaces.Dict(observation=self.view, action_mask=spaces.MultiBinary(3))

    def mask(self, agent: str) -> np.ndarray:
        return np.array([1, self.steps % 2, self.steps != 3], np.int8)

    def observe(self, agent: str) -> Any:
        seen = super().observe(agent)
        return {"observation": seen, "action_mask": self.mask(agent)} if self.where == "observation" else seen

    def info(self, agent: str) -> dict:
        return {"action_mask": self.mask(agent)} if self.where == "infos" else {}


@pytest.mark.parametrize("where", ["observation", "infos"])
def test_masks(run, where: str) -> None:
    stream = run(lambda: Masked(where))
    description = stream.description
    assert description.masks and description.observation_width == 2 and list(description.discrete.choices) == [3]
    assert stream.reset(1, 2).masks.tolist() == [[[1, 0, 1]] * 2] * 2
    assert stream.step(0).masks.tolist() == [[[1, 1, 1]] * 2] * 2
    assert stream.step(0).masks.tolist() == [[[1, 0, 1]] * 2] * 2
    assert stream.step(0, restarts={1: 4}).masks.tolist() == [[[1, 1, 0]] * 2, [[1, 0, 1]] * 2]


def test_an_agent_that_does_not_act_may_do_nothing(run) -> None:
    class Leaves(Masked):
        def __init__(self) -> None:
            super().__init__("infos")
            self.leaves = {"agent_1": 1}

    stream = run(Leaves)
    stream.reset(1)
    assert stream.step(0).masks.tolist() == [[[1, 1, 1], [0, 0, 0]]]


class Nothing(Masked):
    armed: Any = None

    def mask(self, agent: str) -> Any:
        right = self.armed is None or self.steps == 0 or agent == "agent_0"
        return super().mask(agent) if right else self.armed

    def info(self, agent: str) -> dict:
        info = super().info(agent)
        return {} if info and isinstance(info["action_mask"], str) else info


@pytest.mark.parametrize("where", ["observation", "infos"])
@pytest.mark.parametrize(
    ("mask", "said"),
    [
        (np.zeros(3, np.int8), "action_mask: expected one allowed choice at least in every component, seen none"),
        (np.ones(4, np.int8), "action_mask: expected shape (3,), seen shape (4,)"),
        ("absent", "action_mask"),
    ],
)
def test_masks_that_cannot_be(run, monkeypatch, where: str, mask: Any, said: str) -> None:
    stream = run(lambda: Nothing(where))
    monkeypatch.setattr(Nothing, "armed", mask)
    stream.reset(1)
    problem = stream.step(0)
    assert 'world 0, agent "agent_1", ' in problem.message and said in problem.message


def test_masks_of_several_components(run) -> None:
    class Parts(Line):
        def __init__(self) -> None:
            super().__init__(1)
            self.choice = spaces.MultiDiscrete([2, 3])

        def info(self, agent: str) -> dict:
            return {"action_mask": (np.array([1, 0], np.int8), np.array([0, 1, 1], np.int8))}

        def step(self, actions: dict) -> tuple:
            return super().step(dict.fromkeys(actions, 1))

    stream = run(Parts)
    assert stream.reset(1).masks.tolist() == [[[1, 0, 0, 1, 1]]]


def test_masks_need_choices(served) -> None:
    class Both(Masked):
        choice = None

        def action_space(self, agent: str) -> Any:
            return spaces.Box(-1, 1, (1,))

    assert "action_mask: the actions are continuous" in refused(served(lambda: Both("observation")))
