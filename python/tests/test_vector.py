"""Worlds in arrays."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from conftest import refused
from environments import Alone, Many, vector
from gymnasium import spaces

import magex
from magex._wire import environment_pb2 as pb


def test_uniform_depends_on_seed_and_draw_alone() -> None:
    one = magex.uniform(np.array([3, 4, 5]), 2, 4, 2)
    assert one.shape == (3, 4, 2) and (one >= 0).all() and (one < 1).all()
    np.testing.assert_array_equal(magex.uniform(np.array([5, 3]), 2, 4, 2), one[[2, 0]])
    np.testing.assert_array_equal(magex.uniform(np.array([5, 3]), np.array([2, 2]), 4, 2), one[[2, 0]])
    assert not np.isin(magex.uniform(np.array([3, 4, 5]), 3, 4, 2), one).any()
    many = magex.uniform(np.arange(1000), 0, 100)
    assert abs(many.mean() - 0.5) < 0.005 and abs(np.corrcoef(many[:-1].ravel(), many[1:].ravel())[0, 1]) < 0.01


def test_steps_and_restarts(run) -> None:
    stream = run(Many)
    description = stream.description
    assert description.name == "Many" and description.steps_max == 6 and description.state_width == 2
    assert description.deterministic and description.successes
    first = stream.reset(1, 2, 3)
    assert first.observations.shape == (3, 2, 2) and first.active == [[1, 1]] * 3
    second = stream.step(np.array([[[2], [1]], [[0], [0]], [[1], [1]]]))
    np.testing.assert_allclose(second.observations[:, :, 0] - first.observations[:, :, 0], [[1, 0], [-1, -1], [0, 0]], atol=1e-6)
    np.testing.assert_allclose(second.states, second.observations[:, :, 0], atol=1e-6)
    mixed = stream.step(2, restarts={1: 3})
    np.testing.assert_array_equal(mixed.observations[1], first.observations[2])
    assert mixed.rewards[1].tolist() == [0, 0] and mixed.observations[2, 0, 1] == 2
    for _ in range(3):
        stream.step(0)
    end = stream.step(0)
    assert end.truncated == [[1, 1], [0, 0], [1, 1]] and end.active == [[0, 0], [1, 1], [0, 0]]
    assert end.successes == [0, 0, 0]
    waits = stream.step(restarts={2: 1})
    assert waits.active == [[0, 0], [1, 1], [1, 1]] and waits.truncated[0] == [0, 0] and not waits.observations[0].any()
    assert not waits.states[0].any() and waits.states[2].any()
    np.testing.assert_array_equal(waits.observations[2], first.observations[0])


def test_successes(run) -> None:
    stream = run(Many)
    stream.reset(1, 2)
    for _ in range(6):
        end = stream.step(np.array([[[2], [2]], [[0], [0]]]))
    assert end.successes == [1, 0]


def test_an_agent_that_ends_first(run) -> None:
    class Early(Many):
        def step(self, actions: np.ndarray) -> tuple:
            view, rewards, terminated, truncated = super().step(actions)
            ended = np.zeros((len(self.steps), 2), bool)
            ended[:, 1] = self.steps == 2
            return np.where(self.steps[:, None, None] == 4, np.nan if self.armed else 0, view), rewards, ended, truncated

        armed = False

    stream = run(Early)
    stream.reset(1)
    stream.step()
    two = stream.step()
    assert two.terminated == [[0, 1]] and two.active == [[1, 0]] and two.observations[0, 1, 1] == 2
    three = stream.step()
    assert three.terminated == [[0, 0]] and three.active == [[1, 0]] and not three.observations[0, 1].any()
    Early.armed = True
    assert 'world 0, agent "left", observation number 0' in stream.step().message


class Broken(Many):
    """One return value of step is replaced."""

    field, value = -1, None

    def step(self, actions: np.ndarray) -> Any:
        result = list(super().step(actions))
        if self.field == 9:
            raise KeyError("wheel")
        if self.field == 5:
            return result[:3]
        if self.field >= 0:
            result[self.field] = self.value
        return tuple(result)


@pytest.mark.parametrize(
    ("field", "value", "kind", "said"),
    [
        (
            0,
            np.zeros((2, 2)),
            pb.ENVIRONMENT_PROBLEM_KIND_BROKE_ITS_WORD,
            "observations of step: expected numbers of shape (1, 2, 2), seen float64 of shape (2, 2)",
        ),
        (0, None, pb.ENVIRONMENT_PROBLEM_KIND_BROKE_ITS_WORD, "seen object of shape ()"),
        (
            0,
            np.full((1, 2, 2), np.nan),
            pb.ENVIRONMENT_PROBLEM_KIND_BROKE_ITS_WORD,
            'world 0, agent "left", observation number 0: expected a finite number, seen nan',
        ),
        (
            1,
            np.zeros((1, 3)),
            pb.ENVIRONMENT_PROBLEM_KIND_BROKE_ITS_WORD,
            "rewards: expected numbers of shape (1, 2), seen float64 of shape (1, 3)",
        ),
        (2, np.full((1, 2), 0.5), pb.ENVIRONMENT_PROBLEM_KIND_BROKE_ITS_WORD, "terminated: expected True or False, seen float64"),
        (5, None, pb.ENVIRONMENT_PROBLEM_KIND_BROKE_ITS_WORD, "step: expected (observations, rewards, terminated, truncated)"),
        (9, None, pb.ENVIRONMENT_PROBLEM_KIND_RAISED, "step: KeyError: 'wheel' ("),
    ],
)
def test_what_breaks_its_word_is_named(run, monkeypatch, field: int, value: Any, kind: int, said: str) -> None:
    stream = run(Broken)
    stream.reset(1)
    monkeypatch.setattr(Broken, "field", field)
    monkeypatch.setattr(Broken, "value", value)
    problem = stream.step()
    assert problem.kind == kind and said in problem.message
    monkeypatch.setattr(Broken, "field", -1)
    assert stream.reset(1).active == [[1, 1]] and stream.step().active == [[1, 1]]


def test_masks(run) -> None:
    class Masks(Many):
        def masks(self) -> np.ndarray:
            return np.stack([np.stack([self.steps % 2, self.steps >= 0, self.steps < 9], axis=1)] * 2, axis=1)

    stream = run(Masks)
    assert stream.description.masks
    assert stream.reset(1, 2).masks.tolist() == [[[0, 1, 1]] * 2] * 2
    assert stream.step(restarts={1: 1}).masks.tolist() == [[[1, 1, 1]] * 2, [[0, 1, 1]] * 2]


def test_world_0_that_draws_for_all_is_found_out(run) -> None:
    class Together(Many):
        """One generator for all worlds: an episode depends on its index."""

        def reset(self, worlds: int, seeds: np.ndarray) -> np.ndarray:
            self.rng = np.random.default_rng(int(seeds[0]))
            super().reset(worlds, seeds)
            self.place = self.rng.random((worlds, 2))
            return self.view()

    assert not run(Together).description.deterministic


def test_a_picture(run) -> None:
    class Drawn(Many):
        def render(self, world: int) -> np.ndarray:
            return np.full((2, 2, 3), world, np.uint8)

    stream = run(Drawn)
    stream.reset(1, 2)
    assert stream.description.renders and stream.render(1).png != stream.render(0).png


def test_gymnasium_vectors(run) -> None:
    stream = run(vector)
    description = stream.description
    assert description.observation_width == 4 and list(description.agents) == ["agent_0"] and description.worlds_max == 0
    assert description.deterministic and description.successes
    single = run(Alone)
    for one in (stream, single):
        one.reset(1, 2)
    for step in range(30):
        restarts = {1: 7} if step == 2 else {step % 2: step} if step % 4 == 3 else {}
        a, b = stream.step(step % 2, restarts=restarts), single.step(step % 2, restarts=restarts)
        assert a.message == b.message
    # Another number of worlds is another vector environment.
    assert stream.reset(1, 2, 3).observations.shape == (3, 1, 4)


def test_a_gymnasium_vector_of_fixed_size(run) -> None:
    stream = run(lambda: vector(3))
    assert stream.description.worlds_max == 3
    assert "at most 3" in stream.reset(1, 2, 3, 4).message
    first = stream.reset(5)
    for _ in range(12):
        stream.step()
    np.testing.assert_array_equal(stream.step(restarts={0: 5}).observations, first.observations)
    assert stream.step().active == [[1]]


def test_gymnasium_vectors_that_begin_by_themselves(served) -> None:
    said = refused(served(lambda: gymnasium.vector.SyncVectorEnv([Alone])))
    assert said.startswith("autoreset_mode: SyncVectorEnv has NEXT_STEP") and "AutoresetMode.DISABLED" in said


def test_spaces_of_vectors(served) -> None:
    class Parts(Many):
        observation_space = spaces.Dict(a=spaces.Discrete(2))

    class Sizes(Many):
        observation_space = {"left": spaces.Box(-9, 9, (2,)), "right": spaces.Box(-9, 9, (1,))}

    class Without(Many):
        observation_space = None

    assert "a vector environment needs a Box" in refused(served(Parts))
    assert 'observation_space: agent "left" has' in refused(served(Sizes))
    assert "observation_space: missing" in refused(served(Without))


def test_agents_of_different_sizes(run) -> None:
    class Sizes(Many):
        observation_space = {"left": spaces.Box(-9, 9, (2,)), "right": spaces.Box(-9, 9, (1,))}

    stream = run(Sizes, pad=True)
    assert list(stream.description.observation_widths) == [2, 1]
    stream.reset(1)
    seen = stream.step().observations[0]
    assert seen[0].all() and seen[1, 0] != 0 and seen[1, 1] == 0
