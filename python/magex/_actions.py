"""Rows of numbers as actions that an environment takes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from magex._observations import Unfit, kind
from magex._problems import Refused, request, short

CHOICES_MAX = 256


class ActionCodec:
    """One agent's action: `choices` of its components, or `low` and `high` of its numbers."""

    def __init__(self, space: Any, agent: str) -> None:
        self.space = space
        self.kind = kind(space)
        self.choices: np.ndarray | None = None
        self.low: np.ndarray | None = None
        self.high: np.ndarray | None = None
        field = f'action_space of agent "{agent}"'
        if self.kind == "Discrete":
            self._discrete(np.array([space.n]), np.array([getattr(space, "start", 0)]))
        elif self.kind == "MultiDiscrete":
            if len(space.shape) != 1:
                raise Refused(f"{field}: MultiDiscrete of shape {tuple(space.shape)}; give it one axis")
            self._discrete(np.asarray(space.nvec), np.asarray(getattr(space, "start", np.zeros_like(space.nvec))))
        elif self.kind == "MultiBinary":
            self._discrete(np.full(int(np.prod(space.shape)), 2), np.zeros(int(np.prod(space.shape)), np.int64))
        elif self.kind == "Box":
            self._continuous(field)
        else:
            raise Refused(f"{field}: {self.kind} is not supported; use Discrete, MultiDiscrete, MultiBinary or Box")
        if self.choices is not None:
            if len(self.choices) == 0:
                raise Refused(f"{field}: has no components; give it one at least")
            if self.choices.max() > CHOICES_MAX:
                raise Refused(
                    f"{field}: {int(self.choices.max())} choices in one component, and at most {CHOICES_MAX} are possible; "
                    "split it into components with MultiDiscrete"
                )

    def _discrete(self, choices: np.ndarray, start: np.ndarray) -> None:
        self.choices = choices.astype(np.int64)
        self.start = start.astype(np.int64)
        self.size = len(choices)

    def _continuous(self, field: str) -> None:
        space = self.space
        if np.dtype(space.dtype).kind != "f":
            raise Refused(f"{field}: Box of {np.dtype(space.dtype)}; use MultiDiscrete for whole numbers, or a float32 Box")
        self.low = np.broadcast_to(space.low, space.shape).ravel().astype(np.float64)
        self.high = np.broadcast_to(space.high, space.shape).ravel().astype(np.float64)
        one_sided = np.isfinite(self.low) != np.isfinite(self.high)
        if one_sided.any():
            at = int(np.argmax(one_sided))
            raise Refused(f"{field}: number {at} has one bound, {self.low[at]} to {self.high[at]}; give both or none")
        empty = self.low >= self.high
        if empty.any():
            at = int(np.argmax(empty))
            raise Refused(
                f"{field}: number {at} lies between {self.low[at]} and {self.high[at]}; leave it out, or widen its bounds"
            )
        self.size = len(self.low)
        if self.size == 0:
            raise Refused(f"{field}: has no numbers; give it one at least")

    def mask(self, mask: Any, row: np.ndarray) -> None:
        """Writes a mask, [sum of choices] or one array for each component, into a row of [H, largest choices]."""
        assert self.choices is not None
        total = int(self.choices.sum())
        if isinstance(mask, (tuple, list)) and len(mask) == len(self.choices) and np.ndim(mask[0]) == 1:
            mask = np.concatenate(mask)
        array = np.asarray(mask)
        if array.shape != (total,):
            raise Unfit("action_mask", f"shape ({total},)", f"shape {array.shape}")
        if array.dtype.kind not in "biuf":
            raise Unfit("action_mask", "numbers 0 and 1", short(mask))
        at = 0
        for component, n in enumerate(self.choices):
            row[component, :n] = array[at : at + n] != 0
            at += n


