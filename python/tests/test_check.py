"""Every rule of Check with an environment that breaks it, and environments that break none."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from environments import Alone, Line, Many, vector
from gymnasium import spaces

from magex._report import RULES
from magex._wire import environment_pb2 as pb


def check(served, make: Any, steps: int = 60, **options: Any) -> pb.CheckReply:
    return served(make, **options).Check(pb.CheckRequest(seed=3, steps=steps))


def clean(reply: pb.CheckReply) -> bool:
    return not reply.violations


def sentences(reply: pb.CheckReply, rule: str, warning: bool = False) -> str:
    return "\n".join(v.sentence for v in reply.violations if v.rule == rule and v.warning == warning)


class Leaves(Line):
    def __init__(self) -> None:
        super().__init__(leaves={"agent_1": 3, "agent_0": 10})


class Masked(Line):
    def info(self, agent: str) -> dict:
        return {"action_mask": np.array([1, self.steps % 2, 1], np.int8)}

    def state(self) -> np.ndarray:
        return np.array(list(self.place.values()))


@pytest.mark.parametrize("make", [Line, Leaves, Masked, Alone, Many, vector, lambda: vector(2), lambda: Alone("rgb_array")])
def test_nothing_is_wrong_with_these(served, make: Any) -> None:
    reply = check(served, make, deterministic=True)
    assert clean(reply), reply
    assert reply.deterministic and reply.steps >= 60 and reply.episodes >= 2
    assert len(reply.checked) == len(set(reply.checked)) >= 8


# -- one rule each


class NewSpaces(Line):
    def action_space(self, agent: str) -> Any:
        return spaces.Discrete(3)


class SameList(Line):
    def reset(self, seed: Any = None, options: Any = None) -> tuple:
        self.possible_agents = [f"agent_{i}" for i in range(3)]
        result = super().reset(seed, options)
        self.agents = self.possible_agents
        return result


class OnlyObservations(Line):
    armed = False

    def reset(self, seed: Any = None, options: Any = None) -> Any:
        return super().reset(seed, options)[0]


class NeedsSeed(Line):
    def reset(self, seed: Any = None, options: Any = None) -> tuple:
        return super().reset(seed + 0, options)


class TooManyInfos(Line):
    def reset(self, seed: Any = None, options: Any = None) -> tuple:
        observations, infos = super().reset(seed, options)
        return observations, {**infos, "common": {}}


class RaisesLater(Line):
    def step(self, actions: dict) -> tuple:
        if self.steps == 6:
            raise ZeroDivisionError("of course")
        return super().step(actions)


class Four(Line):
    def step(self, actions: dict) -> Any:
        o, r, te, tr, i = super().step(actions)
        return o, r, te, i


class AllKey(Line):
    def step(self, actions: dict) -> Any:
        o, r, te, tr, i = super().step(actions)
        return o, r, {**te, "__all__": not self.agents}, tr, i


class DeadKeys(Line):
    def __init__(self) -> None:
        super().__init__(leaves={"agent_1": 3})

    def step(self, actions: dict) -> Any:
        o, r, te, tr, i = super().step(actions)
        return o, {**dict.fromkeys(self.possible_agents, 0.0), **r}, te, tr, i


class NoLast(Line):
    def __init__(self) -> None:
        super().__init__(leaves={"agent_1": 3})

    def step(self, actions: dict) -> Any:
        o, r, te, tr, i = super().step(actions)
        return {a: v for a, v in o.items() if a in self.agents}, r, te, tr, i


class Outside(Line):
    def observe(self, agent: str) -> Any:
        return super().observe(agent) + np.float32(100 if self.steps == 7 else 0)


class Doubles(Line):
    def observe(self, agent: str) -> Any:
        return super().observe(agent).astype(np.float64) if self.steps == 7 else super().observe(agent)


class ListsSeen(Line):
    def observe(self, agent: str) -> Any:
        return super().observe(agent).tolist()


class Shapes(Line):
    def observe(self, agent: str) -> Any:
        return super().observe(agent)[: 1 if self.steps == 2 else 2]


class Nan(Line):
    def observe(self, agent: str) -> Any:
        seen = super().observe(agent)
        return seen * np.float32(np.nan) if self.steps == 7 else seen


class Infinite(Line):
    def step(self, actions: dict) -> Any:
        o, r, *rest = super().step(actions)
        return o, dict.fromkeys(r, float("inf")), *rest


class Texts(Line):
    def step(self, actions: dict) -> Any:
        o, r, *rest = super().step(actions)
        return o, dict.fromkeys(r, "1.0"), *rest


class RewardArrays(Line):
    def step(self, actions: dict) -> Any:
        o, r, *rest = super().step(actions)
        return o, {a: np.array([v]) for a, v in r.items()}, *rest


class Stays(Line):
    def __init__(self) -> None:
        super().__init__(leaves={"agent_1": 3})

    def step(self, actions: dict) -> Any:
        self.agents = list(actions)
        result = super().step(actions)
        if self.steps == 3:
            self.agents = self.possible_agents[:]
        return result


class Vanishes(Line):
    def step(self, actions: dict) -> Any:
        result = super().step(actions)
        if self.steps == 4:
            self.agents = self.agents[1:]
        return result


class Ones(Line):
    def step(self, actions: dict) -> Any:
        o, r, te, tr, i = super().step(actions)
        return o, r, {a: int(v) for a, v in te.items()}, tr, i


class Revives(Line):
    def step(self, actions: dict) -> Any:
        if not actions:
            self.agents = self.possible_agents[:]
            return {}, {}, {}, {}, {}
        return super().step(actions)


class Terminates(Line):
    def step(self, actions: dict) -> Any:
        o, r, te, tr, i = super().step(actions)
        return o, r, tr, te, i


class GoesOn(Line):
    def __init__(self) -> None:
        super().__init__(limit=30)

    max_cycles = 8


class WrongMask(Masked):
    def info(self, agent: str) -> dict:
        return {"action_mask": np.ones(2 if self.steps == 4 else 3, np.int8)}


class EmptyMask(Masked):
    def info(self, agent: str) -> dict:
        return {"action_mask": np.full(3, self.steps != 4, np.int8)}


class LostMask(Masked):
    def info(self, agent: str) -> dict:
        return {} if self.steps == 4 else super().info(agent)


class State(Line):
    def state(self) -> np.ndarray:
        return np.zeros(2 if self.steps == 4 else 3)


class NanState(Line):
    def state(self) -> np.ndarray:
        return np.full(3, np.nan if self.steps == 4 else 0)


class BrokenState(Line):
    def state(self) -> np.ndarray:
        raise ValueError("too lazy")


class Reuses(Line):
    def reset(self, seed: Any = None, options: Any = None) -> tuple:
        self.rows = {agent: np.zeros(2, np.float32) for agent in self.possible_agents}
        return super().reset(seed, options)

    def observe(self, agent: str) -> Any:
        self.rows[agent][:] = self.place[agent], self.steps
        return self.rows[agent]


class Eats(Line):
    def step(self, actions: dict) -> Any:
        result = super().step(actions)
        actions.clear()
        return result


class LateChance(Line):
    """Equal seeds differ from step 7 on: a comparison of first observations would not see it."""

    def step(self, actions: dict) -> Any:
        if self.steps == 6:
            self.place["agent_1"] += np.random.default_rng().random()
        return super().step(actions)


class SeedBlind(Line):
    def reset(self, seed: Any = None, options: Any = None) -> tuple:
        return super().reset(7, options)


class CannotClose(Line):
    def close(self) -> None:
        raise RuntimeError("still open")


class Pictures(Line):
    render_mode = "rgb_array"

    def render(self) -> Any:
        return [[0]]


class Once(Line):
    made = 0

    def __init__(self) -> None:
        super().__init__()
        Once.made += 1
        if Once.made == 5:
            raise RuntimeError("only one at a time")


BROKEN = [
    (NewSpaces, "spaces", 'action_space("agent_0") returns a new object on each call'),
    (SameList, "agents", "episode 1 (seed 3), reset: agents is the same list as possible_agents"),
    (NeedsSeed, "reset", "reset without a seed: TypeError"),
    (
        TooManyInfos,
        "reset",
        'reset: infos of "agent_0", "agent_1", "agent_2", "common", and agents is "agent_0", "agent_1", "agent_2"',
    ),
    (RaisesLater, "step", "ZeroDivisionError: of course ("),
    (Four, "step", "returns 4 values; return five dicts"),
    (AllKey, "keys", 'step 1: terminations has "__all__", which did not act'),
    (DeadKeys, "keys", 'step 4: rewards has "agent_1", which did not act'),
    (NoLast, "keys", 'step 3: observations lacks "agent_1", which acted'),
    (
        Outside,
        "observations",
        'step 7, agent "agent_0": observation is not in its space: number 1 is 107.0, and its bounds are -100.0 to 100.0',
    ),
    (Shapes, "observations", 'step 2, agent "agent_0": observation: expected shape (2,), seen shape (1,)'),
    (Doubles, "dtypes", 'step 7, agent "agent_0": observation has dtype float64, and its space float32'),
    (ListsSeen, "dtypes", "observation is a list; return a NumPy array of float32"),
    (Nan, "finite", 'step 7, agent "agent_2": observation has nan as number 0'),
    (Infinite, "finite", 'step 1, agent "agent_0": reward is inf'),
    (Texts, "rewards", "reward is '1.0'; give a number"),
    (Stays, "ends", 'step 3, agent "agent_1": ended and is still in agents'),
    (Vanishes, "ends", 'step 4, agent "agent_0": left agents without terminations or truncations'),
    (Ones, "ends", "terminations is 0; give True or False"),
    (Revives, "after the end", 'episode 1 (seed 3): agents has "agent_0", "agent_1", "agent_2" again after the end'),
    (Terminates, "limits", "6 episodes end at their limit of 10 steps with terminations; that is a truncation"),
    (GoesOn, "limits", "step 9: the episode goes on, and its limit is 8 steps"),
    (WrongMask, "masks", 'step 4, agent "agent_0": action_mask: expected shape (3,), seen shape (2,)'),
    (EmptyMask, "masks", 'step 4, agent "agent_0": action_mask allows no choice'),
    (LostMask, "masks", 'step 4, agent "agent_0": no action_mask, and there was one after the first reset'),
    (Reuses, "aliasing", 'reset, agent "agent_0": the observation was changed by step 1'),
    (Eats, "actions", "are {} after the step"),
    (CannotClose, "make", "close(): RuntimeError: still open ("),
    (Once, "make", "only one at a time"),
    (Pictures, "pictures", "render() returns [[0]]"),
]


@pytest.mark.parametrize(("make", "rule", "said"), BROKEN, ids=[case[0].__name__ for case in BROKEN])
def test_a_broken_rule_is_found(served, make: Any, rule: str, said: str) -> None:
    Once.made = 0
    options = {"pad": False}
    reply = check(served, make, **options)
    assert said in sentences(reply, rule), reply
    assert RULES[rule] in reply.checked
    # A mistake is found once, not as several: other rules are silent, except where it ends what can be played.
    others = {v.rule for v in reply.violations if not v.warning} - {rule, "same seed"}
    assert not others, reply


REMARKS = [
    (State, "state", "step 4: state() has 2 numbers, and 3 after the first reset; it is not sent"),
    (NanState, "state", "step 4: state() has something that is no finite number; it is not sent"),
    (RewardArrays, "rewards", "reward is an array of shape (1,); give float(reward)"),
    (BrokenState, "state", "state(): ValueError: too lazy"),
    (LateChance, "same seed", "two episodes with seed 11 and the same actions differ in observations at step 7"),
    (SeedBlind, "other seed", "the first 6 episodes are equal, though their seeds are 3 to 8"),
]


@pytest.mark.parametrize(("make", "rule", "said"), REMARKS, ids=[case[0].__name__ for case in REMARKS])
def test_a_remark(served, make: Any, rule: str, said: str) -> None:
    reply = check(served, make)
    assert said in sentences(reply, rule, warning=True), reply
    assert all(v.warning for v in reply.violations)


def test_every_rule_can_be_broken() -> None:
    assert {rule for _, rule, _ in BROKEN + REMARKS} == set(RULES)


def test_what_the_author_promised_is_a_violation(served) -> None:
    reply = check(served, LateChance, deterministic=True)
    assert "differ in observations" in sentences(reply, "same seed") and not reply.deterministic


def test_a_reset_of_the_old_kind(served) -> None:
    reply = check(served, OnlyObservations)
    assert "return (observations, infos), two dicts" in sentences(reply, "reset")


@pytest.mark.parametrize("make", [State, NanState])
def test_a_state_that_is_sent_must_be_right(served, make: Any) -> None:
    reply = check(served, make, deterministic=True, successes=False)
    assert "step 4: state() has " in sentences(reply, "state") and "serve with state=False" in sentences(reply, "state")


def test_what_cannot_be_served_is_a_violation(served) -> None:
    reply = check(served, lambda: 3)
    assert "make: returned 3" in sentences(reply, "make") and len(reply.violations) == 1


def test_no_more_than_twenty_of_a_rule(served) -> None:
    reply = check(served, ListsSeen)
    of_rule = [v.sentence for v in reply.violations if v.rule == "dtypes"]
    assert len(of_rule) == 21 and of_rule[-1] == f"and {3 * 66 - 20} more of this rule"


class OldGym(gymnasium.Env):
    observation_space = spaces.Box(-1, 1, (1,))
    action_space = spaces.Discrete(2)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple:
        return np.zeros(1, np.float32), {}

    def step(self, action: int) -> tuple:
        return np.zeros(1, np.float32), 0.0, False, {}


def test_a_step_of_the_old_kind(served) -> None:
    said = sentences(check(served, OldGym), "step")
    assert "step: expected (observation, reward, terminated, truncated, info), seen 4 values" in said


# -- worlds in arrays


class OwnArray(Many):
    def reset(self, worlds: int, seeds: np.ndarray) -> np.ndarray:
        self.buffer = np.zeros((worlds, 2, 2), np.float32)
        return super().reset(worlds, seeds)

    def view(self) -> np.ndarray:
        self.buffer[:] = super().view()
        return self.buffer


class Bounded(Many):
    observation_space = spaces.Box(-9, 5, (2,), np.float32)


class Finishes(Many):
    def step(self, actions: np.ndarray) -> tuple:
        o, r, te, tr = super().step(actions)
        return o, r, tr, te


class NoEnd(Many):
    def step(self, actions: np.ndarray) -> tuple:
        o, r, te, tr = super().step(actions)
        return o, r, te, te


class Nans(Many):
    def step(self, actions: np.ndarray) -> tuple:
        o, *rest = super().step(actions)
        return np.where(self.steps[:, None, None] == 3, np.nan, o), *rest


class Blind(Many):
    def reset(self, worlds: int, seeds: np.ndarray) -> np.ndarray:
        return super().reset(worlds, 0 * seeds)

    def restart(self, which: np.ndarray, seeds: np.ndarray) -> np.ndarray:
        return super().restart(which, 0 * seeds)


@pytest.mark.parametrize(
    ("make", "rule", "said", "warning"),
    [
        (OwnArray, "aliasing", "reset: the array of observations was changed by step 1", True),
        (Bounded, "observations", 'step 6, world 0, agent "left": number 1 is 6.0, and its bounds are -9.0 to 5.0', False),
        (Finishes, "limits", "episodes end at their limit of 6 steps with terminated", False),
        (NoEnd, "limits", "world 0: the episode goes on after step 6, its limit", False),
        (Nans, "finite", 'world 0, agent "left", observation number 0: expected a finite number, seen nan', False),
        (Blind, "other seed", "4 worlds with the seeds 3 to 6 and equal actions are equal", True),
    ],
)
def test_a_broken_rule_of_arrays_is_found(served, make: Any, rule: str, said: str, warning: bool) -> None:
    assert said in sentences(check(served, make), rule, warning)
