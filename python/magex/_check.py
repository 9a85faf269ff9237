"""Plays an environment with one object for each world and says which rules of its interface it breaks.

PettingZoo's own tests look neither at observations nor at rewards, and compare seeds in the first steps only.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from magex import _probe
from magex._environment import Environment
from magex._layout import Layout
from magex._observations import Unfit
from magex._parallel import Alone
from magex._problems import Problem, Refused, describe, names, short
from magex._report import Report
from magex._values import contains, dtypes, equal, outside

STEPS = 300


def check(environment: Environment, seed: int, steps: int, said_deterministic: bool | None) -> Report:
    """Plays about `steps` steps in episodes with the seeds seed, seed + 1, ...

    said_deterministic: what the author said of determinism; True that does not hold is a violation and not a remark.
    """
    report = Report()
    report.check("make")
    try:
        layout = environment.layout()
    except (Refused, Problem) as error:
        report.add("make", str(error))
        return report
    except Exception as error:
        report.add("make", f"make: {describe(error)}")
        return report
    if environment.kind == "vector":
        from magex._check_vector import check_vector

        check_vector(environment, layout, report, seed, steps or STEPS)
    else:
        _Player(environment, layout, report).run(seed, steps or STEPS)
    _seeds(environment, report, steps or STEPS, said_deterministic)
    return report


def _seeds(environment: Environment, report: Report, steps: int, said: bool | None) -> None:
    report.check("same seed")
    try:
        found = _probe.play(environment, steps)
    except (Refused, Problem) as error:
        report.add("same seed", f"cannot be compared: {error}")
        return
    report.deterministic = found.deterministic
    report.steps += found.steps
    if not found.deterministic:
        report.add("same seed", found.difference, warning=not said)


class _Over(Exception):
    """Nothing can be played after this."""


class _Player:
    """One environment object after another, looked at from all sides."""

    def __init__(self, environment: Environment, layout: Layout, report: Report) -> None:
        self.environment = environment
        self.layout = layout
        self.report = report
        self.index = {agent: i for i, agent in enumerate(layout.agents)}
        self.state_width = layout.state_seen
        self.lasted: list[tuple[int, bool, bool]] = []
        # The last observations, and what they were when they were returned.
        self.returned: list[tuple[str, str, Any, Any]] = []
        self.masks: np.ndarray | None = None

    def run(self, seed: int, steps: int) -> None:
        report = self.report
        report.check("spaces", "agents", "reset", "step", "keys", "observations", "dtypes", "finite", "rewards", "ends")
        report.check("after the end", "aliasing", "actions", "other seed")
        if self.layout.masks:
            report.check("masks")
        if self.state_width:
            report.check("state")
        if self.layout.steps_max:
            report.check("limits")
        env = self._make()
        if env is None:
            return
        try:
            self._static(env)
            traces = []
            # Every episode gets the same random numbers for its actions: what differs then comes from the seed.
            while report.steps < steps or report.episodes < 2:
                limit = max(steps - report.steps, 10)
                traces.append(self._episode(env, seed + report.episodes, limit))
            if all(trace == traces[0] for trace in traces):
                text = f"the first {len(traces)} episodes are equal, though their seeds are {seed} to {seed + len(traces) - 1}"
                report.add("other seed", text, warning=True)
            self._limits()
            self._unseeded(env)
            self._picture(env)
        except _Over:
            pass
        self._again(env)

    # -- before an episode

    def _make(self) -> Any:
        try:
            return self.environment.make()
        except (Refused, Problem) as error:
            self.report.add("make", str(error))
        except Exception as error:
            self.report.add("make", f"make: {describe(error)}")
        return None

    def _static(self, env: Any) -> None:
        for agent in self.layout.agents:
            for field in ("observation_space", "action_space"):
                get = getattr(env, field)
                if get(agent) is not get(agent):
                    self.report.add(
                        "spaces", f'{field}("{agent}") returns a new object on each call; make it once and return that'
                    )
        if list(env.possible_agents) != self.layout.agents:
            self.report.add(
                "agents",
                f"possible_agents: {names(env.possible_agents)} in one object and {names(self.layout.agents)} in another",
            )

    def _begin(self, env: Any, seed: int | None, where: str) -> tuple[dict, dict]:
        report = self.report
        self.returned = []
        try:
            result = env.reset(seed=seed) if seed is not None else env.reset()
        except Unfit as unfit:
            report.add("reset", f"{where}: {unfit}")
            raise _Over from None
        except Exception as error:
            report.add("reset", f"{where}: {describe(error)}")
            raise _Over from None
        if not isinstance(result, tuple) or len(result) != 2 or not all(isinstance(part, dict) for part in result):
            report.add("reset", f"{where}: returns {short(result)}; return (observations, infos), two dicts")
            raise _Over
        if env.agents is env.possible_agents:
            report.add("agents", f"{where}: agents is the same list as possible_agents; copy it, or agents that leave are lost")
        unknown = set(env.agents) - set(self.index)
        if unknown:
            report.add("agents", f"{where}: agents has {names(unknown)}, which possible_agents does not have")
            raise _Over
        if not env.agents:
            report.add("agents", f"{where}: agents is empty")
            raise _Over
        for field, part in zip(("observations", "infos"), result):
            if part.keys() != set(env.agents):
                report.add("reset", f"{where}: {field} of {names(part)}, and agents is {names(env.agents)}")
                if field == "observations" and set(env.agents) - part.keys():
                    raise _Over
        return result

    # -- an episode

    def _episode(self, env: Any, seed: int, limit: int) -> list[bytes]:
        """Returns what was seen, to compare it with other episodes."""
        report = self.report
        rng = np.random.default_rng(5)
        report.episodes += 1
        name = f"episode {report.episodes} (seed {seed})"
        observations, infos = self._begin(env, seed, f"{name}, reset")
        trace: list[bytes] = []
        alive = list(env.agents)
        self.masks = (
            None
            if not self.layout.masks
            else np.broadcast_to(self.layout.actions.allowed, self.layout.actions.allowed.shape).copy()
        )
        self._observations(f"{name}, reset", observations, infos, alive, set(alive), trace)
        self._state(env, f"{name}, reset")
        for step in range(1, limit + 1):
            where = f"{name}, step {step}"
            alive = self._step(env, where, alive, rng, trace)
            report.steps += 1
            if not alive:
                break
        else:
            return trace
        if env.agents:
            return trace
        self._after_the_end(env, name)
        return trace

    def _step(self, env: Any, where: str, alive: list[str], rng: np.random.Generator, trace: list[bytes]) -> list[str]:
        report, layout = self.report, self.layout
        numbers = _probe.random_actions(layout, rng, self.masks)[None]
        typed = numbers.astype(np.int64) if layout.actions.discrete else numbers
        rows = layout.actions.rows(typed, np.ones(numbers.shape[:2], bool))[0]
        actions = {agent: rows[self.index[agent]] for agent in alive}
        kept = copy.deepcopy(actions)
        try:
            result = env.step(actions)
        except Unfit as unfit:
            report.add("step", f"{where}: {unfit}")
            raise _Over from None
        except Exception as error:
            report.add("step", f"{where}, actions {short(kept)}: {describe(error)}")
            raise _Over from None
        if not equal(kept, actions):
            report.add("actions", f"{where}: the actions were {short(kept)}, and are {short(actions)} after the step; copy them")
        if not isinstance(result, tuple) or len(result) != 5 or not all(isinstance(part, dict) for part in result):
            seen = f"{len(result)} values" if isinstance(result, tuple) and len(result) != 5 else short(result)
            report.add(
                "step", f"{where}: returns {seen}; return five dicts: observations, rewards, terminations, truncations, infos"
            )
            raise _Over
        self._aliasing(where)
        observations, rewards, terminations, truncations, infos = result
        came = set(env.agents) - set(alive)
        fields = dict(zip(("observations", "rewards", "terminations", "truncations", "infos"), result))
        missing = False
        for field, values in fields.items():
            unknown = values.keys() - set(alive) - came
            if unknown:
                report.add("keys", f"{where}: {field} has {names(unknown)}, which did not act; leave it out")
            lacking = set(alive) - values.keys()
            if lacking:
                missing = missing or field != "infos"
                report.add(
                    "keys",
                    f"{where}: {field} lacks {names(lacking)}, which acted; give its last one in the step in which it ends too",
                )
        if missing:
            raise _Over
        ended = set()
        for agent in alive:
            self._reward(where, agent, rewards[agent], trace)
            for field in ("terminations", "truncations"):
                flag = fields[field][agent]
                if not isinstance(flag, (bool, np.bool_)):
                    report.add("ends", f'{where}, agent "{agent}": {field} is {short(flag)}; give True or False')
                if flag:
                    ended.add(agent)
            if agent in ended and agent in env.agents:
                report.add("ends", f'{where}, agent "{agent}": ended and is still in agents; remove it')
            if agent not in ended and agent not in env.agents:
                report.add("ends", f'{where}, agent "{agent}": left agents without terminations or truncations; set one of them')
        if came - set(self.index):
            report.add("agents", f"{where}: agents has {names(came - set(self.index))}, which possible_agents does not have")
            raise _Over
        after = [agent for agent in env.agents if agent not in ended]
        self._observations(where, observations, infos, [a for a in alive + sorted(came) if a in observations], set(after), trace)
        self._state(env, where)
        if not after:
            step = int(where.rsplit(" ", 1)[1])
            last = alive
            self.lasted.append((step, any(bool(truncations[a]) for a in last), any(bool(terminations[a]) for a in last)))
        elif self.layout.steps_max and int(where.rsplit(" ", 1)[1]) == self.layout.steps_max + 1:
            report.add(
                "limits",
                f"{where}: the episode goes on, and its limit is {self.layout.steps_max} steps; end it, or correct the limit",
            )
        return after

    # -- values

    def _observations(
        self, where: str, observations: dict, infos: dict, agents: list[str], acting: set[str], trace: list[bytes]
    ) -> None:
        report, layout = self.report, self.layout
        self.returned = []
        for agent in agents:
            i = self.index[agent]
            codec, value = layout.observations[i], observations[agent]
            place = f'{where}, agent "{agent}"'
            row = np.zeros(codec.width, np.float64)
            try:
                codec.write(codec.numbers(value), row)
            except Unfit as unfit:
                report.add("observations", f"{place}: {unfit}")
                continue
            trace.append(row.tobytes())
            finite = bool(np.isfinite(row).all())
            if not finite:
                at = int(np.argmin(np.isfinite(row)))
                report.add("finite", f"{place}: observation has {row[at]} as number {at}")
            right = dtypes(report, place, codec.inner, codec.numbers(value), "observation")
            if finite and right and not contains(codec.inner, codec.numbers(value)):
                report.add(
                    "observations", f"{place}: observation is not in its space: {outside(codec.inner, codec.numbers(value))}"
                )
            self.returned.append((where, agent, value, copy.deepcopy(value)))
            if self.masks is not None and layout.own_masks:
                self._mask(place, i, value, infos.get(agent), agent in acting)

    def _mask(self, place: str, i: int, value: Any, info: Any, acts: bool) -> None:
        codec = self.layout.observations[i]
        assert self.masks is not None
        mask = None
        if codec.has_mask:
            mask = value.get("action_mask") if isinstance(value, dict) else None
        elif self.layout.info_masks[i]:
            mask = info.get("action_mask") if isinstance(info, dict) else None
        else:
            return
        if not acts:
            return
        if mask is None:
            self.report.add("masks", f"{place}: no action_mask, and there was one after the first reset; give it in every step")
            self.masks[i] = self.layout.actions.allowed[i]
            return
        try:
            self.layout.actions.codecs[i].mask(mask, self.masks[i])
        except Unfit as unfit:
            self.report.add("masks", f"{place}: {unfit}")
            self.masks[i] = self.layout.actions.allowed[i]
            return
        if not self.masks[i].any(axis=1).all():
            self.report.add("masks", f"{place}: action_mask allows no choice; allow one at least in every component")
            self.masks[i] = self.layout.actions.allowed[i]

    def _reward(self, where: str, agent: str, reward: Any, trace: list[bytes]) -> None:
        place = f'{where}, agent "{agent}"'
        if isinstance(reward, np.ndarray) and reward.size == 1 and reward.dtype.kind in "biuf":
            self.report.add("rewards", f"{place}: reward is an array of shape {reward.shape}; give float(reward)", warning=True)
            reward = reward.reshape(-1)[0]
        number = isinstance(reward, (int, float, np.integer, np.floating)) and not isinstance(reward, bool)
        if not number and not isinstance(reward, (bool, np.bool_)):
            self.report.add("rewards", f"{place}: reward is {short(reward)}; give a number")
            return
        if not np.isfinite(reward):
            self.report.add("finite", f"{place}: reward is {float(reward)}")
        trace.append(np.float64(reward).tobytes())

    def _aliasing(self, where: str) -> None:
        for then, agent, value, before in self.returned:
            if not equal(value, before):
                self.report.add(
                    "aliasing",
                    f'{then}, agent "{agent}": the observation was changed by {where.rsplit(", ", 1)[-1]}; return a copy',
                )
                return

    def _state(self, env: Any, where: str) -> None:
        # What the first reset told, whatever has become of it.
        width = self.state_width
        if isinstance(env, Alone):
            return
        if not width:
            self._no_state(env, where)
            return
        wrong = ""
        try:
            state = np.asarray(env.state())
            if state.size != width:
                wrong = f"state() has {state.size} numbers, and {width} after the first reset"
            elif state.dtype.kind not in "biuf" or not np.isfinite(state).all():
                wrong = "state() has something that is no finite number"
        except Exception as error:
            wrong = f"state(): {describe(error)}"
        if wrong:
            # Found before, and not sent: training works without.
            unsent = not self.layout.state_width
            remedy = "it is not sent: the critic sees all observations" if unsent else "repair it, or serve with state=False"
            self.report.add("state", f"{where}: {wrong}; {remedy}", warning=unsent)

    def _no_state(self, env: Any, where: str) -> None:
        if not where.startswith("episode 1 ") or not where.endswith("reset") or not hasattr(env, "state"):
            return
        try:
            env.state()
        except (NotImplementedError, AttributeError):
            return
        except Exception as error:
            self.report.add(
                "state", f"{where}: state(): {describe(error)}; the critic sees all observations instead", warning=True
            )

    # -- after an episode

    def _after_the_end(self, env: Any, name: str) -> None:
        try:
            if not isinstance(env, Alone):
                env.step({})
        except Exception:
            # To refuse a step after the end is right as well.
            return
        if env.agents:
            self.report.add(
                "after the end", f"{name}: agents has {names(env.agents)} again after the end; it must stay empty until reset"
            )

    def _limits(self) -> None:
        limit = self.layout.steps_max
        if not limit:
            return
        at_limit = [(cut, ended) for step, cut, ended in self.lasted if step == limit]
        wrong = [1 for cut, ended in at_limit if ended and not cut]
        if wrong and len(wrong) == len(at_limit):
            # One episode may reach its goal in the last step by chance.
            self.report.add(
                "limits",
                f"{len(wrong)} episodes end at their limit of {limit} steps with terminations; that is a truncation, after which "
                "the rest of the episode still has a value",
                warning=len(wrong) < 2,
            )

    def _unseeded(self, env: Any) -> None:
        observations, _ = self._begin(env, None, "reset without a seed")
        for agent in env.agents:
            codec = self.layout.observations[self.index[agent]]
            try:
                codec.write(codec.numbers(observations[agent]), np.zeros(codec.width))
            except Unfit as unfit:
                self.report.add("reset", f'reset without a seed, agent "{agent}": {unfit}')

    def _picture(self, env: Any) -> None:
        if not self.layout.renders:
            return
        self.report.check("pictures")
        try:
            picture = env.render()
        except Exception as error:
            self.report.add("pictures", f"render(): {describe(error)}")
            return
        if (
            not isinstance(picture, np.ndarray)
            or picture.ndim != 3
            or picture.shape[2] not in (3, 4)
            or picture.dtype != np.uint8
        ):
            self.report.add("pictures", f"render() returns {short(picture)}; return an array [height, width, 3] of uint8")

    def _again(self, env: Any) -> None:
        try:
            env.close()
        except Exception as error:
            self.report.add("make", f"close(): {describe(error)}")
        second = self._make()
        if second is None:
            return
        try:
            second.reset(seed=1)
            second.close()
        except Exception as error:
            self.report.add("make", f"a second environment, after close() of the first: {describe(error)}")
