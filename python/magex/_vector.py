"""Environments that step all worlds in one call: our own base class, and Gymnasium's vector environments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from magex._layout import Batch, Layout
from magex._parallel import finite
from magex._problems import Problem, Refused, broke, raised, request, short, state_problem


class VectorEnvironment:
    """Base class of an environment that holds W worlds of N agents in arrays.

    Every array has the worlds as its first axis, so that nothing needs a loop over worlds in Python:

    * `reset(worlds, seeds)`: seeds is uint32 [W]. Returns the observations, [W, N, *shape of observation_space].
    * `step(actions)`: actions is [W, N] (Discrete), [W, N, H] (MultiDiscrete, MultiBinary) or [W, N, *shape] (Box).
      Returns observations [W, N, ...], rewards [W, N], terminated [W, N] and truncated [W, N];
      the last three may be [W] if they are the same for all agents.
      Worlds and agents that are over are stepped too, with actions of zeros: what they give is ignored.
    * `restart(which, seeds)`: begins a new episode in the K worlds `which`, int64 [K], seeds uint32 [K].
      Returns the observations of these, [K, N, ...]. Other worlds must not change.

    If agents have observations of different sizes (pad=True), observations are [W, N, V] with the largest size.

    An episode must be a function of its seed and its actions, not of the world's index or of what the other worlds do;
    `magex.uniform` draws random numbers that way.

    Optional, asked after reset, step and restart: `masks()` returns [W, N, sum of choices], `states()` [W, S] and
    `successes()` [W] (looked at where an episode ends). `render(world)` returns a picture [height, width, 3], uint8.
    """

    #: Names of the N agents.
    agents: Sequence[str] = ("agent_0",)
    #: Spaces of every agent; a dict with the agents as keys if they differ.
    observation_space: Any = None
    action_space: Any = None
    #: For people; the name of the class if empty.
    name: str = ""
    #: Steps after which an episode is cut; 0 if there is no limit.
    steps_max: int = 0
    #: Largest number of worlds; 0 is any.
    worlds_max: int = 0

    def reset(self, worlds: int, seeds: np.ndarray) -> np.ndarray:
        """Begins an episode in each of W worlds; returns observations [W, N, ...]."""
        raise NotImplementedError

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Returns observations [W, N, ...], rewards, terminated and truncated [W, N] or [W]."""
        raise NotImplementedError

    def restart(self, which: np.ndarray, seeds: np.ndarray) -> np.ndarray:
        """Begins an episode in the K worlds `which`; returns their observations [K, N, ...]."""
        raise NotImplementedError

    def masks(self) -> np.ndarray | None:
        """[W, N, sum of choices] 1 for an allowed choice; None if there are no masks."""
        return None

    def states(self) -> np.ndarray | None:
        """[W, S] what a centralised critic sees; None: it sees all observations."""
        return None

    def successes(self) -> np.ndarray | None:
        """[W] whether the episode that ends in this step is a success; None if that is not known."""
        return None

    def render(self, world: int) -> np.ndarray | None:
        """A picture [height, width, 3] uint8 of a world as it is now."""
        return None

    def close(self) -> None:
        """Frees what the environment holds."""


