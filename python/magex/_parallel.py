"""Worlds that are PettingZoo Parallel objects, one for each; a Gymnasium environment is one with a single agent.

A step of W worlds costs, beside the environment's own time, a handful of dictionary look-ups per world: values are gathered
into lists and become arrays once. A world in which an agent has left, or that returned something unusual, takes the careful path.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from operator import itemgetter
from typing import Any

import numpy as np

from magex._layout import Batch, Layout
from magex._observations import Unfit
from magex._problems import Problem, broke, names, raised, short, state_problem


class Alone:
    """A Gymnasium environment as a Parallel one whose only agent is "agent_0"."""

    def __init__(self, env: Any) -> None:
        self.env = env
        self.possible_agents = ["agent_0"]
        self.agents: list[str] = []
        self.metadata = getattr(env, "metadata", {})
        self.render_mode = getattr(env, "render_mode", None)
        self.spec = getattr(env, "spec", None)
        self.unwrapped = getattr(env, "unwrapped", env)

    def observation_space(self, agent: str) -> Any:
        return self.env.observation_space

    def action_space(self, agent: str) -> Any:
        return self.env.action_space

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        result = self.env.reset(seed=seed) if options is None else self.env.reset(seed=seed, options=options)
        if not isinstance(result, tuple) or len(result) != 2:
            raise Unfit("reset", "(observation, info)", short(result))
        self.agents = ["agent_0"]
        return {"agent_0": result[0]}, {"agent_0": result[1]}

    def step(self, actions: dict[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        result = self.env.step(actions["agent_0"])
        if len(result) != 5:
            raise Unfit("step", "(observation, reward, terminated, truncated, info)", f"{len(result)} values")
        observation, reward, terminated, truncated, info = result
        if terminated or truncated:
            self.agents = []
        return (
            {"agent_0": observation},
            {"agent_0": reward},
            {"agent_0": terminated},
            {"agent_0": truncated},
            {"agent_0": info},
        )

    def render(self) -> Any:
        return self.env.render()

    def close(self) -> None:
        self.env.close()


class _World:
    """One environment object and the agents that act in it."""

    __slots__ = ("env", "alive", "ghosts", "spoiled", "said")

    def __init__(self) -> None:
        self.env: Any = None
        # Indices of the agents that act next, in order; empty when the world is over.
        self.alive: tuple[int, ...] = ()
        # Agents that ended and that the environment still lists.
        self.ghosts: set[int] = set()
        # It raised: its state is not known, and it is made anew.
        self.spoiled = False
        # What infos said of success, so far in this episode.
        self.said: list[bool] = []


class ParallelWorlds:
    """W worlds, stepped one after another."""

    def __init__(self, make: Callable[[], Any], layout: Layout) -> None:
        self.make = make
        self.layout = layout
        self.agents = tuple(layout.agents)
        self.count = len(self.agents)
        self.index = {agent: i for i, agent in enumerate(self.agents)}
        self.all = tuple(range(self.count))
        # values of all agents of a dict in one call; itemgetter of one name gives no tuple.
        take = itemgetter(*self.agents)
        self.take: Callable[[dict], Sequence[Any]] = take if self.count > 1 else lambda values: (take(values),)
        self.worlds: list[_World] = []
        self.acts = np.zeros((0, self.count), np.bool_)
        self.options: dict[str, Any] | None = None

    # -- requests

    def reset(self, seeds: Sequence[int], options: dict[str, Any] | None = None) -> Batch:
        """Begins an episode in each of len(seeds) worlds."""
        self.options = options
        while len(self.worlds) > len(seeds):
            _close(self.worlds.pop())
        while len(self.worlds) < len(seeds):
            self.worlds.append(_World())
        batch = Batch(self.layout, len(seeds))
        for w, seed in enumerate(seeds):
            self._begin(w, int(seed), batch)
        return self._finish(batch)

    def step(self, actions: np.ndarray, restarts: dict[int, int]) -> Batch:
        """actions [W, N, H or C]; restarts: world -> seed."""
        layout, worlds = self.layout, self.worlds
        batch = Batch(layout, len(worlds))
        acts = self.acts
        if restarts:
            acts = acts.copy()
            acts[list(restarts)] = False
        layout.actions.check(actions, acts)
        rows = layout.actions.rows(actions, acts)
        agents, count, take, everyone = self.agents, self.count, self.take, self.all
        masks = layout.own_masks
        # Worlds of the fast path, and their values agent by agent.
        fast: list[int] = []
        seen: list[Any] = []
        rewards: list[Any] = []
        terminated: list[Any] = []
        truncated: list[Any] = []
        left: list[int] = []
        all_infos: list[Any] = []
        for w, world in enumerate(worlds):
            if w in restarts:
                self._begin(w, restarts[w], batch)
                continue
            alive = world.alive
            if not alive:
                continue
            row = rows[w]
            given = dict(zip(agents, row)) if alive is everyone else {agents[i]: row[i] for i in alive}
            result = self._call(w, "step", world.env.step, given)
            if alive is everyone:
                try:
                    o, r, te, tr, infos = result
                    if len(o) == len(r) == len(te) == len(tr) == count:
                        values = take(o), take(r), take(te), take(tr)
                        seen.extend(values[0])
                        rewards.append(values[1])
                        terminated.append(values[2])
                        truncated.append(values[3])
                        fast.append(w)
                        left.append(len(world.env.agents))
                        all_infos.append(infos)
                        continue
                except (TypeError, ValueError, KeyError, AttributeError):
                    # The careful path repeats this and says what is wrong.
                    pass
            self._carefully(w, world, result, batch)
        if fast:
            self._gather(batch, fast, seen, rewards, terminated, truncated)
            ended = batch.terminated | batch.truncated
            for k, w in enumerate(fast):
                infos = all_infos[k]
                gone = ended[w].any()
                if gone or left[k] != count:
                    self._after(w, ended[w], infos, batch)
                if masks:
                    self._info_masks(w, infos, batch)
        return self._finish(batch)

    def render(self, world: int) -> Any:
        """A picture [height, width, 3] of a world as it is now."""
        return self._call(world, "render", self.worlds[world].env.render)

    def close(self) -> None:
        for world in self.worlds:
            _close(world)
        self.worlds = []

    # -- one world

    def _call(self, w: int, during: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        except Unfit as unfit:
            raise broke(w, None, unfit.field, unfit.expected, unfit.seen) from None
        except Exception as error:
            self.worlds[w].spoiled = True
            raise raised(error, during, w) from error

    def _begin(self, w: int, seed: int, batch: Batch) -> None:
        world = self.worlds[w]
        if world.spoiled:
            _close(world)
        if world.env is None:
            world.env = self._call(w, "make", self.make)
            world.spoiled = False
        options = {} if self.options is None else {"options": self.options}
        result = self._call(w, "reset", world.env.reset, seed=seed, **options)
        if not isinstance(result, tuple) or len(result) != 2:
            raise broke(w, None, "reset", "(observations, infos)", short(result))
        observations, infos = result
        self._known(w, observations, "observations after reset")
        alive = self._alive(w, world.env)
        if not alive:
            raise broke(w, None, "agents after reset", "one agent at least", "none")
        world.alive = alive
        world.ghosts = set()
        world.said = []
        for i in alive:
            self._observe(w, i, observations, batch)
        batch.active[w, list(alive)] = True
        if self.layout.own_masks:
            self._info_masks(w, infos, batch)

    def _alive(self, w: int, env: Any) -> tuple[int, ...]:
        """Indices of the agents in `agents`."""
        live = env.agents
        index = self.index
        try:
            indices = sorted(index[agent] for agent in live)
        except KeyError as error:
            raise broke(w, None, "agents", f"agents of possible_agents ({names(self.agents)})", short(error.args[0])) from None
        return self.all if len(indices) == self.count else tuple(indices)

    def _known(self, w: int, values: Any, field: str) -> None:
        if not isinstance(values, dict):
            raise broke(w, None, field, "a dict with the agents as keys", short(values))
        unknown = values.keys() - self.index.keys()
        if unknown:
            raise broke(w, None, field, f"agents of possible_agents ({names(self.agents)}) as keys", names(unknown))

    def _observe(self, w: int, i: int, observations: dict, batch: Batch) -> None:
        agent = self.agents[i]
        if agent not in observations:
            raise broke(w, agent, "observations", "an observation", f"observations of {names(observations)}")
        codec = self.layout.observations[i]
        value = observations[agent]
        try:
            codec.write(codec.numbers(value), batch.observations[w, i, : codec.width])
            if codec.has_mask:
                self.layout.actions.codecs[i].mask(_mask_of(value), batch.masks[w, i])  # type: ignore[index]
        except Unfit as unfit:
            raise broke(w, agent, unfit.field, unfit.expected, unfit.seen) from None

    def _carefully(self, w: int, world: _World, result: Any, batch: Batch) -> None:
        """A world that some agents have left, or that returned something unusual: agent by agent."""
        if not isinstance(result, tuple) or len(result) != 5:
            expected = "(observations, rewards, terminations, truncations, infos)"
            raise broke(w, None, "step", expected, f"{len(result)} values" if isinstance(result, tuple) else short(result))
        observations, rewards, terminations, truncations, infos = result
        parts = (
            (observations, "observations"),
            (rewards, "rewards"),
            (terminations, "terminations"),
            (truncations, "truncations"),
        )
        for values, field in parts:
            self._known(w, values, field)
        for i in world.alive:
            agent = self.agents[i]
            for values, field in parts[1:]:
                if agent not in values:
                    raise broke(w, agent, field, "a value for every agent that acted", f"values of {names(values)}")
            self._observe(w, i, observations, batch)
            batch.rewards[w, i] = _number(w, agent, rewards[agent])
            batch.terminated[w, i] = _flag(w, agent, terminations[agent], "terminations")
            batch.truncated[w, i] = _flag(w, agent, truncations[agent], "truncations")
        self._after(w, batch.terminated[w] | batch.truncated[w], infos, batch, observations)
        if self.layout.own_masks:
            self._info_masks(w, infos, batch)

    def _after(self, w: int, ended: np.ndarray, infos: Any, batch: Batch, observations: Any = None) -> None:
        """Which agents act next in a world in which one ended, left or came."""
        world = self.worlds[w]
        before = world.alive
        live = set(self._alive(w, world.env))
        for i in before:
            if ended[i]:
                said = _success(infos, self.agents[i])
                if said is not None:
                    world.said.append(said)
            elif i not in live:
                raise broke(w, self.agents[i], "agents", "the agent, or its end in terminations or truncations", "neither")
        # An agent that ended and is still listed has ended all the same; one that was not listed before has come.
        came = live.difference(before, world.ghosts)
        world.ghosts = {i for i in live if i in world.ghosts or ended[i]}
        world.alive = tuple(i for i in self.all if (i in before and not ended[i]) or i in came)
        for i in came:
            self._observe(w, i, observations if observations is not None else {}, batch)
        if not world.alive:
            batch.said |= bool(world.said)
            batch.successes[w] = bool(world.said) and all(world.said)

    def _info_masks(self, w: int, infos: Any, batch: Batch) -> None:
        for i in self.worlds[w].alive:
            if not self.layout.info_masks[i]:
                continue
            agent = self.agents[i]
            try:
                mask = infos[agent]["action_mask"]
            except (KeyError, TypeError):
                raise broke(w, agent, "infos", '"action_mask", as after the first reset', short(infos)) from None
            try:
                self.layout.actions.codecs[i].mask(mask, batch.masks[w, i])  # type: ignore[index]
            except Unfit as unfit:
                raise broke(w, agent, unfit.field, unfit.expected, unfit.seen) from None

    def _state(self, w: int, world: _World, batch: Batch) -> None:
        if batch.states is None:
            return
        try:
            flat = np.asarray(self._call(w, "state()", world.env.state)).ravel()
            if flat.shape != (self.layout.state_width,):
                raise broke(w, None, "state()", f"{self.layout.state_width} numbers, as after the first reset", flat.size)
        except Problem as problem:
            raise state_problem(problem) from problem
        batch.states[w] = flat

    # -- all worlds

    def _gather(self, batch: Batch, fast: list[int], seen: list, rewards: list, terminated: list, truncated: list) -> None:
        """Lists of values of whole worlds become rows of arrays."""
        layout, count = self.layout, self.count
        where: Any = slice(None) if len(fast) == len(self.worlds) else fast
        joined = None
        if layout.shape is not None:
            try:
                if [value.shape for value in seen] == [layout.shape] * len(seen):
                    joined = np.concatenate(seen, axis=None).reshape(len(fast), count, layout.width)
                    batch.observations[where] = joined
            except (AttributeError, TypeError, ValueError):
                joined = None
        if joined is None:
            for k, w in enumerate(fast):
                values = dict(zip(self.agents, seen[k * count : (k + 1) * count]))
                for i in self.all:
                    self._observe(w, i, values, batch)
        _fill(batch.rewards, where, fast, self.agents, rewards, _number)
        _fill(batch.terminated, where, fast, self.agents, terminated, partial(_flag, field="terminations"))
        _fill(batch.truncated, where, fast, self.agents, truncated, partial(_flag, field="truncations"))

    def _finish(self, batch: Batch) -> Batch:
        """What holds for all worlds: states, the agents that act next, zeros for the others, finite numbers."""
        for w, world in enumerate(self.worlds):
            batch.active[w, world.alive if world.alive is not self.all else slice(None)] = True
        ended = batch.terminated | batch.truncated
        if batch.states is not None:
            for w, world in enumerate(self.worlds):
                if batch.active[w].any() or ended[w].any():
                    self._state(w, world, batch)
        self.acts = batch.active
        finite(batch, self.layout)
        return batch


def finite(batch: Batch, layout: Layout) -> None:
    """Refuses NaN and infinities, and masks that allow nothing."""
    for field, values in (("observation", batch.observations), ("reward", batch.rewards), ("state()", batch.states)):
        if values is None or np.isfinite(values).all():
            continue
        at = tuple(int(i) for i in np.argwhere(~np.isfinite(values))[0])
        agent = None if field == "state()" else layout.agents[at[1]]
        number = f" number {at[-1]}" if field != "reward" else ""
        problem = broke(at[0], agent, f"{field}{number}", "a finite number", short(values[at]))
        raise state_problem(problem) if field == "state()" else problem
    if batch.masks is not None:
        batch.masks &= batch.active[:, :, None, None]
        if layout.own_masks:
            nothing = batch.active & ~np.all(batch.masks.any(axis=3), axis=2)
            if nothing.any():
                w, i = (int(x) for x in np.argwhere(nothing)[0])
                raise broke(w, layout.agents[i], "action_mask", "one allowed choice at least in every component", "none")


def _fill(out: np.ndarray, where: Any, fast: list[int], agents: Sequence[str], values: list, convert: Callable) -> None:
    try:
        array = np.array(values)
        # Anything but plain numbers or flags is looked at one by one.
        plain = array.shape == (len(fast), len(agents)) and (
            array.dtype.kind == "b" or array.dtype.kind in "iuf" and out.dtype != np.bool_
        )
    except ValueError:
        plain = False
    if plain:
        out[where] = array
        return
    for k, w in enumerate(fast):
        for i, agent in enumerate(agents):
            out[w, i] = convert(w, agent, values[k][i])


def _number(w: int, agent: str, value: Any) -> float:
    """A reward: a number, or an array of length 1."""
    try:
        array = np.asarray(value)
        if array.size == 1 and array.dtype.kind in "biuf":
            return float(array.reshape(-1)[0])
    except (TypeError, ValueError):
        pass
    raise broke(w, agent, "reward", "a number", short(value))


def _flag(w: int, agent: str, value: Any, field: str) -> bool:
    array = np.asarray(value)
    if array.size == 1 and array.dtype.kind in "biu" and int(array.reshape(-1)[0]) in (0, 1):
        return bool(array.reshape(-1)[0])
    raise broke(w, agent, field, "True or False", short(value))


def _mask_of(value: Any) -> Any:
    try:
        return value["action_mask"]
    except (KeyError, TypeError, IndexError):
        raise Unfit("observation", 'a dict with the key "action_mask"', short(value)) from None


def _success(infos: Any, agent: str) -> bool | None:
    """What the infos of an agent's last step say of success; None if nothing."""
    try:
        info = infos[agent]
        said = info["is_success"] if "is_success" in info else info["success"]
        return bool(said)
    except (KeyError, TypeError, ValueError):
        return None


def _close(world: _World) -> None:
    """Closes what is left of an environment; what it says to that is of no use to anyone."""
    env, world.env, world.alive = world.env, None, ()
    if env is not None:
        try:
            env.close()
        except Exception:
            pass
