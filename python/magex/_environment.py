"""What the user's callable makes: which kind it is, its layout, and worlds of it."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Callable
from typing import Any

import numpy as np

from magex._layout import Layout, layout, name_of, steps_max_of
from magex._observations import Unfit
from magex._parallel import Alone, ParallelWorlds
from magex._problems import Problem, Refused, broke, raised, short
from magex._vector import GymnasiumVector, VectorEnvironment, VectorWorlds, check_autoreset

Worlds = ParallelWorlds | VectorWorlds

#: Seed of the first look at an environment.
FIRST_SEED = 1


class Environment:
    """Makes environments, and knows what they are once one has been made."""

    def __init__(
        self,
        make: Callable[..., Any],
        worlds: int | None = None,
        pad: bool = False,
        state: bool = True,
        renders: bool | None = None,
    ) -> None:
        if not callable(make):
            raise Refused(f"make: {short(make)} cannot be called; give a function, or a class, that returns an environment")
        self._make = make
        self._takes_count = takes_count(make)
        self.worlds_max = worlds or 0
        self.pad = pad
        self.state = state
        self.renders = renders
        self._layout: Layout | None = None
        self._kind = ""

    def layout(self) -> Layout:
        """Makes a first environment, resets it once and reads its sizes."""
        if self._layout is None:
            env = self.make()
            try:
                self._layout = self._read(env)
            finally:
                with contextlib.suppress(Exception):
                    env.close()
        return self._layout

    def worlds(self) -> Worlds:
        """Worlds of a stream of its own; none is made before their first reset."""
        layout = self.layout()
        if self._kind == "vector":
            return VectorWorlds(self.make, layout)
        return ParallelWorlds(self.make, layout)

    @property
    def kind(self) -> str:
        """parallel, single or vector, as soon as there is a layout."""
        return self._kind

    def make(self) -> Any:
        """One environment, in the shape that the worlds take."""
        env = self.raw()
        if isinstance(env, VectorEnvironment):
            self._kind = "vector"
        elif hasattr(env, "num_envs") and hasattr(env, "single_observation_space"):
            check_autoreset(env)
            self._kind = "vector"
            env = GymnasiumVector(self._make, env, self._takes_count)
        elif hasattr(env, "possible_agents") and hasattr(env, "agent_iter"):
            raise Refused(
                "make: returned an AEC environment, whose agents act in turn; return its parallel_env(), or "
                "pettingzoo.utils.aec_to_parallel(env)"
            )
        elif hasattr(env, "possible_agents"):
            self._kind = "parallel"
        elif hasattr(env, "observation_space") and hasattr(env, "action_space") and hasattr(env, "step"):
            self._kind = "single"
            env = Alone(env)
        else:
            raise Refused(
                f"make: returned {short(env)}; return a PettingZoo Parallel environment (with possible_agents), a Gymnasium "
                "environment, or a magex.VectorEnvironment"
            )
        return env

    def raw(self) -> Any:
        """What the user's callable returns."""
        if not self._takes_count:
            return self._make()
        return self._make(self.worlds_max or 1)

    def _read(self, env: Any) -> Layout:
        if self._kind == "vector":
            found = self._read_vector(env)
        else:
            found = self._read_parallel(env)
        if self.renders is not None:
            found.renders = self.renders
        if self.worlds_max:
            found.worlds_max = min(found.worlds_max or self.worlds_max, self.worlds_max)
        return found

    def _read_parallel(self, env: Any) -> Layout:
        found = layout(name_of(env), list(env.possible_agents), env.observation_space, env.action_space, self.pad)
        found.steps_max = steps_max_of(env)
        found.renders = getattr(env, "render_mode", None) == "rgb_array"
        # The sizes that no space tells: masks in infos and the state.
        try:
            result = env.reset(seed=FIRST_SEED)
        except Unfit as unfit:
            raise broke(0, None, unfit.field, unfit.expected, unfit.seen) from None
        except Exception as error:
            raise raised(error, "reset", 0) from error
        infos = result[1] if isinstance(result, tuple) and len(result) == 2 else {}
        info_masks = [isinstance(infos, dict) and _has_mask(infos.get(agent)) for agent in found.agents]
        if any(info_masks):
            found.info_masks = info_masks
            found.__post_init__()
        found.state_width = found.state_seen = _state_width(env) if self.state else 0
        return found

    def _read_vector(self, env: VectorEnvironment) -> Layout:
        agents = list(env.agents)
        for field in ("observation_space", "action_space"):
            if getattr(env, field, None) is None:
                raise Refused(f"{field}: missing; give the vector environment the space of one agent")
        found = layout(
            env.name or name_of(env.env if isinstance(env, GymnasiumVector) else env),
            agents,
            lambda agent: _of(env.observation_space, agent),
            lambda agent: _of(env.action_space, agent),
            self.pad,
        )
        found.worlds_max = env.worlds_max
        inner = env.env if isinstance(env, GymnasiumVector) else env
        found.steps_max = steps_max_of(inner)
        found.renders = (
            getattr(inner, "render_mode", None) == "rgb_array"
            if isinstance(env, GymnasiumVector)
            else type(env).render is not VectorEnvironment.render
        )
        if any(codec.shape is None for codec in found.observations):
            raise Refused(
                f"observation_space: {short(found.observations[0].space)}; a vector environment needs a Box: "
                "flatten it, and return masks from masks()"
            )
        worlds = found.worlds_max or 1
        try:
            env.reset(worlds, np.arange(FIRST_SEED, FIRST_SEED + worlds, dtype=np.uint32))
            masks, states = env.masks(), env.states()
        except Exception as error:
            raise raised(error, "reset") from error
        if masks is not None:
            found.info_masks = [True] * len(agents)
            found.__post_init__()
        if states is not None and self.state:
            shape = np.shape(states)
            if len(shape) != 2:
                raise broke(0, None, "states()", "shape (W, S)", f"shape {shape}")
            found.state_width = found.state_seen = int(shape[1])
        return found


def takes_count(make: Callable[..., Any]) -> bool:
    """Whether the callable wants the number of worlds: its first argument has no default, or is called num_envs."""
    try:
        parameters = list(inspect.signature(make).parameters.values())
    except (TypeError, ValueError):
        return False
    if not parameters:
        return False
    first = parameters[0]
    positional = first.kind in (first.POSITIONAL_ONLY, first.POSITIONAL_OR_KEYWORD)
    return positional and (first.default is first.empty or first.name == "num_envs")


def _of(space: Any, agent: str) -> Any:
    return space[agent] if type(space) is dict else space


def _has_mask(info: Any) -> bool:
    return isinstance(info, dict) and info.get("action_mask") is not None


def _state_width(env: Any) -> int:
    """Numbers of state(), if the environment has one that works."""
    try:
        state = np.asarray(env.state())
        return int(state.size) if state.dtype.kind in "biuf" else 0
    except Exception:
        # Nearly every environment inherits a state() that raises.
        return 0


__all__ = ["Environment", "Problem", "Worlds"]