class GymnasiumVector(VectorEnvironment):
    """A Gymnasium vector environment with autoreset mode DISABLED: one agent, num_envs worlds.

    It insists that every world is stepped or reset: worlds that wait for their restart, and worlds beyond those that were
    asked for, are reset with a seed of no meaning whenever they are over.
    """

    def __init__(self, make: Callable[[int], Any], env: Any, flexible: bool) -> None:
        self.make, self.env, self.flexible = make, env, flexible
        self.observation_space = env.single_observation_space
        self.action_space = env.single_action_space
        self.worlds_max = 0 if flexible else int(env.num_envs)
        self.options: dict[str, Any] | None = None
        self._success: np.ndarray | None = None
        check_autoreset(env)

    def reset(self, worlds: int, seeds: np.ndarray) -> np.ndarray:
        if self.flexible and worlds != self.env.num_envs:
            self.env.close()
            self.env = self.make(worlds)
            check_autoreset(self.env)
        self.worlds = worlds
        self.over = np.zeros(self.env.num_envs, np.bool_)
        every = [int(seed) for seed in seeds] + [0] * (self.env.num_envs - worlds)
        observations, self.infos = self.env.reset(seed=every, options=dict(self.options) if self.options else None)
        return self._rows(observations)[:worlds]

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        if self.over.any():
            self._reset(self.over, [0] * self.env.num_envs)
        count, extra = self.env.num_envs, self.env.num_envs - self.worlds
        own = actions[:, 0]
        if extra:
            own = np.concatenate([own, np.repeat(own[:1], extra, axis=0)])
        observations, rewards, terminated, truncated, self.infos = self.env.step(own)
        self.over = np.logical_or(terminated, truncated).reshape(count)
        w = self.worlds
        self._success = None
        for key in ("is_success", "success"):
            if key in self.infos:
                self._success = np.asarray(self.infos[key]).astype(np.bool_).reshape(count)[:w]
                break
        column = (w, 1)
        return (
            self._rows(observations)[:w],
            np.asarray(rewards)[:w].reshape(column),
            np.asarray(terminated)[:w].reshape(column),
            np.asarray(truncated)[:w].reshape(column),
        )

    def restart(self, which: np.ndarray, seeds: np.ndarray) -> np.ndarray:
        chosen = np.zeros(self.env.num_envs, np.bool_)
        chosen[which] = True
        every: list[int | None] = [None] * self.env.num_envs
        for w, seed in zip(which, seeds):
            every[int(w)] = int(seed)
        return self._rows(self._reset(chosen, every))[which]

    def _reset(self, chosen: np.ndarray, seeds: list) -> Any:
        options = {**(self.options or {}), "reset_mask": chosen.copy()}
        observations, self.infos = self.env.reset(seed=seeds, options=options)
        self.over = self.over & ~chosen
        return observations

    def _rows(self, observations: Any) -> Any:
        return observations[:, None] if isinstance(observations, np.ndarray) else observations

    def successes(self) -> np.ndarray | None:
        return self._success

    def masks(self) -> np.ndarray | None:
        mask = self.infos.get("action_mask") if isinstance(self.infos, dict) else None
        return None if mask is None else np.stack(list(mask))[: self.worlds, None]

    def render(self, world: int) -> np.ndarray | None:
        pictures = self.env.render()
        return pictures[world] if pictures is not None else None

    def close(self) -> None:
        self.env.close()


def check_autoreset(env: Any) -> None:
    """Only DISABLED leaves it to the caller when a world begins anew, and with which seed."""
    metadata = getattr(env, "metadata", None) or {}
    mode = metadata.get("autoreset_mode")
    name = getattr(mode, "name", str(mode))
    if name != "DISABLED":
        raise Refused(
            f"autoreset_mode: {type(env).__name__} has {name}, which begins episodes by itself and without a seed; "
            "make it with autoreset_mode=gymnasium.vector.AutoresetMode.DISABLED"
        )