class ActionTable:
    """The actions of all agents: what Describe says of them, and how a batch becomes what the worlds take."""

    def __init__(self, codecs: Sequence[ActionCodec], agents: Sequence[str]) -> None:
        self.codecs = list(codecs)
        self.agents = list(agents)
        self.discrete = codecs[0].choices is not None
        self.size = max(codec.size for codec in codecs)
        count = len(codecs)
        if self.discrete:
            # [N, H]: what each agent has. A component that it lacks has one choice, 0.
            self.own = np.ones((count, self.size), np.int64)
            starts = np.zeros((count, self.size), np.int64)
            for i, codec in enumerate(codecs):
                assert codec.choices is not None
                self.own[i, : codec.size] = codec.choices
                starts[i, : codec.size] = codec.start
            self.start = starts
            self.choices = np.maximum(self.own.max(axis=0), 2)
            self.needs_mask = bool((self.own != self.choices).any())
            largest = int(self.choices.max())
            # [N, H, largest] allowed by the agent's own space, and the same as the wire has it.
            self.allowed = np.arange(largest) < self.own[:, :, None]
            self.on_wire = np.arange(largest) < self.choices[:, None]
        else:
            self.low = np.full((count, self.size), -1.0)
            self.high = np.full((count, self.size), 1.0)
            for i, codec in enumerate(codecs):
                assert codec.low is not None and codec.high is not None
                self.low[i, : codec.size] = codec.low
                self.high[i, : codec.size] = codec.high
            used = np.arange(self.size) < np.array([codec.size for codec in codecs])[:, None]
            self.outer_low = np.where(used, self.low, np.inf).min(axis=0)
            self.outer_high = np.where(used, self.high, -np.inf).max(axis=0)
            self.needs_mask = False
        first = codecs[0]
        self.uniform = all(c.kind == first.kind and c.size == first.size for c in codecs)
        shapes = {tuple(c.space.shape or ()) for c in codecs}
        dtypes = {np.dtype(c.space.dtype) for c in codecs}
        self.uniform = self.uniform and len(shapes) == 1 and len(dtypes) == 1
        self.shape = tuple(first.space.shape or ())
        self.dtype = np.dtype(first.space.dtype)
        self.single = all(c.kind == "Discrete" for c in codecs)

    def check(self, actions: np.ndarray, acts: np.ndarray) -> None:
        """actions [W, N, H or C], acts [W, N]: whose numbers count."""
        bad = (actions >= self.own) if self.discrete else ~np.isfinite(actions)
        if not bad.any():
            return
        bad &= acts[:, :, None]
        if bad.any():
            world, agent, at = (int(i) for i in np.argwhere(bad)[0])
            expected = f"a choice below {self.own[agent, at]}" if self.discrete else "a finite number"
            raise request(
                f'actions: world {world}, agent "{self.agents[agent]}", number {at}: expected {expected}, '
                f"seen {short(actions[world, agent, at])}"
            )

    def rows(self, actions: np.ndarray, acts: np.ndarray) -> Any:
        """actions [W, N, H or C] as something whose [w][i] is what agent i of world w takes."""
        if self.discrete:
            # Choices that passed unchecked are those of agents that do not act.
            whole = np.minimum(actions, self.own - 1) + self.start
            if self.single:
                return whole[:, :, 0].tolist()
            if self.uniform:
                return whole.astype(self.dtype).reshape(*whole.shape[:2], *self.shape)
            return [[self._one(codec, row) for codec, row in zip(self.codecs, world)] for world in whole]
        cut = np.clip(np.where(acts[:, :, None], actions, 0.0), self.low, self.high)
        if self.uniform:
            return cut.astype(self.dtype).reshape(*cut.shape[:2], *self.shape)
        return [[self._one(codec, row) for codec, row in zip(self.codecs, world)] for world in cut]

    def _one(self, codec: ActionCodec, row: np.ndarray) -> Any:
        own = row[: codec.size]
        if codec.kind == "Discrete":
            return int(own[0])
        return own.astype(codec.space.dtype).reshape(codec.space.shape)
