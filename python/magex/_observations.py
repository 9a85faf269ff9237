"""Observations as rows of numbers.

The order is that of `gymnasium.spaces.utils.flatten`: arrays row by row, Discrete and MultiDiscrete as one-hot numbers, tuples
and dictionaries part after part. Spaces are recognised by the name of their class, so that nothing here needs Gymnasium.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from magex._problems import Refused, names, short

Write = Callable[[Any, np.ndarray], None]


class Unfit(Exception):
    """A value that its space does not allow. The caller adds world and agent."""

    def __init__(self, field: str, expected: object, seen: object) -> None:
        super().__init__(f"{field}: expected {expected}, seen {seen}")
        self.field, self.expected, self.seen = field, expected, seen


def kind(space: Any) -> str:
    """Name of the class of spaces that this one belongs to."""
    known = {"Box", "Discrete", "MultiDiscrete", "MultiBinary", "Tuple", "Dict", "Text", "Graph", "Sequence", "OneOf"}
    for cls in type(space).__mro__:
        if cls.__name__ in known:
            return cls.__name__
    return type(space).__name__


class ObservationCodec:
    """How one agent's observation becomes `width` numbers.

    A Dict with the keys "observation" and "action_mask" is an observation and a mask.
    """

    def __init__(self, space: Any, agent: str) -> None:
        self.space = space
        self.agent = agent
        field = f'observation_space of agent "{agent}"'
        self.has_mask = kind(space) == "Dict" and "action_mask" in space.spaces
        inner = space
        if self.has_mask:
            if "observation" not in space.spaces:
                raise Refused(f'{field}: has the key "action_mask" but not "observation"; name the rest "observation"')
            others = set(space.spaces) - {"observation", "action_mask"}
            if others:
                raise Refused(
                    f'{field}: keys {names(others)} beside "observation" and "action_mask"; move them into "observation"'
                )
            inner = space.spaces["observation"]
        self.inner = inner
        self.write, self.width = _compile(inner, "observation", field)
        if self.width == 0:
            raise Refused(f"{field}: has no numbers; give a space with one number at least")
        # The shape to compare with where rows can be joined without looking at each.
        self.shape: tuple[int, ...] | None = None
        if not self.has_mask and kind(inner) == "Box":
            self.shape = tuple(inner.shape)
        self.dtype = np.float64 if _is_double(inner) else np.float32

    def numbers(self, value: Any) -> Any:
        """The part of a value that is the observation."""
        if not self.has_mask:
            return value
        try:
            return value["observation"]
        except (KeyError, TypeError, IndexError):
            raise Unfit("observation", 'a dict with the keys "observation" and "action_mask"', short(value)) from None


def structure(space: Any) -> Any:
    """What must be equal for two agents to share a network: kinds and sizes, but not the bounds."""
    name = kind(space)
    if name == "Box":
        return name, tuple(space.shape)
    if name == "Discrete":
        return name, int(space.n)
    if name == "MultiDiscrete":
        return name, tuple(int(n) for n in np.ravel(space.nvec))
    if name == "MultiBinary":
        return name, tuple(space.shape)
    if name == "Tuple":
        return name, tuple(structure(part) for part in space.spaces)
    if name == "Dict":
        return name, tuple((key, structure(part)) for key, part in space.spaces.items())
    return name


def _is_double(space: Any) -> bool:
    """Whether binary32 would lose digits of the numbers."""
    name = kind(space)
    if name == "Box":
        dtype = np.dtype(space.dtype)
        return dtype == np.float64 or (dtype.kind in "iu" and dtype.itemsize > 2)
    if name == "Tuple":
        return any(_is_double(part) for part in space.spaces)
    if name == "Dict":
        return any(_is_double(part) for part in space.spaces.values())
    return False


def _compile(space: Any, field: str, where: str) -> tuple[Write, int]:
    name = kind(space)
    if name == "Box":
        return _array(tuple(space.shape), field)
    if name == "MultiBinary":
        return _array(tuple(space.shape), field)
    if name == "Discrete":
        return _choice(int(space.n), int(getattr(space, "start", 0)), field)
    if name == "MultiDiscrete":
        starts = np.ravel(getattr(space, "start", np.zeros_like(space.nvec)))
        return _choices(np.ravel(space.nvec), starts, tuple(space.shape), field)
    if name == "Tuple":
        return _parts(list(enumerate(space.spaces)), field, where, "a tuple")
    if name == "Dict":
        return _parts(list(space.spaces.items()), field, where, "a dict")
    raise Refused(f"{where}: {name} has no fixed number of numbers; use Box, Discrete, MultiDiscrete, MultiBinary, Tuple or Dict")


def _array(shape: tuple[int, ...], field: str) -> tuple[Write, int]:
    width = int(np.prod(shape, dtype=np.int64))

    def write(value: Any, row: np.ndarray) -> None:
        try:
            array = np.asarray(value)
            if array.shape != shape:
                raise Unfit(field, f"shape {shape}", f"shape {array.shape}")
            row[:] = array.ravel()
        except (TypeError, ValueError):
            raise Unfit(field, f"an array of numbers of shape {shape}", short(value)) from None

    return write, width


def _choice(n: int, start: int, field: str) -> tuple[Write, int]:
    def write(value: Any, row: np.ndarray) -> None:
        try:
            index = int(value) - start
            fits = int(value) == value
        except (TypeError, ValueError):
            raise Unfit(field, f"an integer from {start} to {start + n - 1}", short(value)) from None
        if not fits or not 0 <= index < n:
            raise Unfit(field, f"an integer from {start} to {start + n - 1}", short(value))
        row[:] = 0.0
        row[index] = 1.0

    return write, n


def _choices(nvec: np.ndarray, starts: np.ndarray, shape: tuple[int, ...], field: str) -> tuple[Write, int]:
    ends = np.cumsum(nvec)
    begins = ends - nvec
    expected = f"an array of integers of shape {shape}, from {starts.tolist()} and below {(starts + nvec).tolist()}"

    def write(value: Any, row: np.ndarray) -> None:
        try:
            array = np.asarray(value)
            index = array.ravel().astype(np.int64) - starts
            fits = array.shape == shape and bool(((index >= 0) & (index < nvec)).all())
        except (TypeError, ValueError):
            fits = False
        if not fits:
            raise Unfit(field, expected, short(value))
        row[:] = 0.0
        row[begins + index] = 1.0

    return write, int(ends[-1]) if len(ends) else 0


def _parts(items: list[tuple[Any, Any]], field: str, where: str, what: str) -> tuple[Write, int]:
    compiled: list[tuple[Any, Write, int, int]] = []
    at = 0
    for key, part in items:
        write_part, width = _compile(part, f"{field}[{key!r}]", where)
        compiled.append((key, write_part, at, at + width))
        at += width

    def write(value: Any, row: np.ndarray) -> None:
        for key, write_part, begin, end in compiled:
            try:
                inner = value[key]
            except (KeyError, IndexError, TypeError):
                raise Unfit(f"{field}[{key!r}]", f"{what} with this part", short(value)) from None
            write_part(inner, row[begin:end])

    return write, at