class VectorWorlds:
    """The worlds of one stream in one environment object."""

    def __init__(self, make: Callable[[], VectorEnvironment], layout: Layout) -> None:
        self.make = make
        self.layout = layout
        self.env: VectorEnvironment | None = None
        self.spoiled = False
        # What the environment returned as observations last, for the check.
        self.last: Any = None
        self.acts = np.zeros((0, len(layout.agents)), np.bool_)

    def reset(self, seeds: Sequence[int], options: dict[str, Any] | None = None) -> Batch:
        if self.spoiled:
            self.close()
        if self.env is None:
            self.env = self._call("make", self.make)
            self.spoiled = False
        if options and not hasattr(self.env, "options"):
            raise request("options: this environment takes none; leave them out, or give it an attribute `options`")
        if hasattr(self.env, "options"):
            self.env.options = options
        batch = Batch(self.layout, len(seeds))
        observations = self._call("reset", self.env.reset, len(seeds), np.asarray(seeds, np.uint32))
        self._observe(batch, slice(None), observations, len(seeds), "reset")
        batch.active[:] = True
        return self._finish(batch)

    def step(self, actions: np.ndarray, restarts: dict[int, int]) -> Batch:
        assert self.env is not None
        layout, count = self.layout, len(self.layout.agents)
        worlds = len(self.acts)
        batch = Batch(layout, worlds)
        which = np.fromiter(restarts, np.int64, len(restarts))
        acts = self.acts.copy()
        acts[which] = False
        layout.actions.check(actions, acts)
        if acts.any():
            given = layout.actions.rows(np.where(acts[:, :, None], actions, 0), acts)
            result = self._call("step", self.env.step, np.asarray(given))
            if not isinstance(result, tuple) or len(result) != 4:
                seen = f"{len(result)} values" if isinstance(result, tuple) else short(result)
                raise broke(0, None, "step", "(observations, rewards, terminated, truncated)", seen)
            observations, rewards, terminated, truncated = result
            self._observe(batch, slice(None), observations, worlds, "step")
            batch.rewards[:] = self._column(rewards, "rewards", "biuf", worlds, count)
            batch.terminated[:] = self._column(terminated, "terminated", "b", worlds, count)
            batch.truncated[:] = self._column(truncated, "truncated", "b", worlds, count)
            if not acts.all():
                silent = ~acts
                batch.observations[silent] = 0.0
                batch.rewards[silent] = 0.0
                batch.terminated[silent] = False
                batch.truncated[silent] = False
        ended = batch.terminated | batch.truncated
        batch.active = acts & ~ended
        over = ended.any(axis=1) & ~batch.active.any(axis=1)
        if over.any():
            said = self._call("successes", self.env.successes)
            if said is not None:
                batch.said = True
                batch.successes = over & self._array(said, "successes()", (worlds,)).astype(np.bool_)
        if len(which):
            # The final states of other worlds are read after the restart: it must not change them.
            seeds = np.fromiter(restarts.values(), np.uint32, len(which))
            observations = self._call("restart", self.env.restart, which, seeds)
            self._observe(batch, which, observations, len(which), "restart")
            batch.active[which] = True
        return self._finish(batch, ended)

    def render(self, world: int) -> Any:
        assert self.env is not None
        return self._call("render", self.env.render, world)

    def close(self) -> None:
        if self.env is not None:
            env, self.env = self.env, None
            try:
                env.close()
            except Exception:
                pass

    def _call(self, during: str, function: Callable[..., Any], *args: Any) -> Any:
        try:
            return function(*args)
        except Exception as error:
            self.spoiled = True
            raise raised(error, during) from error

    def _observe(self, batch: Batch, where: Any, observations: Any, worlds: int, during: str) -> None:
        layout, count = self.layout, len(self.layout.agents)
        self.last = observations
        if layout.shape is not None:
            array = self._array(observations, f"observations of {during}", (worlds, count, *layout.shape))
            batch.observations[where] = array.reshape(worlds, count, layout.width)
            return
        # Agents of different sizes: the environment fills up itself, with whatever it likes.
        array = self._array(observations, f"observations of {during}", (worlds, count, layout.width))
        own = np.arange(layout.width) < np.array([codec.width for codec in layout.observations])[:, None]
        batch.observations[where] = np.where(own, array, 0.0)

    def _array(self, value: Any, field: str, shape: tuple[int, ...]) -> np.ndarray:
        try:
            array = np.asarray(value)
        except (TypeError, ValueError):
            raise broke(0, None, field, f"an array of shape {shape}", short(value)) from None
        if array.shape != shape or array.dtype.kind not in "biuf":
            raise broke(0, None, field, f"numbers of shape {shape}", f"{array.dtype} of shape {array.shape}")
        return array

    def _column(self, value: Any, field: str, kinds: str, worlds: int, count: int) -> np.ndarray:
        """[W, N], or [W] for all agents alike."""
        array = np.asarray(value)
        if array.shape == (worlds,):
            array = np.repeat(array[:, None], count, axis=1)
        array = self._array(array, field, (worlds, count))
        if array.dtype.kind not in kinds and not (kinds == "b" and np.isin(array, (0, 1)).all()):
            raise broke(0, None, field, "True or False", f"{array.dtype}")
        return array

    def _finish(self, batch: Batch, ended: np.ndarray | None = None) -> Batch:
        assert self.env is not None
        layout = self.layout
        worlds, count = batch.active.shape
        if batch.masks is not None and layout.own_masks:
            masks = self._call("masks", self.env.masks)
            total = int(layout.actions.choices.sum())
            given = self._array(masks, "masks()", (worlds, count, total))
            batch.masks[:, :, layout.actions.on_wire] &= given != 0
        if batch.states is not None:
            try:
                states = self._call("states()", self.env.states)
                batch.states[:] = self._array(states, "states()", (worlds, layout.state_width))
            except Problem as problem:
                raise state_problem(problem) from problem
            alive = batch.active.any(axis=1)
            if ended is not None:
                alive |= ended.any(axis=1)
            if not alive.all():
                batch.states[~alive] = 0.0
        finite(batch, layout)
        self.acts = batch.active
        return batch
