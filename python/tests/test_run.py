"""Resets, steps, ends and problems of worlds that are objects."""

from __future__ import annotations

import math
import threading
import time

import grpc
import numpy as np
import pytest
from conftest import Run, refused
from environments import Alone, Line

from magex._wire import environment_pb2 as pb


def test_describes_itself(run) -> None:
    description = run(Line).description
    assert description.name == "line"
    assert list(description.agents) == ["agent_0", "agent_1", "agent_2"]
    assert description.observation_width == 2 and list(description.observation_widths) == [2, 2, 2]
    assert list(description.discrete.choices) == [3]
    assert description.steps_max == 10 and description.deterministic
    assert not description.masks and not description.renders and not description.successes
    assert description.state_width == 0 and description.worlds_max == 0


def test_refuses_another_protocol(served) -> None:
    with pytest.raises(grpc.RpcError) as error:
        served(Line).Describe(pb.DescribeRequest(protocol=2))
    assert "protocol: 2; this environment speaks 1" in error.value.details()


def test_steps_every_world(run) -> None:
    stream = run(Line)
    first = stream.reset(5, 6)
    assert first.observations.dtype == np.float32 and first.observations.shape == (2, 3, 2)
    assert first.rewards.dtype == np.float64 and not first.rewards.any()
    assert first.active == [[1, 1, 1]] * 2 and first.terminated == [[0, 0, 0]] * 2
    second = stream.step(np.array([[[2], [1], [0]], [[1], [1], [1]]]))
    moved = second.observations[:, :, 0] - first.observations[:, :, 0]
    np.testing.assert_allclose(moved, [[1, 0, -1], [0, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(second.rewards, second.observations[:, :, 0], atol=1e-6)
    # A world is its seed, not its place.
    again = stream.reset(6, 5)
    np.testing.assert_array_equal(again.observations, first.observations[::-1])


def test_a_world_that_is_over_waits_for_its_restart(run) -> None:
    stream = run(lambda: Line(limit=2))
    stream.reset(1, 2)
    stream.step()
    end = stream.step()
    assert end.truncated == [[1, 1, 1]] * 2 and end.terminated == [[0, 0, 0]] * 2
    assert end.active == [[0, 0, 0]] * 2
    # The last observation comes with the end.
    assert (end.observations[:, :, 1] == 2).all()
    waits = stream.step(restarts={1: 9})
    assert waits.active == [[0, 0, 0], [1, 1, 1]]
    assert not waits.observations[0].any() and not waits.rewards.any() and waits.truncated == [[0, 0, 0]] * 2
    fresh = stream.reset(9).observations[0]
    np.testing.assert_array_equal(waits.observations[1], fresh)


def test_a_restart_may_cut_an_episode(run) -> None:
    stream = run(Line)
    stream.reset(1, 2)
    stream.step()
    # What the world that begins anew was to do does not count.
    mixed = stream.step(np.array([[[255]] * 3, [[2]] * 3]), restarts={0: 7})
    assert mixed.observations[0, 0, 1] == 0 and mixed.observations[1, 0, 1] == 2
    assert mixed.rewards[0].tolist() == [0, 0, 0] and mixed.rewards[1].all()


def test_agents_leave_one_by_one(run) -> None:
    stream = run(lambda: Line(limit=4, leaves={"agent_1": 1, "agent_0": 3}))
    stream.reset(1, 2)
    one = stream.step()
    assert one.terminated[0] == [0, 1, 0] and one.active[0] == [1, 0, 1]
    assert one.observations[0, 1, 1] == 1 and one.rewards[0, 1] != 0
    two = stream.step(np.array([[[1], [255], [1]]] * 2))
    assert two.active[0] == [1, 0, 1] and two.terminated[0] == [0, 0, 0]
    assert not two.observations[0, 1].any() and two.rewards[0, 1] == 0
    three = stream.step()
    assert three.terminated[0] == [1, 0, 0] and three.active[0] == [0, 0, 1]
    four = stream.step()
    assert four.truncated[0] == [0, 0, 1] and four.active[0] == [0, 0, 0]


class Lists(Line):
    """Forgets to remove an agent that ended, and goes on telling what it sees."""

    def step(self, actions: dict) -> tuple:
        everyone = self.possible_agents[:]
        actions = {agent: actions.get(agent, 1) for agent in everyone}
        self.agents = everyone
        result = super().step(actions)
        over = not self.agents
        self.agents = [] if over else everyone
        return result


def test_an_agent_that_ended_stays_ended(run) -> None:
    stream = run(lambda: Lists(limit=4, leaves={"agent_1": 1}))
    stream.reset(1)
    assert stream.step().active == [[1, 0, 1]]
    assert stream.step().active == [[1, 0, 1]]


class Comes(Line):
    """agent_2 joins in the second step."""

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple:
        observations, infos = super().reset(seed, options)
        self.agents.remove("agent_2")
        return {a: observations[a] for a in self.agents}, {a: infos[a] for a in self.agents}

    def step(self, actions: dict) -> tuple:
        observations, *rest = super().step(actions)
        if self.steps == 2 and self.agents:
            self.agents.append("agent_2")
            observations["agent_2"] = self.observe("agent_2")
        return observations, *rest


def test_an_agent_comes_late(run) -> None:
    stream = run(lambda: Comes(limit=4))
    assert stream.reset(1).active == [[1, 1, 0]]
    assert stream.step().active == [[1, 1, 0]]
    came = stream.step()
    assert came.active == [[1, 1, 1]] and came.observations[0, 2, 1] == 2
    assert stream.step().observations[0, 2, 1] == 3
    assert stream.step().truncated == [[1, 1, 1]]


def test_options_reach_every_reset(run) -> None:
    stream = run(lambda: Line(limit=1))
    assert (stream.reset(1, 2, options='{"place": 7}').observations[:, :, 0] == 7).all()
    stream.step()
    assert (stream.step(restarts={0: 4}).observations[0, :, 0] == 7).all()
    assert not (stream.reset(1, 2).observations[:, :, 0] == 7).any()


@pytest.mark.parametrize(("options", "said"), [("[1]", "options: a JSON list; send an object"), ("{", "options: no JSON")])
def test_options_are_an_object(run, options: str, said: str) -> None:
    problem = run(Line).reset(1, options=options)
    assert problem.kind == pb.ENVIRONMENT_PROBLEM_KIND_REQUEST and said in problem.message


def test_one_agent_of_gymnasium(run) -> None:
    stream = run(lambda: Alone("rgb_array"))
    description = stream.description
    assert list(description.agents) == ["agent_0"] and description.observation_width == 4
    assert list(description.discrete.choices) == [2] and description.successes and description.renders
    assert description.steps_max == 5
    first = stream.reset(1, 2)
    # Nothing is lost of a binary64 observation.
    assert first.observations.dtype == np.float64
    for _ in range(4):
        step = stream.step(np.array([[[0]], [[1]]]))
    assert step.successes == [0, 0]
    end = stream.step(np.array([[[0]], [[1]]]))
    assert end.truncated == [[1], [1]] and end.successes == [0, 1]
    assert math.isclose(end.observations[1, 0, 0] - first.observations[1, 0, 0], 20.0)


def test_a_picture(run) -> None:
    stream = run(lambda: Alone("rgb_array"))
    stream.reset(1)
    png = stream.render(0).png
    assert png.startswith(b"\x89PNG\r\n\x1a\n") and png.endswith(b"IEND\xaeB`\x82")
    assert "there are 1" in stream.render(1).message
    silent = run(Alone)
    silent.reset(1)
    assert 'render: this environment gives no pictures; make it with render_mode="rgb_array"' == silent.render(0).message


class Breaks(Line):
    """One return value of step is replaced."""

    armed = False

    def __init__(self, field: int, value: object, at: int = 1) -> None:
        super().__init__()
        self.field, self.value, self.at = field, value, at

    def step(self, actions: dict) -> tuple:
        result = list(super().step(actions))
        if self.armed and self.steps == self.at:
            if isinstance(self.value, dict) and self.field < 5:
                result[self.field] = {**result[self.field], **self.value}
            else:
                result[self.field] = self.value
        return tuple(result)


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        (
            0,
            {"agent_1": np.array([1, np.nan], np.float32)},
            'world 0, agent "agent_1", observation number 1: expected a finite number, seen nan',
        ),
        (0, {"agent_1": np.zeros(3, np.float32)}, 'agent "agent_1", observation: expected shape (2,), seen shape (3,)'),
        # Together they have the right number of numbers.
        (
            0,
            {"agent_0": np.zeros(1, np.float32), "agent_1": np.zeros(3, np.float32)},
            'agent "agent_0", observation: expected shape (2,), seen shape (1,)',
        ),
        (0, {"agent_1": "high"}, 'agent "agent_1", observation: expected shape (2,), seen shape ()'),
        (
            0,
            {"__all__": 0},
            'observations: expected agents of possible_agents ("agent_0", "agent_1", "agent_2") as keys, seen "__all__"',
        ),
        (0, None, "observations: expected a dict with the agents as keys, seen None"),
        (1, {"agent_2": math.inf}, 'agent "agent_2", reward: expected a finite number, seen inf'),
        (1, {"agent_2": None}, 'agent "agent_2", reward: expected a number, seen None'),
        (1, {"agent_2": [1, 2]}, 'agent "agent_2", reward: expected a number, seen [1, 2]'),
        (2, {"agent_0": "no"}, "agent \"agent_0\", terminations: expected True or False, seen 'no'"),
        (3, {"agent_0": 2}, 'agent "agent_0", truncations: expected True or False, seen 2'),
    ],
)
def test_what_breaks_its_word_is_named(run, monkeypatch, field: int, value: object, said: str) -> None:
    stream = run(lambda: Breaks(field, value))
    monkeypatch.setattr(Breaks, "armed", True)
    stream.reset(1)
    problem = stream.step()
    assert problem.kind == pb.ENVIRONMENT_PROBLEM_KIND_BROKE_ITS_WORD and problem.world == 0
    assert said in problem.message
    # The stream goes on, but not this episode.
    assert "send a reset first" in stream.step().message
    monkeypatch.setattr(Breaks, "armed", False)
    assert stream.reset(1).active == [[1, 1, 1]]
    assert stream.step().active == [[1, 1, 1]]


def test_a_missing_reward_is_named(run) -> None:
    class Lacks(Line):
        far = 50.0

        def step(self, actions: dict) -> tuple:
            result = super().step(actions)
            if self.place["agent_0"] > self.far:
                del result[1]["agent_1"]
            return result

    stream = run(Lacks)
    Lacks.far = 5.0
    stream.reset(1, 2)
    for _ in range(8):
        problem = stream.step(np.array([[[1]] * 3, [[2]] * 3]))
        if not hasattr(problem, "active"):
            break
    assert problem.message == (
        'world 1, agent "agent_1", rewards: expected a value for every agent that acted, seen values of "agent_0", "agent_2"'
    )


def test_an_agent_that_leaves_without_an_end_is_named(run) -> None:
    class Vanishes(Line):
        far = 50.0

        def step(self, actions: dict) -> tuple:
            result = super().step(actions)
            if self.place["agent_0"] > self.far:
                self.agents = self.agents[1:]
            return result

    stream = run(Vanishes)
    Vanishes.far = 2.0
    stream.reset(1)
    while hasattr(problem := stream.step(2), "active"):
        pass
    assert problem.message == (
        'world 0, agent "agent_0", agents: expected the agent, or its end in terminations or truncations, seen neither'
    )


def test_rewards_of_one_number_in_an_array(run) -> None:
    class Arrays(Line):
        def step(self, actions: dict) -> tuple:
            o, r, *rest = super().step(actions)
            return o, {agent: np.array([value], np.float32) for agent, value in r.items()}, *rest

    stream = run(Arrays)
    seen = stream.reset(1)
    np.testing.assert_allclose(stream.step().rewards, seen.observations[:, :, 0], rtol=1e-6)


class Raises(Line):
    made = 0
    armed = False

    def __init__(self) -> None:
        super().__init__()
        Raises.made += 1

    def step(self, actions: dict) -> tuple:
        if self.armed and actions["agent_0"] == 2:
            raise ValueError("the wheel came off")
        return super().step(actions)


def test_an_exception_leaves_the_stream_usable(run, monkeypatch) -> None:
    stream = run(Raises)
    monkeypatch.setattr(Raises, "armed", True)
    stream.reset(1, 2)
    before = Raises.made
    problem = stream.step(np.array([[[1]] * 3, [[2]] * 3]))
    assert problem.kind == pb.ENVIRONMENT_PROBLEM_KIND_RAISED and problem.world == 1
    assert problem.message.startswith("world 1, step: ValueError: the wheel came off (") and "test_run.py:" in problem.message
    assert "send a reset first" in stream.step(restarts={1: 3}).message
    # Restarting every world is a reset as well. The world that raised is made anew, the other is not.
    assert stream.step(restarts={0: 1, 1: 3}).active == [[1, 1, 1]] * 2
    assert Raises.made == before + 1
    assert stream.step().active == [[1, 1, 1]] * 2


def test_requests_are_checked(run) -> None:
    stream = run(Line)
    stream.worlds = 1
    assert "send a reset first" in stream.step().message
    assert "seeds: empty" in stream.reset().message
    assert "must be below 2^31" in stream.reset(2**31).message
    stream.reset(1)
    assert "restarts: world 1; there are 1" in stream.step(restarts={1: 1}).message
    problem = stream.step(3)
    assert problem.message == 'actions: world 0, agent "agent_0", number 0: expected a choice below 3, seen 3'
    assert problem.kind == pb.ENVIRONMENT_PROBLEM_KIND_REQUEST
    stream.worlds = 2
    assert "actions: shape (2, 3, 1); expected (1, 3, 1)" in stream.step().message
    # A mistake of the caller costs no episode.
    stream.worlds = 1
    assert stream.step().observations[0, 0, 1] == 1
    assert "request: empty" in stream.send().message


def test_worlds_max(run) -> None:
    stream = run(Line, worlds=2)
    assert stream.description.worlds_max == 2
    assert "seeds: 3 worlds; this environment has at most 2" in stream.reset(1, 2, 3).message


def test_streams_are_apart_and_close_their_worlds(served) -> None:
    made: list[Line] = []

    def make() -> Line:
        made.append(Line())
        return made[-1]

    stub = served(make)
    one, two = Run(stub), Run(stub)
    made.clear()
    one.reset(1, 2)
    two.reset(1)
    one.step()
    assert two.step().observations[0, 0, 1] == 1
    one.reset(3)
    assert [env.closed for env in made] == [0, 1, 0]
    one.close()
    assert [env.closed for env in made] == [1, 1, 0]


def test_the_head_of_the_answer_comes_before_a_request(run) -> None:
    stream = run(Line)
    asking = threading.Thread(target=stream.replies.initial_metadata, daemon=True)
    asking.start()
    asking.join(timeout=10)
    assert not asking.is_alive()


def test_finds_out_that_seeds_do_not_settle_an_episode(run) -> None:
    class Unseeded(Line):
        def reset(self, seed: int | None = None, options: dict | None = None) -> tuple:
            return super().reset(None, options)

    class Remembers(Line):
        """An episode depends on the one before."""

        before = 0.0

        def reset(self, seed: int | None = None, options: dict | None = None) -> tuple:
            result = super().reset(seed, options)
            self.place["agent_0"] += self.before
            self.before += 1.0
            return {agent: self.observe(agent) for agent in self.agents}, result[1]

    class Shared(Line):
        """Draws from a generator of all worlds, which reset seeds."""

        def step(self, actions: dict) -> tuple:
            self.place["agent_0"] += np.random.random()
            return super().step(actions)

        def reset(self, seed: int | None = None, options: dict | None = None) -> tuple:
            np.random.seed(seed)
            return super().reset(seed, options)

    for make in (Unseeded, Remembers, Shared):
        assert not run(make).description.deterministic, make
    assert run(Unseeded, deterministic=True).description.deterministic
    assert not run(Line, deterministic=False).description.deterministic


def test_what_cannot_be_served_is_refused_by_name(served) -> None:
    class Turns(Line):
        def agent_iter(self) -> None:
            pass

    assert "make: returned an AEC environment" in refused(served(Turns))
    assert "make: returned 3; return a PettingZoo Parallel environment" in refused(served(lambda: 3))

    def broken() -> None:
        raise OSError("no such simulator")

    assert "make: OSError: no such simulator (" in refused(served(broken))


def test_state(run) -> None:
    class Whole(Line):
        def state(self) -> np.ndarray:
            return np.array([[self.place[a] for a in self.possible_agents]])

    stream = run(lambda: Whole(limit=2))
    assert stream.description.state_width == 3
    first = stream.reset(1)
    np.testing.assert_allclose(first.states, first.observations[:, :, 0], rtol=1e-6)
    stream.step()
    assert stream.step().states.any() and not stream.step().states.any()


def test_a_state_that_fails_at_the_end_is_not_sent(run) -> None:
    class Late(Line):
        bad: object = ValueError

        def state(self) -> np.ndarray:
            if self.agents:
                return np.zeros(3)
            if isinstance(self.bad, int):
                return np.zeros(self.bad)
            raise ValueError("no agents")

    for Late.bad in (ValueError, 2):
        assert run(Late).description.state_width == 0
    Late.bad = 3
    stream = run(lambda: Late(limit=1))
    assert stream.description.state_width == 3
    assert run(Late, state=False).description.state_width == 0
    for Late.bad, said in ((ValueError, "state(): ValueError: no agents ("), (2, "state(): expected 3 numbers")):
        stream.reset(1)
        problem = stream.step()
        assert said in problem.message and problem.message.endswith("serve with state=False if it is of no use")


def test_a_slow_environment_plays_less_before_it_describes_itself(run, monkeypatch) -> None:
    steps = 0

    class Slow(Line):
        def step(self, actions: dict) -> tuple:
            nonlocal steps
            steps += 1
            time.sleep(0.01)
            return super().step(actions)

    monkeypatch.setattr("magex._probe.SECONDS", 0.2)
    for worlds in (None, 1):
        steps = 0
        assert run(Slow, worlds=worlds).description.deterministic
        assert 0 < steps < 150


def test_success_needs_every_agent_that_says_something(run) -> None:
    class Says(Line):
        said = {"agent_0": True, "agent_1": True}

        def info(self, agent: str) -> dict:
            return {"success": self.said[agent]} if agent in self.said else {}

    # One agent ends before the others.
    stream = run(lambda: Says(limit=2, leaves={"agent_1": 1}))
    for Says.said, expected in (
        ({"agent_0": True, "agent_1": True}, [1]),
        ({"agent_0": True, "agent_1": False}, [0]),
        ({"agent_0": False, "agent_1": True}, [0]),
        ({}, [0]),
    ):
        stream.reset(1)
        assert stream.step().successes == [0]
        assert stream.step().successes == expected
